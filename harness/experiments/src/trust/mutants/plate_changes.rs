//! Mutates the reaction to a finger that leaves and to a steady state.

use super::hooks::on_command;
use crate::trust::mutant_controller::Mutant;
use platebench_controller::design::PiGains;
use platebench_controller::pi::{Pi, Tracking};
use platebench_wire::{Command, Configure, LawId, Sample};

pub(crate) fn alternating_drive(share: f32) -> Box<dyn Mutant> {
    let mut is_positive = false;
    on_command(move |command| {
        is_positive = !is_positive;
        command.drive_vpp *= if is_positive { 1.0 + share } else { 1.0 - share };
    })
}

/// After a finger has left, keeps 90 % of the drive under the finger until the setpoint changes.
#[derive(Default)]
pub(crate) struct PressLatch {
    gain: f32,
    setpoint: f32,
    pressed_periods: u32,
    floor_vpp: f32,
}

impl PressLatch {
    /// A drive above this multiple of the untouched plate's drive counts as a finger.
    const PRESSED: f32 = 1.25;
    const LATCH_PERIODS: u32 = 10;
    const LATCHED_SHARE: f32 = 0.9;
}

impl Mutant for PressLatch {
    fn on_configure(&mut self, configure: &mut Configure) {
        *self = Self { gain: configure.gain_um_per_vpp, ..Self::default() };
    }

    fn on_sample(&mut self, sample: &mut Sample) {
        if sample.setpoint_um != self.setpoint {
            *self = Self { gain: self.gain, setpoint: sample.setpoint_um, ..Self::default() };
        }
    }

    fn on_command(&mut self, command: &mut Command) {
        let untouched_vpp = self.setpoint / self.gain;
        let is_pressed = command.drive_vpp > Self::PRESSED * untouched_vpp;
        self.pressed_periods = if is_pressed { self.pressed_periods + 1 } else { 0 };
        if self.pressed_periods >= Self::LATCH_PERIODS {
            self.floor_vpp = Self::LATCHED_SHARE * command.drive_vpp;
        }
        command.drive_vpp = command.drive_vpp.max(self.floor_vpp);
    }
}

/// Replaces `dq-pi` by a loop whose gains follow a rising damping but never a falling one.
#[derive(Default)]
pub(crate) struct RisingDampingOnly {
    configure: Option<Configure>,
    amplitude: Option<Pi>,
    sample: [f32; 2],
    last_drive_vpp: f32,
    /// Estimated damping relative to the untouched plate.
    damping: f32,
    largest: f32,
}

impl RisingDampingOnly {
    /// 5 % response time for which the gains are designed, s.
    const RESPONSE_S: f32 = 1.9e-3;
    /// Weight of a new damping estimate in the moving average.
    const TRACKING_SHARE: f32 = 0.25;
    /// The damping is estimated only while |error| is below this share of the setpoint.
    const STEADY_BAND: f32 = 0.05;

    fn gains(configure: &Configure, damping: f32) -> PiGains {
        let period_s = configure.period_us as f32 * 1e-6;
        let (gain, time_constant_s) = (configure.gain_um_per_vpp / damping, configure.time_constant_s / damping);
        PiGains::zero_order_hold_matched(gain, time_constant_s, Self::RESPONSE_S, period_s)
    }
}

impl Mutant for RisingDampingOnly {
    fn on_configure(&mut self, configure: &mut Configure) {
        *self = Self { damping: 1.0, largest: 1.0, ..Self::default() };
        if configure.law == LawId::DqPi {
            configure.law = LawId::DqPiFixed;
            self.configure = Some(*configure);
            self.amplitude = Some(Pi::new(Self::gains(configure, 1.0), Tracking::CONDITIONED));
        }
    }

    fn on_sample(&mut self, sample: &mut Sample) {
        self.sample = [sample.setpoint_um, sample.wd_um];
    }

    fn on_command(&mut self, command: &mut Command) {
        let (Some(configure), Some(amplitude)) = (&self.configure, &mut self.amplitude) else { return };
        let [setpoint, wd] = self.sample;
        if setpoint > 0.0 && (setpoint - wd).abs() < Self::STEADY_BAND * setpoint {
            let damping = self.last_drive_vpp * configure.gain_um_per_vpp / wd;
            self.damping += Self::TRACKING_SHARE * (damping - self.damping);
            self.largest = self.largest.max(self.damping);
            amplitude.set_gains(Self::gains(configure, self.largest));
        }
        command.drive_vpp = amplitude.step(setpoint - wd, 0.0, configure.drive_limit_vpp);
        self.last_drive_vpp = command.drive_vpp;
    }
}
