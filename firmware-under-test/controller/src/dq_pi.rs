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
    /// What the last period alone would have changed in σ, where that was much.
    suspected: f32,
    before: Complex,
    drive: Drive,
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
            suspected: 0.0,
            before: Complex::default(),
            drive: Drive::default(),
        }
    }

    /// Learns from the last period. True where the plate is another one.
    fn learn(&mut self, w: Complex) -> bool {
        let mode = Mode { sigma: self.sigma, resonance: self.drive.offset };
        let drives = [(self.drive, self.period), (Drive::default(), 0.0)];
        let change = self.envelope.identify(mode, self.before, drives, w).sigma - self.sigma;
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
}

impl DqPi {
    pub(crate) fn design(configure: &Configure) -> (Law, Gains) {
        let (amplitude, frequency) = loops::gains(configure);
        let frequency_loop = FrequencyLoop::new(frequency, configure);
        let scheduled = configure.law == LawId::DqPi && configure.gains.is_none();
        let law = Self {
            amplitude: AmplitudeLoop::new(amplitude, configure),
            frequency: frequency_loop,
            schedule: scheduled.then(|| Schedule::new(configure, frequency_loop.excitation.range())),
        };
        (Law::DqPi(law), loops::told(amplitude, frequency, loops::period_s(configure)))
    }

    pub(crate) fn step(&mut self, measurement: &Measurement) -> Actuation {
        self.follow_the_plate(measurement);
        let (drive_vpp, mut flags) = self.amplitude.step(measurement.setpoint_um - measurement.wd_um);
        flags |= match quadrature_ratio(measurement) {
            Some(ratio) => self.frequency.step(ratio),
            None => flags::FREQUENCY_HELD,
        };
        if let Some(schedule) = &mut self.schedule {
            schedule.before = Complex::new(measurement.wd_um, measurement.wq_um);
            schedule.drive = Drive { vpp: drive_vpp, offset: self.frequency.excitation.offset_rad() };
        }
        Actuation { drive_vpp, frequency_offset_hz: self.frequency.excitation.offset_hz(), flags }
    }

    fn follow_the_plate(&mut self, measurement: &Measurement) {
        let Some(schedule) = &mut self.schedule else { return };
        if quadrature_ratio(measurement).is_none() {
            return;
        }
        let other = schedule.learn(Complex::new(measurement.wd_um, measurement.wq_um));
        let Schedule { envelope, sigma, pole, period, .. } = *schedule;
        let (amplitude, frequency) = envelope.matched_gains(sigma, pole, period);
        self.amplitude.pi.set_gains(amplitude);
        self.frequency.pi.set_gains(frequency);
        if other {
            // What a loop that was matched from the start would have here: the drive that holds the present amplitude.
            self.amplitude.pi.seed(sigma * measurement.wd_um / envelope.force);
        }
    }
}

/// `Wq/Wd`, cut off; `None` where Wd is too small to divide by.
pub(crate) fn quadrature_ratio(measurement: &Measurement) -> Option<f32> {
    let divisible = measurement.setpoint_um > 0.0 && measurement.wd_um > SMALLEST_WD * measurement.setpoint_um;
    divisible.then(|| (measurement.wq_um / measurement.wd_um).clamp(-LARGEST_RATIO, LARGEST_RATIO))
}

#[cfg(test)]
mod tests;
