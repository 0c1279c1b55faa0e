//! Reports over records and traces made by hand.
//!
//! `made` holds the material; each report has its file. `look` writes a page to look at and is ignored otherwise.

#![allow(clippy::unwrap_used, reason = "a helper that cannot set up its case has failed the case")]

mod console;
mod formats;
mod html;
mod junit;
mod look;
mod made;
mod marks;
mod since;
mod timing;
mod traceability;
