//! The firmware image on the emulated board, against the same controller in this process, and against everything that can go wrong with an image.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod answers;
mod faults;
mod images;
mod paces;
mod provenance;

use platebench_rig::{Link, LinkError, Session};
use platebench_wire::{Configure, LawId, Sample};
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

const CONFIGURE: Configure = Configure {
    law: LawId::DqPi,
    paced_by_target: false,
    drives_own_plate: false,
    patience_ms: 0,
    period_us: 1_000,
    loop_delay_us: 0,
    start_frequency_mhz: 32_307_600,
    gain_um_per_vpp: 0.00698,
    time_constant_s: 1.88e-3,
    response_time_s: 0.0,
    drive_limit_vpp: 900.0,
    frequency_range_hz: 250.0,
    frequency_slew_hz: 100.0,
    gains: None,
};

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

/// Everything that passed over a link: what came back, how long it took, what it cost.
type Log = Arc<Mutex<Vec<(Vec<u8>, Duration, Option<u64>)>>>;

/// A link that keeps a log.
struct Logged<L> {
    link: L,
    log: Log,
}

impl<L: Link> Link for Logged<L> {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let delay = self.link.exchange(now, bytes, answer)?;
        self.log.lock().unwrap().push((answer.clone(), delay, self.link.cost()));
        Ok(delay)
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.link.pass(now, said)?;
        self.log.lock().unwrap().push((said.clone(), Duration::ZERO, None));
        Ok(())
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.log.lock().unwrap().clear();
        self.link.restart()
    }

    fn cost(&self) -> Option<u64> {
        self.link.cost()
    }
}

fn logged<L: Link>(link: L) -> (Session<Logged<L>>, Log) {
    let log = Log::default();
    (Session::open(Logged { link, log: log.clone() }).unwrap(), log)
}
