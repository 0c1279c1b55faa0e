//! Tests `report.html` in Chromium. Without Chromium (`ci/install-test-tools`) the tests print a
//! message and pass, unless `PLATEBENCH_REQUIRE_ALL=1`. `REPORT_PICTURES=FOLDER` keeps screenshots.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test fixture that cannot set up its case fails the case"
)]

mod driver;
#[path = "../report/fixtures.rs"]
#[allow(dead_code, reason = "these tests use a part of it")]
mod fixtures;
mod page;
#[path = "../report/response.rs"]
mod response;
