//! `dq-pi`, `dq-pi-fixed` and `dq-pi-euler`: two PI loops in the d-q frame (section V of the paper).
//!
//! Amplitude: the drive from `Wd_ref − Wd`, plant K1/(1 + τp) (equation 13). Frequency: ω from `Wq/Wd → 0`, plant −τ/(1 + τp)
//! (equation 19); the minus sign turns the loop's error `0 − Wq/Wd` into `+Wq/Wd`.
//!
//! The paper designs its gains once, for the untouched plate: `dq-pi-euler` and `dq-pi-fixed`. A finger moves the plate's pole away from the controller's
//! zero, and what is left of it is slow: 9 ms under 2 N. `dq-pi` is `dq-pi-fixed` until the plate shows another damping, and then the same design for that
//! one (*derived*): each period's drive and sample give λ ([`crate::envelope`]), and σ with it gives both plants, K = b/σ and τ = 1/σ. Two periods in a row
//! have to agree on a change of more than a quarter, and the smaller one counts: a single sample after a start is shown the same by a finger and by a
//! drive that acts late, the second tells them apart. With gains given there is nothing to schedule.
//!
//! A loop delay that `dq-pi` is told of is taken out of the loop (O. J. M. Smith's predictor, with a state instead of a model beside the plate): both loops look at W as
//! it will be when their drive begins to act, λ and the drive before being known. With the right delay and the right λ the response is that without delay, later by the
//! delay. Near the steady state λ is what makes the prediction agree with the samples, so that it leaves no static error whatever b is.
//!
//! In units of [`crate::envelope`]'s exponential a step takes 4, with a told delay 9.

use crate::envelope::{Complex, Drive, Envelope, Mode};
use crate::law::{Actuation, Law, Measurement};
use crate::loops::{self, AmplitudeLoop, FrequencyLoop};
use platebench_wire::{Configure, Gains, LawId, flags};

/// The frequency loop rests while Wd is below this fraction of the setpoint: `Wq/Wd` of a plate that hardly moves is noise, and
/// at 10 µs it is 0.34 where the envelope says 0.003.
const SMALLEST_WD: f32 = 0.1;
/// `Wq/Wd` is cut off here: 63°, a detuning of two half bandwidths; beyond it the ratio tells the direction and little else.
const LARGEST_RATIO: f32 = 2.0;

/// A damping that differs by more than this share from the one designed for is another plate, by less it is tracked.
const OTHER_PLATE: f32 = 0.25;
/// A drive that is told to act late may have acted for less than this share of the period when the first sample after a start is taken, which then says
/// nothing of λ but noise.
const SHORTEST_LOOK: f32 = 0.25;
/// Share of a new σ in the tracked one.
const TRACKED: f32 = 0.125;

/// State of both loops.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DqPi {
    amplitude: AmplitudeLoop,
    frequency: FrequencyLoop,
    schedule: Option<Schedule>,
}

/// What `dq-pi` knows of the plate.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Schedule {
    envelope: Envelope,
    period: f32,
    /// Of the closed loops, per period.
    pole: f32,
    /// 1/s.
    sigma: f32,
    /// The resonance in rad/s above the start frequency.
    resonance: f32,
    /// What the last period alone would have changed in σ, where that was much.
    suspected: f32,
    before: Complex,
    /// The last two drives, the latest first.
    drives: [Drive; 2],
    /// From sampling to actuation, as far as it was told, s.
    delay: f32,
    /// Given gains do not follow σ.
    fixed_gains: bool,
}

impl Schedule {
    fn new(configure: &Configure, range: f32) -> Self {
        let period = loops::period_s(configure);
        let envelope = Envelope::new(configure.gain_um_per_vpp, configure.time_constant_s, range, period);
        let pole = libm::expf(-3.0 * period / loops::response_s(configure, loops::MATCHED_RESPONSE_S));
        Self {
            envelope,
            period,
            pole,
            sigma: envelope.sigma,
            resonance: 0.0,
            suspected: 0.0,
            before: Complex::default(),
            drives: [Drive::default(); 2],
            delay: loops::told_delay_s(configure),
            fixed_gains: configure.gains.is_some(),
        }
    }

    /// True where the first drive of a start has acted for too short a time.
    fn has_seen_too_little(&self) -> bool {
        // At rest noise alone makes some drive.
        self.drives[1].vpp < 0.1 * self.drives[0].vpp && self.period - self.delay < SHORTEST_LOOK * self.period
    }

    /// Learns from the last period. True where the plate is another one.
    fn learn(&mut self, w: Complex) -> bool {
        let mode = Mode { sigma: self.sigma, resonance: self.drives[0].offset };
        let drives = [(self.drives[1], self.delay), (self.drives[0], self.period - self.delay)];
        let found = self.envelope.identify(mode, self.before, drives, w);
        let change = found.sigma - self.sigma;
        self.follow_the_resonance(found.resonance);
        let least = OTHER_PLATE * self.sigma;
        // The smaller one of two in the same direction.
        let agreed = if change > 0.0 { change.min(self.suspected) } else { change.max(self.suspected) };
        let other = change.abs() > least && agreed * change > 0.0 && agreed.abs() > least;
        if other {
            self.sigma += agreed;
            self.suspected = 0.0;
        } else if change.abs() > least {
            self.suspected = change;
        } else {
            self.sigma += TRACKED * change;
            self.suspected = 0.0;
        }
        other
    }

    /// A far resonance is taken at its word: no delay looks like one. A near one is tracked.
    fn follow_the_resonance(&mut self, found: f32) {
        let change = found - self.resonance;
        self.resonance += if change.abs() > OTHER_PLATE * self.envelope.sigma { change } else { TRACKED * change };
    }

    /// The plate as it will be when the drive begins to act that this sample leads to.
    fn predicted(&self, measurement: &Measurement) -> Measurement {
        let w = Complex::new(measurement.wd_um, measurement.wq_um);
        let mode = Mode { sigma: self.sigma, resonance: self.resonance };
        let w = self.envelope.after(mode, w, self.drives[0], self.delay);
        Measurement { wd_um: w.re, wq_um: w.im, ..*measurement }
    }
}

impl DqPi {
    pub(crate) fn design(configure: &Configure) -> (Law, Gains) {
        let (amplitude, frequency) = loops::gains(configure);
        let frequency_loop = FrequencyLoop::new(frequency, configure);
        let scheduled = configure.law == LawId::DqPi && (configure.gains.is_none() || configure.loop_delay_us > 0);
        let law = Self {
            amplitude: AmplitudeLoop::new(amplitude, configure),
            frequency: frequency_loop,
            schedule: scheduled.then(|| Schedule::new(configure, frequency_loop.excitation.range())),
        };
        (Law::DqPi(law), loops::told(amplitude, frequency, loops::period_s(configure)))
    }

    pub(crate) fn step(&mut self, measurement: &Measurement) -> Actuation {
        let ahead = self.follow_the_plate(measurement);
        let (drive_vpp, mut flags) = self.amplitude.step(ahead.setpoint_um - ahead.wd_um);
        flags |= match quadrature_ratio(&ahead) {
            Some(ratio) => self.frequency.step(ratio),
            None => flags::FREQUENCY_HELD,
        };
        if let Some(schedule) = &mut self.schedule {
            schedule.before = Complex::new(measurement.wd_um, measurement.wq_um);
            let drive = Drive { vpp: drive_vpp, offset: self.frequency.excitation.offset_rad() };
            schedule.drives = [drive, schedule.drives[0]];
        }
        Actuation { drive_vpp, frequency_offset_hz: self.frequency.excitation.offset_hz(), flags }
    }

    /// Learns from the last period; what the loops are to look at.
    fn follow_the_plate(&mut self, measurement: &Measurement) -> Measurement {
        let Some(schedule) = &mut self.schedule else { return *measurement };
        if quadrature_ratio(measurement).is_none() || schedule.has_seen_too_little() {
            return schedule.predicted(measurement);
        }
        let other = schedule.learn(Complex::new(measurement.wd_um, measurement.wq_um));
        let ahead = schedule.predicted(measurement);
        if schedule.fixed_gains {
            return ahead;
        }
        let Schedule { envelope, sigma, pole, period, .. } = *schedule;
        let (amplitude, frequency) = envelope.matched_gains(sigma, pole, period);
        self.amplitude.pi.set_gains(amplitude);
        self.frequency.pi.set_gains(frequency);
        if other {
            // What a loop that was matched from the start would have here: the drive that holds the present amplitude.
            self.amplitude.pi.seed(sigma * ahead.wd_um / envelope.force);
        }
        ahead
    }
}

/// `Wq/Wd`, cut off; `None` where Wd is too small to divide by.
pub(crate) fn quadrature_ratio(measurement: &Measurement) -> Option<f32> {
    let divisible = measurement.setpoint_um > 0.0 && measurement.wd_um > SMALLEST_WD * measurement.setpoint_um;
    divisible.then(|| (measurement.wq_um / measurement.wd_um).clamp(-LARGEST_RATIO, LARGEST_RATIO))
}

#[cfg(test)]
mod tests;
