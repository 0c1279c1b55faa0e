//! The report as people meet it: in a browser, light and dark, on a phone and on a desk, with scripts and without.
//!
//! Needs `chromium` and `chromedriver` (`ci/install-test-tools`). Where they are missing the tests say so and pass, unless `PLATEBENCH_REQUIRE_ALL=1` asks for
//! all of them. `REPORT_PICTURES=some/folder` keeps what the browser showed.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a helper that cannot set up its case has failed the case"
)]

mod driver;
#[path = "../report/made.rs"]
#[allow(dead_code, reason = "these tests need a part of it")]
mod made;
mod page;
