//! Tests of the reports with records and traces of [`fixtures`].

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fixture that cannot set up its case fails the case")]

mod console;
mod fixtures;
mod formats;
mod hostile_text;
mod junit;
mod marks;
mod not_passed_since;
mod page;
mod page_size;
mod page_text;
mod response;
mod timing;
mod traceability;
