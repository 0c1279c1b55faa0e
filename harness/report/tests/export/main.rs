//! Tests exports of synthetic runs, also with foreign programs as readers.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a helper that cannot set up its case has failed the case")]

mod fixtures;
mod folders;
mod foreign_readers;
