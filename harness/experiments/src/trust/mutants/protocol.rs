//! Mutates the handling of configurations, time stamps and answers.

use super::hooks::on_send;
use crate::trust::mutant_controller::Mutant;
use platebench_wire::{Command, Configure, Configured, Gains, Message, Packet, Sample};

#[derive(Default)]
pub(crate) struct IgnoredGains {
    requested: Option<Gains>,
}

impl Mutant for IgnoredGains {
    fn on_configure(&mut self, configure: &mut Configure) {
        self.requested = configure.gains.take();
    }

    fn on_send(&mut self, packet: &mut Packet) {
        if let (Message::Configured(Configured { outcome: Ok(gains) }), Some(requested)) =
            (&mut packet.message, self.requested)
        {
            *gains = requested;
        }
    }
}

pub(crate) fn gains_not_finite() -> Box<dyn Mutant> {
    on_send(|packet| {
        if let Message::Configured(Configured { outcome: Ok(gains) }) = &mut packet.message {
            gains.amplitude_ki = f32::NAN;
        }
    })
}

/// Replaces every n-th command by the previous one, including its sequence number.
pub(crate) fn stale_answer(every: u32) -> Box<dyn Mutant> {
    let (mut count, mut last) = (0_u32, None);
    on_send(move |packet| {
        if !matches!(packet.message, Message::Command(_)) {
            return;
        }
        count += 1;
        let before = last.replace(*packet);
        if let Some(before) = before.filter(|_| count.is_multiple_of(every)) {
            *packet = before;
        }
    })
}

/// Repeats the previous command if the time stamp, read as a counter that wraps, decreases.
pub(crate) struct WrappingCounter {
    /// Converts a time stamp in µs to the value of the counter.
    count: fn(u32) -> i64,
    last: Option<i64>,
    is_old: bool,
    command: Option<(f32, u32)>,
}

impl WrappingCounter {
    pub(crate) fn new(count: fn(u32) -> i64) -> Self {
        Self { count, last: None, is_old: false, command: None }
    }
}

impl Mutant for WrappingCounter {
    fn on_sample(&mut self, sample: &mut Sample) {
        let now = (self.count)(sample.time_us);
        self.is_old = self.last.is_some_and(|last| now < last);
        if !self.is_old {
            self.last = Some(now);
        }
    }

    fn on_command(&mut self, command: &mut Command) {
        match self.command {
            Some((drive_vpp, frequency_mhz)) if self.is_old => {
                *command = Command { drive_vpp, frequency_mhz, ..*command };
            }
            _ => self.command = Some((command.drive_vpp, command.frequency_mhz)),
        }
    }
}

#[derive(Default)]
pub(crate) struct LimitAfterLaw {
    limit_vpp: f32,
}

impl Mutant for LimitAfterLaw {
    fn on_configure(&mut self, configure: &mut Configure) {
        self.limit_vpp = configure.drive_limit_vpp;
        configure.drive_limit_vpp = 900.0;
    }

    fn on_command(&mut self, command: &mut Command) {
        command.drive_vpp = command.drive_vpp.min(self.limit_vpp);
    }
}
