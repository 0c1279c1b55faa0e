//! Mutates the time at which samples and commands act.

use super::hooks::{on_command, on_sample};
use crate::trust::mutant_controller::Mutant;
use platebench_wire::Command;
use std::time::Duration;

pub(crate) fn stale_sample() -> Box<dyn Mutant> {
    let mut previous = None;
    on_sample(move |sample| {
        let now = [sample.wd_um, sample.wq_um];
        [sample.wd_um, sample.wq_um] = previous.replace(now).unwrap_or(now);
    })
}

/// Repeats the previous drive and frequency in every n-th period.
pub(crate) fn repeated_command(every: u32) -> Box<dyn Mutant> {
    let (mut count, mut last) = (0_u32, None);
    on_command(move |command| {
        count += 1;
        match last {
            Some((drive_vpp, frequency_mhz)) if count.is_multiple_of(every) => {
                *command = Command { drive_vpp, frequency_mhz, ..*command };
            }
            _ => last = Some((command.drive_vpp, command.frequency_mhz)),
        }
    })
}

/// Delays each command by a uniform random time from 0 to `max_delay`. The order stays the same.
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
        // Linear congruential generator of Numerical Recipes. Only its upper bits are used.
        self.state = self.state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        self.max_delay.mul_f64(f64::from(self.state >> 8) / f64::from(1_u32 << 24))
    }
}

pub(crate) fn slow_setpoint(every: u32) -> Box<dyn Mutant> {
    let (mut count, mut last) = (0_u32, 0.0);
    on_sample(move |sample| {
        if count.is_multiple_of(every) {
            last = sample.setpoint_um;
        }
        count += 1;
        sample.setpoint_um = last;
    })
}

/// Filters the sample by a first-order low-pass with gain `share` per period.
pub(crate) fn low_pass_filter(share: f32) -> Box<dyn Mutant> {
    let mut state = None;
    on_sample(move |sample| {
        let now = [sample.wd_um, sample.wq_um];
        let [d, q] = state.unwrap_or(now);
        let smooth = [d + share * (now[0] - d), q + share * (now[1] - q)];
        state = Some(smooth);
        [sample.wd_um, sample.wq_um] = smooth;
    })
}
