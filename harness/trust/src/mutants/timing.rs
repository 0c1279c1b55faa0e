//! Mutates the time at which samples and commands act.

use crate::mutant_controller::Mutant;
use platebench_wire::{Command, Sample};
use std::time::Duration;

/// Uses the components of the previous sample.
#[derive(Default)]
pub(crate) struct StaleSample {
    previous: Option<[f32; 2]>,
}

impl Mutant for StaleSample {
    fn on_sample(&mut self, sample: &mut Sample) {
        let now = [sample.wd_um, sample.wq_um];
        [sample.wd_um, sample.wq_um] = self.previous.replace(now).unwrap_or(now);
    }
}

/// Repeats the previous drive and frequency in every n-th period.
pub(crate) struct RepeatedCommand {
    every: u32,
    count: u32,
    last: Option<(f32, u32)>,
}

impl RepeatedCommand {
    pub(crate) fn every(every: u32) -> Self {
        Self { every, count: 0, last: None }
    }
}

impl Mutant for RepeatedCommand {
    fn on_command(&mut self, command: &mut Command) {
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

/// Delays commands by 0 to `max_delay`, uniformly, in order.
pub(crate) struct CommandJitter {
    max_delay: Duration,
    state: u32,
}

impl CommandJitter {
    pub(crate) fn up_to(max_delay: Duration) -> Self {
        Self { max_delay, state: 1 }
    }
}

impl Mutant for CommandJitter {
    fn command_delay(&mut self) -> Duration {
        // Linear congruential generator of Numerical Recipes; the upper bits are uniform enough.
        self.state = self.state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        self.max_delay.mul_f64(f64::from(self.state >> 8) / f64::from(1_u32 << 24))
    }
}

/// Reads a new setpoint only in every n-th period.
pub(crate) struct SlowSetpoint {
    every: u32,
    count: u32,
    last_setpoint: f32,
}

impl SlowSetpoint {
    pub(crate) fn every(every: u32) -> Self {
        Self { every, count: 0, last_setpoint: 0.0 }
    }
}

impl Mutant for SlowSetpoint {
    fn on_sample(&mut self, sample: &mut Sample) {
        if self.count.is_multiple_of(self.every) {
            self.last_setpoint = sample.setpoint_um;
        }
        self.count += 1;
        sample.setpoint_um = self.last_setpoint;
    }
}

/// Filters the sample by a first-order low-pass with gain `share` per period.
pub(crate) struct LowPassFilter {
    share: f32,
    state: Option<[f32; 2]>,
}

impl LowPassFilter {
    pub(crate) fn new(share: f32) -> Self {
        Self { share, state: None }
    }
}

impl Mutant for LowPassFilter {
    fn on_sample(&mut self, sample: &mut Sample) {
        let now = [sample.wd_um, sample.wq_um];
        let [d, q] = self.state.unwrap_or(now);
        let smooth = [d + self.share * (now[0] - d), q + self.share * (now[1] - q)];
        self.state = Some(smooth);
        [sample.wd_um, sample.wq_um] = smooth;
    }
}
