//! Mutates what the protocol demands of configurations, time stamps and answers.

use crate::mutant_controller::Mutant;
use platebench_wire::{Command, Configure, Configured, Gains, Message, Packet, Sample};

/// Confirms the gains of the configuration and uses its own.
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

pub(crate) struct OnConfigured(pub(crate) fn(&mut Gains));

impl Mutant for OnConfigured {
    fn on_send(&mut self, packet: &mut Packet) {
        if let Message::Configured(Configured { outcome: Ok(gains) }) = &mut packet.message {
            (self.0)(gains);
        }
    }
}

/// Replaces every n-th command by the previous answer, sequence number included.
pub(crate) struct StaleAnswer {
    every: u32,
    count: u32,
    last: Option<Packet>,
}

impl StaleAnswer {
    pub(crate) fn every(every: u32) -> Self {
        Self { every, count: 0, last: None }
    }
}

impl Mutant for StaleAnswer {
    fn on_send(&mut self, packet: &mut Packet) {
        if !matches!(packet.message, Message::Command(_)) {
            return;
        }
        self.count += 1;
        let current = *packet;
        if self.count.is_multiple_of(self.every)
            && let Some(last) = self.last
        {
            *packet = last;
        }
        self.last = Some(current);
    }
}

/// Ignores samples whose time stamp, read as a counter that wraps, is older than the last one: the
/// drive freezes.
pub(crate) struct WrappingCounter {
    /// Converts a time stamp in µs.
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

/// Designs for a limit of 900 Vpp and applies the configured limit after the law.
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
