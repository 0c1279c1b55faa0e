//! Mutates the excitation frequency and the demodulation phase.

use crate::trust::mutant_controller::Mutant;
use platebench_wire::{Command, Configure, Sample};
use std::f64::consts::TAU;

#[derive(Default)]
pub(crate) struct InvertedFrequency {
    start_mhz: u32,
}

impl Mutant for InvertedFrequency {
    fn on_configure(&mut self, configure: &mut Configure) {
        self.start_mhz = configure.start_frequency_mhz;
    }

    fn on_command(&mut self, command: &mut Command) {
        command.frequency_mhz = (2 * self.start_mhz).saturating_sub(command.frequency_mhz);
    }
}

/// Returns the nearest frequency that a timer with clock `clock_hz` makes from whole ticks.
pub(crate) fn round_to_timer_ticks(frequency_mhz: u32, clock_hz: f64) -> u32 {
    let ticks = (clock_hz * 1e3 / f64::from(frequency_mhz)).round().max(1.0);
    (clock_hz * 1e3 / ticks).round() as u32
}

/// Stores the demodulation phase since the start, rad, as `f32`. Rounding rotates Wd and Wq.
#[derive(Default)]
pub(crate) struct SinglePrecisionPhase {
    period_s: f64,
    frequency_hz: f64,
    phase: f64,
}

impl Mutant for SinglePrecisionPhase {
    fn on_configure(&mut self, configure: &mut Configure) {
        let frequency_hz = f64::from(configure.start_frequency_mhz) / 1e3;
        *self = Self { period_s: f64::from(configure.period_us) * 1e-6, frequency_hz, phase: 0.0 };
    }

    fn on_sample(&mut self, sample: &mut Sample) {
        let lost = (f64::from(self.phase as f32) - self.phase) as f32;
        let (sin, cos) = lost.sin_cos();
        let (d, q) = (sample.wd_um, sample.wq_um);
        sample.wd_um = d * cos + q * sin;
        sample.wq_um = q * cos - d * sin;
        self.phase += TAU * self.frequency_hz * self.period_s;
    }

    fn on_command(&mut self, command: &mut Command) {
        self.frequency_hz = f64::from(command.frequency_mhz) / 1e3;
    }
}
