//! The paper's two PI loops written by hand, with one line missing.
//!
//! They take the place of `dq-pi` and of `dq-pi-fixed`, whose design they use; the state machine around them stays the firmware's. Other laws are left alone.

use crate::middleware::Mistake;
use platebench_controller::pi::{Pi, PiGains, Tracking};
use platebench_wire::{Command, Configure, Gains, LawId, Sample};
use std::f32::consts::TAU;

/// What is missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Missing {
    /// Nothing.
    Nothing,
    /// The amplitude loop's integral.
    AmplitudeIntegral,
    /// The frequency loop's integral.
    FrequencyIntegral,
    /// What holds the integral of the drive while the amplifier is at its limit.
    AntiWindup,
    /// What keeps the frequency loop from dividing by a small Wd.
    SmallWd,
}

/// The firmware's own guards.
const SMALLEST_WD: f32 = 0.1;
const LARGEST_RATIO: f32 = 2.0;

/// Both loops.
pub(crate) struct Handwritten {
    missing: Missing,
    /// `None` where another law is asked for.
    configure: Option<Configure>,
    loops: Option<Loops>,
    sample: [f32; 3],
}

struct Loops {
    amplitude: Pi,
    frequency: Pi,
    offset: f32,
}

impl Handwritten {
    pub(crate) fn without(missing: Missing) -> Self {
        Self { missing, configure: None, loops: None, sample: [0.0; 3] }
    }

    /// Wq/Wd; `None` where the frequency rests.
    fn ratio(&self) -> Option<f32> {
        let [setpoint, wd, wq] = self.sample;
        if self.missing == Missing::SmallWd {
            return (wd != 0.0).then(|| wq / wd);
        }
        (setpoint > 0.0 && wd > SMALLEST_WD * setpoint).then(|| (wq / wd).clamp(-LARGEST_RATIO, LARGEST_RATIO))
    }
}

impl Mistake for Handwritten {
    fn configure(&mut self, configure: &mut Configure) {
        let own = matches!(configure.law, LawId::DqPi | LawId::DqPiFixed);
        if own {
            configure.law = LawId::DqPiFixed;
        }
        self.configure = own.then_some(*configure);
        self.loops = None;
    }

    fn configured(&mut self, gains: &Gains) {
        let Some(configure) = &self.configure else { return };
        let period = configure.period_us as f32 * 1e-6;
        let integral = |gain: f32, missing| if self.missing == missing { 0.0 } else { gain * period };
        let amplitude = PiGains {
            proportional: gains.amplitude_kp,
            integral_per_period: integral(gains.amplitude_ki, Missing::AmplitudeIntegral),
        };
        let frequency = PiGains {
            proportional: gains.frequency_kp,
            integral_per_period: integral(gains.frequency_ki, Missing::FrequencyIntegral),
        };
        let share = if self.missing == Missing::AntiWindup { 0.0 } else { 1.0 };
        self.loops = Some(Loops {
            amplitude: Pi::new(amplitude, Tracking { low: share, high: share }),
            frequency: Pi::new(frequency, Tracking::CONDITIONED),
            offset: 0.0,
        });
    }

    fn sample(&mut self, sample: &mut Sample) {
        self.sample = [sample.setpoint_um, sample.wd_um, sample.wq_um];
    }

    fn command(&mut self, command: &mut Command) {
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
