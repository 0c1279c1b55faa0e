//! Mutates the numbers of configurations, samples and commands.

use crate::trust::mutant_controller::Mutant;
use platebench_wire::{Command, Configure, Sample};

/// Limits the drive to `share` times that of the untouched plate, which is too low for a finger.
pub(crate) struct TightPlausibilityLimit {
    share: f32,
    gain: f32,
    setpoint: f32,
}

impl TightPlausibilityLimit {
    pub(crate) fn new(share: f32) -> Self {
        Self { share, gain: 1.0, setpoint: 0.0 }
    }
}

impl Mutant for TightPlausibilityLimit {
    fn on_configure(&mut self, configure: &mut Configure) {
        self.gain = configure.gain_um_per_vpp;
    }

    fn on_sample(&mut self, sample: &mut Sample) {
        self.setpoint = sample.setpoint_um;
    }

    fn on_command(&mut self, command: &mut Command) {
        command.drive_vpp = command.drive_vpp.min(self.share * self.setpoint / self.gain);
    }
}

pub(crate) fn round_to_step(value: f32, step: f32) -> f32 {
    (value / step).round() * step
}
