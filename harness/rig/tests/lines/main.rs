//! Tests serial ports, pseudo-terminals and programs behind them.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod network;
mod programs;
mod serial;

use platebench_test_kit::wave_sample as sample;
use platebench_wire::Configure;
use std::time::Duration;

/// The watchdog timeout is long, because a busy machine may delay the samples.
const CONFIGURE: Configure = Configure { watchdog_timeout_ms: 1_000, ..platebench_test_kit::CONFIGURE };

const RECEIVE_TIMEOUT: Duration = Duration::from_secs(10);
