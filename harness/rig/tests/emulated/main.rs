//! Tests the firmware image on the emulated board.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod debugger;
mod documented_messages;
mod equivalence;
mod faults;
mod images;
mod own_firmware;
mod provenance;
mod transports;

use platebench_rig::{Chip, Link, LinkError, Session};
use platebench_test_kit::CONFIGURE;
use platebench_wire::Sample;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

const PERIOD: Duration = Duration::from_millis(1);

fn sample(setpoint_um: f32, wd_um: f32) -> Sample {
    Sample { time_us: 0, setpoint_um, wd_um, wq_um: 0.01 }
}

fn firmware_under_test() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../firmware-under-test"))
}

fn image(name: &str) -> Vec<u8> {
    std::fs::read(firmware_under_test().join("images").join(name)).unwrap()
}

/// Received bytes, delay and number of instructions of each call.
type Log = Arc<Mutex<Vec<(Vec<u8>, Duration, Option<u64>)>>>;

struct LoggedLink<L> {
    link: L,
    log: Log,
}

impl<L: Link> Link for LoggedLink<L> {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let delay = self.link.exchange(now, bytes, answer)?;
        self.log.lock().unwrap().push((
            answer.clone(),
            delay,
            self.link.chip().and_then(|chip| chip.instruction_count()),
        ));
        Ok(delay)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.link.advance_to(now, received)?;
        self.log.lock().unwrap().push((received.clone(), Duration::ZERO, None));
        Ok(())
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.log.lock().unwrap().clear();
        self.link.restart()
    }

    fn chip(&mut self) -> Option<&mut dyn Chip> {
        self.link.chip()
    }
}

fn open_logged<L: Link>(link: L) -> (Session<LoggedLink<L>>, Log) {
    let log = Log::default();
    (Session::open(LoggedLink { link, log: log.clone() }).unwrap(), log)
}
