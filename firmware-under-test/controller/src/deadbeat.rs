//! Implements `deadbeat`: identifies the plate, steers to the setpoint, holds it with two PI loops.
//!
//! ```text
//!          setpoint             one sample later                 as predicted, on the setpoint
//!   Rest ───────────▶ Learning ─────────────────▶ Steering ──────────────────────────────────▶ Holding
//!    ▲                                            ▲  │   ▲ limit, slew, or not as predicted       │
//!    │ no setpoint (from anywhere)                │  └───┘                                       │
//!    │                                            └──────────────────────────────────────────────┘
//!                                                   the setpoint steps, or a sample far from its prediction
//! ```
//!
//! *Derived*, not published for this plate, after Kalman's idea to bring a state to rest in a
//! finite number of periods. Only λ = −σ − jΔω is unknown, because N/m is a constant of the plate.
//! One complex sample gives λ ([`crate::envelope`]).
//!
//! * **Learning.** The finger is unknown. The drive brings the untouched plate nearly to the
//!   setpoint; a finger or a detuning only lowers the amplitude.
//! * **Steering.** The last drive and its sample give λ. From λ the law computes the V and ω that
//!   bring W to the setpoint, with Wq = 0, at the end of the period. At the slew limit of ω, |W|
//!   has priority over its angle.
//! * **Holding.** Two PI loops start with the integrals of the steady state. Their gains are
//!   matched to the zero-order hold for the plant that the integrals show: σ = bV/W, and the
//!   resonance is the excitation frequency.
//! * **Prediction.** Noise does not explain a large error of a prediction. Either the plate has
//!   changed and is identified again, or the drive acts late and the law adopts the loop delay that
//!   explains the last two samples. After four misses in a row the law uses its PI loops for twenty
//!   periods and raises [`flags::PREDICTION_MISSED`].
//! * **Configured delay.** It applies from the first drive on. A high damping in the first sample
//!   then means a heavy finger, not a late drive.
//!
//! A step needs a bounded number of exponentials of [`crate::envelope`], each about 100
//! multiplications and additions: 1 while holding, at most 15 while steering, 19 if the first
//! sample shows a delay, and 90 more in a step that searches the delay.

use crate::envelope::{Complex, Drive, DriveBounds, EnvelopeModel, PlateMode};
use crate::law::{Actuation, Law, Measurement};
use crate::loops::{self, Excitation};
use crate::pi::{Pi, Tracking};
use platebench_wire::{Configure, Gains, flags};

/// Fraction of the setpoint at which the first drive aims, so that 8 % more gain stays within 5 %.
const FIRST_TARGET_SHARE: f32 = 0.97;
/// Allowed error of a prediction, as a fraction of the setpoint or of the last amplitude if it is
/// larger. Noise of 0.5 % causes an error of a third of this tolerance.
const PREDICTION_TOLERANCE: f32 = 0.08;
/// Relative change of the setpoint. The law steers to a setpoint that changes by more; the PI loops
/// follow a smaller change.
const SETPOINT_STEP: f32 = 0.02;
/// Largest distance of W from the setpoint at which steering ends, as a fraction of the setpoint.
const ARRIVAL_BAND: f32 = 0.03;
/// Largest amplitude of a plate at rest, as a fraction of the setpoint.
const REST_BAND: f32 = 0.1;
/// After this number of steering periods with a drive above 0 V, the PI loops take over, for
/// example if the drive limit is too low for the setpoint.
const MAX_STEERING_PERIODS: u8 = 12;
/// After this number of drives that aim at the setpoint, the PI loops take over.
const MAX_ATTEMPTS: u8 = 3;
/// A missed prediction adds this weight to the score; every other prediction subtracts 1.
const MISSED_WEIGHT: u8 = 2;
/// Four missed predictions in a row start the fallback. A start with unknown delay misses one or
/// two.
const FALLBACK_MISS_SCORE: u8 = 8;
const FALLBACK_PERIODS: u8 = 20;
/// Largest σ/σ0 in the first sample that a finger explains (2.25 N). Above it, a delay is assumed.
const MAX_FINGER_DAMPING: f32 = 2.5;
/// Largest loop delay that the law searches, as a fraction of the period.
const MAX_DELAY_SHARE: f32 = 0.9;
/// With a configured delay, the law ignores the first sample if the drive acted for less than this
/// fraction of a period. With a third of a period, noise of 0.5 % would cause 15 % of overshoot.
const MIN_ACTING_SHARE: f32 = 0.45;
const DELAY_ITERATIONS: u32 = 6;
const LARGEST_RATIO: f32 = 2.0;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    Rest,
    Learning,
    Steering(Steering),
    Holding,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Steering {
    periods: u8,
    attempts: u8,
    /// True if the law itself started the motion, not a disturbance. Only then can a loop delay
    /// explain a missed prediction.
    is_commanded: bool,
}

impl Steering {
    const fn commanded() -> Self {
        Self { periods: 0, attempts: 0, is_commanded: true }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deadbeat {
    envelope: EnvelopeModel,
    period: f32,
    limit_vpp: f32,
    fixed_gains: bool,
    /// Closed-loop pole of the holding loops, per period.
    holding_pole: f32,
    amplitude: Pi,
    frequency: Pi,
    excitation: Excitation,
    phase: Phase,
    mode: PlateMode,
    /// Loop delay from sampling to actuation, s.
    delay: f32,
    /// If the delay is configured, only a missed prediction changes it, not the first sample.
    is_delay_given: bool,
    /// Samples of W and drives of the last periods, the latest first.
    samples: [Complex; 2],
    drives: [Drive; 3],
    expected: Complex,
    setpoint: f32,
    miss_score: u8,
    fallback_periods: u8,
}

impl Deadbeat {
    pub(crate) fn design(configure: &Configure) -> (Law, Gains) {
        let period = loops::period_s(configure);
        let excitation = Excitation::new(configure);
        let envelope =
            EnvelopeModel::new(configure.gain_um_per_vpp, configure.time_constant_s, excitation.range(), period);
        let holding_pole = loops::closed_loop_pole(configure);
        let (amplitude, frequency) = match configure.gains {
            Some(_) => loops::loop_gains(configure),
            None => envelope.matched_gains(envelope.sigma, holding_pole, period),
        };
        let law = Self {
            envelope,
            period,
            limit_vpp: configure.drive_limit_vpp,
            fixed_gains: configure.gains.is_some(),
            holding_pole,
            amplitude: Pi::new(amplitude, loops::AMPLITUDE_TRACKING),
            frequency: Pi::new(frequency, Tracking::CONDITIONED),
            excitation,
            phase: Phase::Rest,
            mode: envelope.nominal(0.0),
            delay: loops::loop_delay_s(configure),
            is_delay_given: configure.loop_delay_us > 0,
            samples: [Complex::default(); 2],
            drives: [Drive::default(); 3],
            expected: Complex::default(),
            setpoint: 0.0,
            miss_score: 0,
            fallback_periods: 0,
        };
        (Law::Deadbeat(law), loops::reported_gains(amplitude, frequency, period))
    }

    pub(crate) fn step(&mut self, measurement: &Measurement) -> Actuation {
        let w = Complex::new(measurement.wd_um, measurement.wq_um);
        let setpoint = measurement.setpoint_um;
        let missed = setpoint > 0.0 && (w - self.expected).norm() > self.tolerance(setpoint);
        self.update_miss_score(missed);
        let mut flags = 0;
        if setpoint > 0.0 {
            self.choose_phase(w, setpoint, missed);
        } else {
            self.phase = Phase::Rest;
        }
        // W at the time at which this step's drive begins to act.
        let begins = self.envelope.propagate(self.mode, w, self.drives[0], self.delay);
        let drive = match self.phase {
            Phase::Rest => {
                flags |= flags::FREQUENCY_HELD;
                Drive { vpp: 0.0, offset: self.excitation.offset_rad() }
            }
            Phase::Learning | Phase::Steering(_) => self.steer(begins, setpoint, &mut flags),
            Phase::Holding => self.hold(begins, setpoint, &mut flags),
        };
        if self.fallback_periods > 0 {
            flags |= flags::PREDICTION_MISSED;
        }
        self.expected = self.envelope.propagate(self.mode, begins, drive, self.period - self.delay);
        self.samples = [w, self.samples[0]];
        self.drives = [drive, self.drives[0], self.drives[1]];
        self.setpoint = setpoint;
        Actuation { drive_vpp: drive.vpp, frequency_offset_hz: self.excitation.offset_hz(), flags }
    }

    fn tolerance(&self, setpoint: f32) -> f32 {
        PREDICTION_TOLERANCE * self.samples[0].norm().max(setpoint)
    }

    /// One missed prediction in three periods never starts the fallback.
    fn update_miss_score(&mut self, missed: bool) {
        self.fallback_periods = self.fallback_periods.saturating_sub(1);
        self.miss_score = if missed { self.miss_score + MISSED_WEIGHT } else { self.miss_score.saturating_sub(1) };
        if self.miss_score >= FALLBACK_MISS_SCORE {
            self.miss_score = 0;
            self.fallback_periods = FALLBACK_PERIODS;
        }
    }

    fn choose_phase(&mut self, w: Complex, setpoint: f32, missed: bool) {
        self.phase = match self.phase {
            Phase::Rest => {
                if w.norm() < REST_BAND * setpoint {
                    self.mode = self.envelope.nominal(self.mode.resonance);
                }
                Phase::Learning
            }
            Phase::Learning if self.is_sample_too_early() => Phase::Learning,
            Phase::Learning => {
                self.learn_from_first_sample(w);
                Phase::Steering(Steering::commanded())
            }
            Phase::Steering(steering) => self.continue_steering(steering, w, setpoint, missed),
            Phase::Holding if missed && self.fallback_periods == 0 => {
                self.mode = self.identify_mode(w);
                Phase::Steering(Steering { is_commanded: false, ..Steering::commanded() })
            }
            Phase::Holding if (setpoint - self.setpoint).abs() > SETPOINT_STEP * setpoint.max(self.setpoint) => {
                Phase::Steering(Steering::commanded())
            }
            Phase::Holding => {
                self.adapt_to_integrals(setpoint);
                Phase::Holding
            }
        };
    }

    fn is_sample_too_early(&self) -> bool {
        self.is_delay_given && self.drives[1].vpp == 0.0 && self.period - self.delay < MIN_ACTING_SHARE * self.period
    }

    /// Above the damping of a heavy finger, the law assumes a late drive and computes the delay.
    fn learn_from_first_sample(&mut self, w: Complex) {
        let untouched = self.mode;
        self.mode = self.identify_mode(w);
        let from_rest = self.samples[0].norm() < REST_BAND * w.norm();
        if self.mode.sigma > MAX_FINGER_DAMPING * self.envelope.sigma && from_rest && !self.is_delay_given {
            // The untouched plate from rest, driven for T − d: |W| = bV/σ (1 − e^(−σ(T − d))).
            let acted = -libm::logf(1.0 - w.norm() * untouched.sigma / (self.envelope.force * self.drives[0].vpp))
                / untouched.sigma;
            if acted >= (1.0 - MAX_DELAY_SHARE) * self.period && acted < self.period {
                self.delay = self.period - acted;
                self.mode = untouched;
                self.mode = self.identify_mode(w);
            }
        }
    }

    fn continue_steering(&mut self, steering: Steering, w: Complex, setpoint: f32, missed: bool) -> Phase {
        let off = |w: Complex| (w.norm() - setpoint).abs().max(w.im.abs());
        let arrived = off(w) < ARRIVAL_BAND * setpoint;
        let Steering { periods, attempts, is_commanded } = steering;
        // A drive at a limit is not counted, because its prediction was off the setpoint.
        let attempts = attempts + u8::from(missed || off(self.expected) < ARRIVAL_BAND * setpoint);
        let gives_up = attempts >= MAX_ATTEMPTS || periods >= MAX_STEERING_PERIODS;
        if missed
            && is_commanded
            && !gives_up
            && let Some(delay) = self.find_delay(w, setpoint)
        {
            self.delay = delay;
        }
        self.mode = self.identify_mode(w);
        if arrived || gives_up {
            return self.start_holding(setpoint);
        }
        // At 0 V the plate decays to a lower setpoint, so these periods are not counted.
        let periods = periods + u8::from(self.drives[0].vpp > 0.0);
        Phase::Steering(Steering { periods, attempts, is_commanded })
    }

    fn identify_mode(&self, w: Complex) -> PlateMode {
        let drives = [(self.drives[1], self.delay), (self.drives[0], self.period - self.delay)];
        self.envelope.identify(self.mode, self.samples[0], drives, w)
    }

    fn find_delay(&self, w: Complex, setpoint: f32) -> Option<f32> {
        let predicted = |delay: f32| {
            let drives = [(self.drives[2], delay), (self.drives[1], self.period - delay)];
            let mode = self.envelope.identify(self.mode, self.samples[1], drives, self.samples[0]);
            let begins = self.envelope.propagate(mode, self.samples[0], self.drives[1], delay);
            self.envelope.propagate(mode, begins, self.drives[0], self.period - delay)
        };
        let explains = |delay: f32| (predicted(delay) - w).norm() < 0.5 * self.tolerance(setpoint);
        // If a delay of 0 explains the samples, the cause is a finger above `MAX_FINGER_DAMPING`.
        if explains(0.0) {
            return Some(0.0);
        }
        let excess = |delay: f32| predicted(delay).norm() - w.norm();
        // Root of `excess` by false position, Illinois variant.
        let (mut low, mut high) = (0.0, MAX_DELAY_SHARE * self.period);
        let (mut below, mut above) = (excess(low), excess(high));
        if below * above > 0.0 {
            return None;
        }
        let mut delay = low;
        for _ in 0..DELAY_ITERATIONS {
            delay = low - below * (high - low) / (above - below);
            let there = excess(delay);
            if there * above > 0.0 {
                (high, above, below) = (delay, there, below * 0.5);
            } else {
                (low, below, above) = (delay, there, above * 0.5);
            }
        }
        (delay.is_finite() && explains(delay)).then_some(delay)
    }

    fn start_holding(&mut self, setpoint: f32) -> Phase {
        self.amplitude.seed((self.mode.sigma * setpoint / self.envelope.force).min(self.limit_vpp));
        self.frequency.seed(self.mode.resonance);
        Phase::Holding
    }

    fn steer(&mut self, begins: Complex, setpoint: f32, flags: &mut u8) -> Drive {
        let (lowest_offset, highest_offset) = self.excitation.offset_limits();
        let bounds = DriveBounds { limit_vpp: self.limit_vpp, lowest_offset, highest_offset };
        let target = if self.phase == Phase::Learning { FIRST_TARGET_SHARE * setpoint } else { setpoint };
        let aim = self.envelope.steer(self.mode, begins, target, &bounds, self.period);
        if aim.drive.vpp >= self.limit_vpp {
            *flags |= flags::SATURATED;
        }
        *flags |= self.excitation.move_to(aim.drive.offset);
        aim.drive
    }

    fn hold(&mut self, begins: Complex, setpoint: f32, flags: &mut u8) -> Drive {
        let vpp = self.amplitude.step(setpoint - begins.re, 0.0, self.limit_vpp);
        if vpp >= self.limit_vpp {
            *flags |= flags::SATURATED;
        }
        if begins.re > REST_BAND * setpoint {
            let (low, high) = self.excitation.offset_limits();
            let offset = self.frequency.step((begins.im / begins.re).clamp(-LARGEST_RATIO, LARGEST_RATIO), low, high);
            *flags |= self.excitation.move_to(offset);
        } else {
            *flags |= flags::FREQUENCY_HELD;
        }
        Drive { vpp, offset: self.excitation.offset_rad() }
    }

    fn adapt_to_integrals(&mut self, setpoint: f32) {
        let sigma = self.envelope.force * self.amplitude.integral() / setpoint;
        self.mode = self.envelope.clamped(PlateMode { sigma, resonance: self.frequency.integral() });
        if !self.fixed_gains {
            let (amplitude, frequency) = self.envelope.matched_gains(self.mode.sigma, self.holding_pole, self.period);
            self.amplitude.set_gains(amplitude);
            self.frequency.set_gains(frequency);
        }
    }
}

#[cfg(test)]
mod tests;
