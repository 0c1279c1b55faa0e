//! `deadbeat`: learns the plate from its first sample, puts W on the setpoint with the next drive, and then hands over to two PI loops.
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
//! *Derived*, not published for this plate; the idea is Kalman's of a state brought to rest in a finite number of periods. N/m is a constant of the plate, so
//! only λ = −σ − jΔω is unknown, and one complex sample gives it ([`crate::envelope`]).
//!
//! * **First period.** Nothing is known of the finger. The drive takes the untouched plate nearly to the setpoint: any finger and any detuning only leave it
//!   lower.
//! * **Each further period of steering.** λ from the last period's drive and its sample; then V and ω for which W is the setpoint, real, at the period's end. At the
//!   amplifier's limit that is the fastest there is, from period to period; at the end of the slew |W| goes before its angle.
//! * **Holding.** PI loops matched to the zero-order hold as in `dq-pi`, with the plant that their own integrals tell: σ = bV/W, the excitation is the resonance.
//!   They begin with the integrals that the steady state will have, so that nothing jumps.
//! * **Prediction.** Each sample is compared with what the last drive should have led to. Where it is off by more than noise explains, the plate has changed and is
//!   learnt again, or the drive acts later than thought: a loop delay of up to nine tenths of a period that explains both samples is taken over
//!   and from then on reckoned with. Where four in a row are missed, the law falls back for twenty periods to its PI loops and raises
//!   [`flags::PREDICTION_MISSED`].
//! * **A told delay** is reckoned with from the first drive on, and a first sample that speaks of much damping is then a heavy finger's. A delay told wrong is looked for
//!   as an untold one is, once a prediction was missed.
//!
//! The instructions of a step are bounded. In units of [`crate::envelope`]'s exponential, some 100 multiplications and additions: 1 while holding, at most 14
//! while steering, 19 with a delay; 100 more in a step that looks for one, which is at most every period of a start that goes wrong.

use crate::envelope::{Bounds, Complex, Drive, Envelope, Mode};
use crate::law::{Actuation, Law, Measurement};
use crate::loops::{self, Excitation};
use crate::pi::{Pi, Tracking};
use platebench_wire::{Configure, Gains, flags};

/// Share of the setpoint that the first drive aims at on the untouched plate: the 5 % band forgives a plate 8 % better than its nominal gain.
const FIRST_AIM: f32 = 0.97;
/// 5 % response time of the holding loops, s.
const HOLDING_RESPONSE_S: f32 = 3e-3;
/// A sample may be this share of the setpoint away from its prediction: what half a percent of noise makes of λ and of the prediction is a third of it.
const TOLERANCE: f32 = 0.08;
/// A setpoint that moves by more than this share is steered to, by less it is followed.
const SETPOINT_STEP: f32 = 0.02;
/// On the setpoint: this close to it, as a share.
const ARRIVED: f32 = 0.03;
/// A plate that moves less than this share of the setpoint is at rest.
const AT_REST: f32 = 0.1;
/// Periods of steering without arriving, at the amplifier's limit say, before the PI loops take over.
const LONGEST_STEERING: u8 = 12;
/// Drives that may end beside the setpoint before the PI loops take over.
const ATTEMPTS: u8 = 3;
/// A missed prediction counts this much against the law, each other one takes one away …
const MISSED_WEIGHT: u8 = 2;
/// … and at this count it falls back: four in a row. A start with an unknown delay misses one or two.
const LOST_FAITH: u8 = 8;
/// Periods of the fallback.
const PROBATION: u8 = 20;
/// A first sample that speaks of more damping than this, as a multiple of the untouched plate's, is taken for a delay; 2.25 N.
const HEAVIEST_FINGER: f32 = 2.5;
/// The loop delay is looked for up to this share of the period.
const LONGEST_DELAY: f32 = 0.9;
/// A drive that is told to act late may have acted for so short a time that the first sample after a start says little of λ: with less than this share of the
/// period the next one is waited for. With a third of it 0.5 % of noise becomes 15 % of overshoot.
const SHORTEST_LOOK: f32 = 0.45;
/// Steps of the search for the delay.
const DELAY_ITERATIONS: u32 = 6;
/// As `dq-pi`'s.
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
    /// Drives that were to end on the setpoint and did not.
    attempts: u8,
    /// The law began to move the plate, not the plate by itself: only then is a missed prediction a sign of delay.
    commanded: bool,
}

impl Steering {
    const fn commanded() -> Self {
        Self { periods: 0, attempts: 0, commanded: true }
    }
}

/// State of the law.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deadbeat {
    envelope: Envelope,
    period: f32,
    limit_vpp: f32,
    /// Loops with given gains do not follow the plate.
    fixed_gains: bool,
    /// Pole of the holding loops per period.
    holding_pole: f32,
    amplitude: Pi,
    frequency: Pi,
    excitation: Excitation,
    phase: Phase,
    mode: Mode,
    /// Sampling to actuation, s, as far as is known.
    delay: f32,
    /// The delay is the bench's word: the first sample is no reason to doubt it, a missed prediction is.
    told: bool,
    /// The last two samples, the latest first.
    samples: [Complex; 2],
    /// The last three drives, the latest first.
    drives: [Drive; 3],
    /// What this sample should be.
    expected: Complex,
    setpoint: f32,
    /// Missed predictions, weighed against the others.
    misses: u8,
    /// Periods that are left of the fallback.
    probation: u8,
}

impl Deadbeat {
    pub(crate) fn design(configure: &Configure) -> (Law, Gains) {
        let period = loops::period_s(configure);
        let excitation = Excitation::new(configure);
        let envelope = Envelope::new(configure.gain_um_per_vpp, configure.time_constant_s, excitation.range(), period);
        let holding_pole = libm::expf(-3.0 * period / loops::response_s(configure, HOLDING_RESPONSE_S));
        let (amplitude, frequency) = match configure.gains {
            Some(_) => loops::gains(configure),
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
            delay: loops::told_delay_s(configure),
            told: configure.loop_delay_us > 0,
            samples: [Complex::default(); 2],
            drives: [Drive::default(); 3],
            expected: Complex::default(),
            setpoint: 0.0,
            misses: 0,
            probation: 0,
        };
        (Law::Deadbeat(law), loops::told(amplitude, frequency, period))
    }

    pub(crate) fn step(&mut self, measurement: &Measurement) -> Actuation {
        let w = Complex::new(measurement.wd_um, measurement.wq_um);
        let setpoint = measurement.setpoint_um;
        let missed = setpoint > 0.0 && (w - self.expected).norm() > TOLERANCE * setpoint;
        self.keep_faith(missed);
        let mut flags = 0;
        if setpoint > 0.0 {
            self.choose(w, setpoint, missed);
        } else {
            self.phase = Phase::Rest;
        }
        // Where the plate will be when this step's drive begins to act.
        let begins = self.envelope.after(self.mode, w, self.drives[0], self.delay);
        let drive = match self.phase {
            Phase::Rest => {
                flags |= flags::FREQUENCY_HELD;
                Drive { vpp: 0.0, offset: self.excitation.offset_rad() }
            }
            Phase::Learning | Phase::Steering(_) => self.steer(begins, setpoint, &mut flags),
            Phase::Holding => self.hold(begins, setpoint, &mut flags),
        };
        if self.probation > 0 {
            flags |= flags::PREDICTION_MISSED;
        }
        self.expected = self.envelope.after(self.mode, begins, drive, self.period - self.delay);
        self.samples = [w, self.samples[0]];
        self.drives = [drive, self.drives[0], self.drives[1]];
        self.setpoint = setpoint;
        Actuation { drive_vpp: drive.vpp, frequency_offset_hz: self.excitation.offset_hz(), flags }
    }

    /// One missed prediction in three periods is borne, several in a row are not.
    fn keep_faith(&mut self, missed: bool) {
        self.probation = self.probation.saturating_sub(1);
        self.misses = if missed { self.misses + MISSED_WEIGHT } else { self.misses.saturating_sub(1) };
        if self.misses >= LOST_FAITH {
            self.misses = 0;
            self.probation = PROBATION;
        }
    }

    /// What to do next, and with which idea of the plate.
    fn choose(&mut self, w: Complex, setpoint: f32, missed: bool) {
        self.phase = match self.phase {
            Phase::Rest => {
                if w.norm() < AT_REST * setpoint {
                    self.mode = self.envelope.nominal(self.mode.resonance);
                }
                Phase::Learning
            }
            Phase::Learning if self.has_seen_too_little() => Phase::Learning,
            Phase::Learning => {
                self.learn(w);
                Phase::Steering(Steering::commanded())
            }
            Phase::Steering(steering) => self.go_on(steering, w, setpoint, missed),
            Phase::Holding if missed && self.probation == 0 => {
                self.mode = self.identified(w);
                Phase::Steering(Steering { commanded: false, ..Steering::commanded() })
            }
            Phase::Holding if (setpoint - self.setpoint).abs() > SETPOINT_STEP * setpoint.max(self.setpoint) => {
                Phase::Steering(Steering::commanded())
            }
            Phase::Holding => {
                self.follow_the_integrals(setpoint);
                Phase::Holding
            }
        };
    }

    /// True where the first drive of a start has acted for too short a time.
    fn has_seen_too_little(&self) -> bool {
        self.told && self.drives[1].vpp == 0.0 && self.period - self.delay < SHORTEST_LOOK * self.period
    }

    /// The first sample after a start. More damping than a heavy finger's is no finger but a drive that acted late.
    fn learn(&mut self, w: Complex) {
        let untouched = self.mode;
        self.mode = self.identified(w);
        let from_rest = self.samples[0].norm() < AT_REST * w.norm();
        if self.mode.sigma > HEAVIEST_FINGER * self.envelope.sigma && from_rest && !self.told {
            // |W| = bV/σ (1 − e^(−σ(T − d)))
            let acted = -libm::logf(1.0 - w.norm() * untouched.sigma / (self.envelope.force * self.drives[0].vpp))
                / untouched.sigma;
            if acted >= (1.0 - LONGEST_DELAY) * self.period && acted < self.period {
                self.delay = self.period - acted;
                self.mode = untouched;
                self.mode = self.identified(w);
            }
        }
    }

    /// Another period of steering, or the end of it.
    fn go_on(&mut self, steering: Steering, w: Complex, setpoint: f32, missed: bool) -> Phase {
        let off = |w: Complex| (w.norm() - setpoint).abs().max(w.im.abs());
        let arrived = off(w) < ARRIVED * setpoint;
        let Steering { periods, attempts, commanded } = steering;
        // Where the limits did not let the last drive end on the setpoint, it was no attempt.
        let attempts = attempts + u8::from(missed || off(self.expected) < ARRIVED * setpoint);
        let gives_up = attempts >= ATTEMPTS || periods >= LONGEST_STEERING;
        if missed
            && commanded
            && !gives_up
            && let Some(delay) = self.looked_for_delay(w, setpoint)
        {
            self.delay = delay;
        }
        self.mode = self.identified(w);
        if arrived || gives_up {
            return self.hand_over(setpoint);
        }
        Phase::Steering(Steering { periods: periods + 1, attempts, commanded })
    }

    /// λ of the last period.
    fn identified(&self, w: Complex) -> Mode {
        let drives = [(self.drives[1], self.delay), (self.drives[0], self.period - self.delay)];
        self.envelope.identify(self.mode, self.samples[0], drives, w)
    }

    /// The loop delay with which the last period but one explains the last one.
    fn looked_for_delay(&self, w: Complex, setpoint: f32) -> Option<f32> {
        let predicted = |delay: f32| {
            let drives = [(self.drives[2], delay), (self.drives[1], self.period - delay)];
            let mode = self.envelope.identify(self.mode, self.samples[1], drives, self.samples[0]);
            let begins = self.envelope.after(mode, self.samples[0], self.drives[1], delay);
            self.envelope.after(mode, begins, self.drives[0], self.period - delay)
        };
        let explains = |delay: f32| (predicted(delay) - w).norm() < 0.5 * TOLERANCE * setpoint;
        // A finger heavier than was thought possible.
        if explains(0.0) {
            return Some(0.0);
        }
        let excess = |delay: f32| predicted(delay).norm() - w.norm();
        // False position with Illinois's remedy for an end that stays.
        let (mut low, mut high) = (0.0, LONGEST_DELAY * self.period);
        let (mut below, mut above) = (excess(low), excess(high));
        if below * above > 0.0 {
            return None;
        }
        let mut found = low;
        for _ in 0..DELAY_ITERATIONS {
            found = low - below * (high - low) / (above - below);
            let there = excess(found);
            if there * above > 0.0 {
                (high, above, below) = (found, there, below * 0.5);
            } else {
                (low, below, above) = (found, there, above * 0.5);
            }
        }
        (found.is_finite() && explains(found)).then_some(found)
    }

    /// The loops start where they will stay if nothing changes.
    fn hand_over(&mut self, setpoint: f32) -> Phase {
        self.amplitude.seed((self.mode.sigma * setpoint / self.envelope.force).min(self.limit_vpp));
        self.frequency.seed(self.mode.resonance);
        Phase::Holding
    }

    fn steer(&mut self, begins: Complex, setpoint: f32, flags: &mut u8) -> Drive {
        let (lowest_offset, highest_offset) = self.excitation.reach();
        let bounds = Bounds { limit_vpp: self.limit_vpp, lowest_offset, highest_offset };
        let target = if self.phase == Phase::Learning { FIRST_AIM * setpoint } else { setpoint };
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
        if begins.re > AT_REST * setpoint {
            let (low, high) = self.excitation.reach();
            let offset = self.frequency.step((begins.im / begins.re).clamp(-LARGEST_RATIO, LARGEST_RATIO), low, high);
            *flags |= self.excitation.move_to(offset);
        } else {
            *flags |= flags::FREQUENCY_HELD;
        }
        Drive { vpp, offset: self.excitation.offset_rad() }
    }

    /// The plate that the integrals tell, and the gains that suit it.
    fn follow_the_integrals(&mut self, setpoint: f32) {
        let sigma = self.envelope.force * self.amplitude.integral() / setpoint;
        self.mode = self.envelope.clamped(Mode { sigma, resonance: self.frequency.integral() });
        if !self.fixed_gains {
            let (amplitude, frequency) = self.envelope.matched_gains(self.mode.sigma, self.holding_pole, self.period);
            self.amplitude.set_gains(amplitude);
            self.frequency.set_gains(frequency);
        }
    }
}

#[cfg(test)]
mod tests;
