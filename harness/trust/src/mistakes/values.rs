//! Numbers that are wrong: a factor, an offset, a converter with too few bits.

use crate::middleware::Mistake;
use platebench_wire::{Command, Configure, Sample};

/// Nothing is wrong.
pub(crate) struct Nothing;

impl Mistake for Nothing {}

/// Wrong in what it is configured with.
pub(crate) struct OnConfigure(pub(crate) fn(&mut Configure));

impl Mistake for OnConfigure {
    fn configure(&mut self, configure: &mut Configure) {
        (self.0)(configure);
    }
}

/// Wrong in what it is given.
pub(crate) struct OnSample(pub(crate) fn(&mut Sample));

impl Mistake for OnSample {
    fn sample(&mut self, sample: &mut Sample) {
        (self.0)(sample);
    }
}

/// Wrong in what it gives.
pub(crate) struct OnCommand(pub(crate) fn(&mut Command));

impl Mistake for OnCommand {
    fn command(&mut self, command: &mut Command) {
        (self.0)(command);
    }
}

/// Lets through at most `share` of the drive that the setpoint takes untouched, a plausibility check that forgot the finger.
pub(crate) struct Implausible {
    share: f32,
    gain: f32,
    setpoint: f32,
}

impl Implausible {
    pub(crate) fn above(share: f32) -> Self {
        Self { share, gain: 1.0, setpoint: 0.0 }
    }
}

impl Mistake for Implausible {
    fn configure(&mut self, configure: &mut Configure) {
        self.gain = configure.gain_um_per_vpp;
    }

    fn sample(&mut self, sample: &mut Sample) {
        self.setpoint = sample.setpoint_um;
    }

    fn command(&mut self, command: &mut Command) {
        command.drive_vpp = command.drive_vpp.min(self.share * self.setpoint / self.gain);
    }
}

/// The nearest multiple of `step`.
pub(crate) fn rounded(value: f32, step: f32) -> f32 {
    (value / step).round() * step
}
