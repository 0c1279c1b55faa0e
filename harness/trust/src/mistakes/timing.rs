//! Right numbers at the wrong time.

use crate::middleware::Mistake;
use platebench_wire::{Command, Sample};
use std::time::Duration;

/// Controls with the components of the sample before.
#[derive(Default)]
pub(crate) struct Stale {
    before: Option<[f32; 2]>,
}

impl Mistake for Stale {
    fn sample(&mut self, sample: &mut Sample) {
        let now = [sample.wd_um, sample.wq_um];
        [sample.wd_um, sample.wq_um] = self.before.replace(now).unwrap_or(now);
    }
}

/// In every n-th period the drive and frequency of the one before act once more.
pub(crate) struct Repeats {
    every: u32,
    count: u32,
    last: Option<(f32, u32)>,
}

impl Repeats {
    pub(crate) fn every(every: u32) -> Self {
        Self { every, count: 0, last: None }
    }
}

impl Mistake for Repeats {
    fn command(&mut self, command: &mut Command) {
        self.count += 1;
        if self.count.is_multiple_of(self.every)
            && let Some((drive_vpp, frequency_mhz)) = self.last
        {
            *command = Command { drive_vpp, frequency_mhz, ..*command };
        } else {
            self.last = Some((command.drive_vpp, command.frequency_mhz));
        }
    }
}

/// Commands leave up to `most` late, evenly spread, and in order.
pub(crate) struct Jitter {
    most: Duration,
    state: u32,
}

impl Jitter {
    pub(crate) fn up_to(most: Duration) -> Self {
        Self { most, state: 1 }
    }
}

impl Mistake for Jitter {
    fn delay(&mut self) -> Duration {
        // Numerical Recipes' quick generator; its upper bits are even enough.
        self.state = self.state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        self.most.mul_f64(f64::from(self.state >> 8) / f64::from(1_u32 << 24))
    }
}

/// Reads the setpoint in every n-th period.
pub(crate) struct SlowSetpoint {
    every: u32,
    count: u32,
    known: f32,
}

impl SlowSetpoint {
    pub(crate) fn every(every: u32) -> Self {
        Self { every, count: 0, known: 0.0 }
    }
}

impl Mistake for SlowSetpoint {
    fn sample(&mut self, sample: &mut Sample) {
        if self.count.is_multiple_of(self.every) {
            self.known = sample.setpoint_um;
        }
        self.count += 1;
        sample.setpoint_um = self.known;
    }
}

/// A first-order low-pass that takes over `share` of the difference per period.
pub(crate) struct Smoothed {
    share: f32,
    state: Option<[f32; 2]>,
}

impl Smoothed {
    pub(crate) fn by(share: f32) -> Self {
        Self { share, state: None }
    }
}

impl Mistake for Smoothed {
    fn sample(&mut self, sample: &mut Sample) {
        let now = [sample.wd_um, sample.wq_um];
        let [d, q] = self.state.unwrap_or(now);
        let smooth = [d + self.share * (now[0] - d), q + self.share * (now[1] - q)];
        self.state = Some(smooth);
        [sample.wd_um, sample.wq_um] = smooth;
    }
}
