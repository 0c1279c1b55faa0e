//! Implements the paper's two PI loops independently, with one omission. The loops replace `dq-pi`
//! and `dq-pi-fixed` and use the gains of these laws.

use crate::trust::mutant_controller::Mutant;
use platebench_controller::design::PiGains;
use platebench_controller::pi::{Pi, Tracking};
use platebench_wire::{Command, Configure, Gains, LawId, Sample};
use std::f32::consts::TAU;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Omission {
    Nothing,
    AmplitudeIntegral,
    FrequencyIntegral,
    AntiWindup,
    SmallWdGuard,
}

/// Smallest Wd in parts of the setpoint, and largest |Wq/Wd|, as in the firmware's `dq_pi.rs`.
const SMALLEST_WD: f32 = 0.1;
const LARGEST_RATIO: f32 = 2.0;

pub(crate) struct HandwrittenLoops {
    omission: Omission,
    /// `None` if the configured law is not replaced.
    configure: Option<Configure>,
    loops: Option<PiLoops>,
    sample: [f32; 3],
}

struct PiLoops {
    amplitude: Pi,
    frequency: Pi,
    offset: f32,
}

impl HandwrittenLoops {
    pub(crate) fn without(omission: Omission) -> Self {
        Self { omission, configure: None, loops: None, sample: [0.0; 3] }
    }

    /// Returns Wq/Wd, the input of the frequency loop. `None` if the frequency loop is inactive.
    fn ratio(&self) -> Option<f32> {
        let [setpoint, wd, wq] = self.sample;
        if self.omission == Omission::SmallWdGuard {
            return (wd != 0.0).then(|| wq / wd);
        }
        (setpoint > 0.0 && wd > SMALLEST_WD * setpoint).then(|| (wq / wd).clamp(-LARGEST_RATIO, LARGEST_RATIO))
    }
}

impl Mutant for HandwrittenLoops {
    fn on_configure(&mut self, configure: &mut Configure) {
        let own = matches!(configure.law, LawId::DqPi | LawId::DqPiFixed);
        if own {
            configure.law = LawId::DqPiFixed;
        }
        self.configure = own.then_some(*configure);
        self.loops = None;
    }

    fn on_configured(&mut self, gains: &Gains) {
        let Some(configure) = &self.configure else { return };
        let period = configure.period_us as f32 * 1e-6;
        let integral = |gain: f32, missing| if self.omission == missing { 0.0 } else { gain * period };
        let amplitude = PiGains {
            proportional: gains.amplitude_kp,
            integral_per_period: integral(gains.amplitude_ki, Omission::AmplitudeIntegral),
        };
        let frequency = PiGains {
            proportional: gains.frequency_kp,
            integral_per_period: integral(gains.frequency_ki, Omission::FrequencyIntegral),
        };
        let share = if self.omission == Omission::AntiWindup { 0.0 } else { 1.0 };
        self.loops = Some(PiLoops {
            amplitude: Pi::new(amplitude, Tracking { low: share, high: share }),
            frequency: Pi::new(frequency, Tracking::CONDITIONED),
            offset: 0.0,
        });
    }

    fn on_sample(&mut self, sample: &mut Sample) {
        self.sample = [sample.setpoint_um, sample.wd_um, sample.wq_um];
    }

    fn on_command(&mut self, command: &mut Command) {
        let ratio = self.ratio();
        let [setpoint, wd, _] = self.sample;
        let (Some(configure), Some(loops)) = (&self.configure, &mut self.loops) else { return };
        command.drive_vpp = loops.amplitude.step(setpoint - wd, 0.0, configure.drive_limit_vpp);
        if let Some(ratio) = ratio {
            let [range, slew] = [configure.frequency_range_hz, configure.frequency_slew_hz].map(|hz| hz * TAU);
            let (low, high) = ((loops.offset - slew).max(-range), (loops.offset + slew).min(range));
            loops.offset = loops.frequency.step(ratio, low, high);
        }
        let offset_mhz = (loops.offset / TAU * 1e3).round() as i32;
        command.frequency_mhz = configure.start_frequency_mhz.saturating_add_signed(offset_mhz);
    }
}
