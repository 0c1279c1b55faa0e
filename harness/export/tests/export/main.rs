//! Runs made by hand, exported, and opened by programs that are not the bench's.
//!
//! `foreign` asks those (`ci/install-test-tools`; where they are missing the tests say so and pass, unless
//! `PLATEBENCH_REQUIRE_ALL=1` asks for all of them); `folders` is about files and names; `made` holds the runs.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a helper that cannot set up its case has failed the case")]

mod fixtures;
mod folders;
mod foreign_readers;
