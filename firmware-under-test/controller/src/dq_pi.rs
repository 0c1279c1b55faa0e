//! Implements `dq-pi`, `dq-pi-fixed`, `dq-pi-euler`: two PI loops in the d-q frame (paper, section
//! V).
//!
//! Amplitude loop: `Wd_ref − Wd` gives the drive V; the plant is K1/(1 + τp) (equation 13).
//! Frequency loop: ω brings `Wq/Wd` to 0; the plant is −τ/(1 + τp) (equation 19). Because of the
//! minus sign, the error is `+Wq/Wd`.
//!
//! The paper, `dq-pi-euler` and `dq-pi-fixed` design the gains once, for the untouched plate. A
//! finger moves the plate's pole away from the controller's zero, so the error decays slowly (9 ms
//! under 2 N). `dq-pi` repeats the design for the present damping (*derived*). The last drive and
//! sample give λ ([`crate::envelope`]), and its σ gives both plants, K = b/σ and 1/σ, τ = 1/σ. One
//! sample cannot distinguish a finger from a late drive. A large change therefore needs two periods
//! in a row, and the smaller change counts. Configured gains are constant.
//!
//! The law compensates a configured loop delay (O. J. M. Smith's predictor, with the plate's
//! state). Both loops use W at the time at which their drive begins to act, predicted from λ and
//! the previous drive. λ is fitted to the samples, so a wrong b causes no static error.
//!
//! A step evaluates 4 exponentials of [`crate::envelope`], 9 with a loop delay.

use crate::envelope::{Complex, Drive, EnvelopeModel, PlateMode};
use crate::law::{Actuation, Law, Measurement};
use crate::loops::{self, AmplitudeLoop, FrequencyLoop};
use platebench_wire::{Configure, Gains, LawId, flags};

/// Fraction of the setpoint. For a smaller Wd, near rest, `Wq/Wd` is mostly noise.
const SMALLEST_WD: f32 = 0.1;
/// Limit of |Wq/Wd|, a phase of 63° at a detuning of two half bandwidths. Beyond it only the sign
/// of the ratio is useful.
const LARGEST_RATIO: f32 = 2.0;

/// Relative change of σ. A larger one means a new finger; a smaller one is drift.
const PLATE_CHANGE_SHARE: f32 = 0.25;
/// If the first drive after a start acted for a smaller fraction of the period, λ is mostly noise.
const MIN_ACTING_SHARE: f32 = 0.25;
/// Fraction of a small change that the law adopts in each period.
const TRACKING_SHARE: f32 = 0.125;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DqPi {
    amplitude: AmplitudeLoop,
    frequency: FrequencyLoop,
    schedule: Option<GainSchedule>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct GainSchedule {
    envelope: EnvelopeModel,
    period: f32,
    pole: f32,
    /// Present damping σ, 1/s.
    sigma: f32,
    /// Relative to the start frequency, rad/s.
    resonance: f32,
    /// Large change of σ that the next period has to confirm, 1/s; 0 if none.
    suspected_change: f32,
    previous: Complex,
    /// Drives of the last two periods, the latest first.
    drives: [Drive; 2],
    /// Loop delay from sampling to actuation, s.
    delay: f32,
    fixed_gains: bool,
}

impl GainSchedule {
    fn new(configure: &Configure, range: f32) -> Self {
        let period = loops::period_s(configure);
        let envelope = EnvelopeModel::new(configure.gain_um_per_vpp, configure.time_constant_s, range, period);
        let pole = loops::closed_loop_pole(configure);
        Self {
            envelope,
            period,
            pole,
            sigma: envelope.sigma,
            resonance: 0.0,
            suspected_change: 0.0,
            previous: Complex::default(),
            drives: [Drive::default(); 2],
            delay: loops::loop_delay_s(configure),
            fixed_gains: configure.gains.is_some(),
        }
    }

    fn is_sample_too_early(&self) -> bool {
        // Sensor noise causes a small drive at rest, so the test cannot be for 0.
        self.drives[1].vpp < 0.1 * self.drives[0].vpp && self.period - self.delay < MIN_ACTING_SHARE * self.period
    }

    /// Returns true if it adopted a large change of the damping.
    fn learn(&mut self, w: Complex) -> bool {
        let mode = PlateMode { sigma: self.sigma, resonance: self.drives[0].offset };
        let drives = [(self.drives[1], self.delay), (self.drives[0], self.period - self.delay)];
        let identified = self.envelope.identify(mode, self.previous, drives, w);
        let change = identified.sigma - self.sigma;
        self.track_resonance(identified.resonance);
        let least = PLATE_CHANGE_SHARE * self.sigma;
        let agreed = if change > 0.0 { change.min(self.suspected_change) } else { change.max(self.suspected_change) };
        let is_other_plate = change.abs() > least && agreed * change > 0.0 && agreed.abs() > least;
        if is_other_plate {
            self.sigma += agreed;
            self.suspected_change = 0.0;
        } else if change.abs() > least {
            self.suspected_change = change;
        } else {
            self.sigma += TRACKING_SHARE * change;
            self.suspected_change = 0.0;
        }
        is_other_plate
    }

    /// A late drive does not shift the identified resonance, so a large change is adopted at once.
    fn track_resonance(&mut self, identified: f32) {
        let change = identified - self.resonance;
        self.resonance +=
            if change.abs() > PLATE_CHANGE_SHARE * self.envelope.sigma { change } else { TRACKING_SHARE * change };
    }

    /// The measurement with W at the time at which the next drive begins to act.
    fn predict(&self, measurement: &Measurement) -> Measurement {
        let w = Complex::new(measurement.wd_um, measurement.wq_um);
        let mode = PlateMode { sigma: self.sigma, resonance: self.resonance };
        let w = self.envelope.propagate(mode, w, self.drives[0], self.delay);
        Measurement { wd_um: w.re, wq_um: w.im, ..*measurement }
    }
}

impl DqPi {
    pub(crate) fn design(configure: &Configure) -> (Law, Gains) {
        let (amplitude, frequency) = loops::loop_gains(configure);
        let frequency_loop = FrequencyLoop::new(frequency, configure);
        let scheduled = configure.law == LawId::DqPi && (configure.gains.is_none() || configure.loop_delay_us > 0);
        let law = Self {
            amplitude: AmplitudeLoop::new(amplitude, configure),
            frequency: frequency_loop,
            schedule: scheduled.then(|| GainSchedule::new(configure, frequency_loop.excitation.range())),
        };
        (Law::DqPi(law), loops::reported_gains(amplitude, frequency, loops::period_s(configure)))
    }

    pub(crate) fn step(&mut self, measurement: &Measurement) -> Actuation {
        let ahead = self.track_plate(measurement);
        let (drive_vpp, mut flags) = self.amplitude.step(ahead.setpoint_um - ahead.wd_um);
        flags |= match quadrature_ratio(&ahead) {
            Some(ratio) => self.frequency.step(ratio),
            None => flags::FREQUENCY_HELD,
        };
        if let Some(schedule) = &mut self.schedule {
            schedule.previous = Complex::new(measurement.wd_um, measurement.wq_um);
            let drive = Drive { vpp: drive_vpp, offset: self.frequency.excitation.offset_rad() };
            schedule.drives = [drive, schedule.drives[0]];
        }
        Actuation { drive_vpp, frequency_offset_hz: self.frequency.excitation.offset_hz(), flags }
    }

    fn track_plate(&mut self, measurement: &Measurement) -> Measurement {
        let Some(schedule) = &mut self.schedule else { return *measurement };
        if quadrature_ratio(measurement).is_none() || schedule.is_sample_too_early() {
            return schedule.predict(measurement);
        }
        let is_other_plate = schedule.learn(Complex::new(measurement.wd_um, measurement.wq_um));
        let ahead = schedule.predict(measurement);
        if schedule.fixed_gains {
            return ahead;
        }
        let GainSchedule { envelope, sigma, pole, period, .. } = *schedule;
        let (amplitude, frequency) = envelope.matched_gains(sigma, pole, period);
        self.amplitude.pi.set_gains(amplitude);
        self.frequency.pi.set_gains(frequency);
        if is_other_plate {
            // The integral restarts at the drive that holds the present amplitude, V = σ Wd / b.
            self.amplitude.pi.seed(sigma * ahead.wd_um / envelope.force);
        }
        ahead
    }
}

/// Wq/Wd; `None` if Wd is too small to divide by.
pub(crate) fn quadrature_ratio(measurement: &Measurement) -> Option<f32> {
    let divisible = measurement.setpoint_um > 0.0 && measurement.wd_um > SMALLEST_WD * measurement.setpoint_um;
    divisible.then(|| (measurement.wq_um / measurement.wd_um).clamp(-LARGEST_RATIO, LARGEST_RATIO))
}

#[cfg(test)]
mod tests;
