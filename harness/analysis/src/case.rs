//! What is analysed: a law, its plate and its surroundings; and the law's linear form there.

use crate::controller::{Channel, Controller, Integral, Pi};
use crate::plant::{Plant, steady};
use platebench_plate::{Conditions, Drive, Mode, Plate, Tier};
use platebench_wire::{Configure, Gains, LawId};
use std::f64::consts::TAU;

/// The paper's demand on the 5 % response time, s (section V).
const PRINTED_RESPONSE: f64 = 2e-3;
/// What the firmware's matched loops are designed for, s.
const MATCHED_RESPONSE: f64 = 1.9e-3;
/// What its holding loops are designed for after a deadbeat start, s.
const HOLDING_RESPONSE: f64 = 3e-3;
/// What its integral controller of the frequency is designed for, s.
const FREQUENCY_ONLY_RESPONSE: f64 = 10e-3;
/// The share of the amplifier's limit that `frequency-only` drives with.
const FREQUENCY_ONLY_SHARE: f64 = 0.5;
/// Half bandwidths closer than which `frequency-only` does not take the resonance curve's slope.
const SMALLEST_DETUNING: f64 = 0.5;
/// A limit that no small motion reaches, Vpp.
const NO_LIMIT: f64 = 1e5;
/// The excitation may go this far from its start, Hz: a start 9 K off and, for `frequency-only`, the flank beyond it.
const RANGE_HZ: f64 = 400.0;
const BISECTIONS: u32 = 60;

/// How a plate is met.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Condition {
    /// Untouched, excitation starting at the resonance.
    Resonant,
    /// Untouched, excitation starting where the resonance is at 33 °C: 545 rad/s too low (Fig. 14).
    Detuned,
    /// Under a finger of 2 N, excitation starting at the resonance (Fig. 16).
    Finger,
}

impl Condition {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Resonant, Self::Detuned, Self::Finger];

    /// Its name in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Resonant => "resonant",
            Self::Detuned => "detuned",
            Self::Finger => "finger",
        }
    }

    /// The plate's surroundings.
    pub fn surroundings(self) -> Conditions {
        let finger_force_n = if self == Self::Finger { 2.0 } else { 0.0 };
        Conditions { temperature_offset_k: 0.0, finger_force_n }
    }

    /// Where the excitation starts, rad/s.
    pub fn start(self, plate: &Plate) -> f64 {
        let mode = plate.mode(&self.surroundings());
        let warmer_k = if self == Self::Detuned { 9.0 } else { 0.0 };
        mode.omega0 + warmer_k * plate.omega0_per_k
    }
}

/// A law on a plate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Case<'a> {
    /// The plate.
    pub plate: &'a Plate,
    /// The law of the firmware under test.
    pub law: LawId,
    /// How the plate is met.
    pub condition: Condition,
    /// Control period, µs, above 0.
    pub period_us: u32,
    /// 5 % response time that the gains are designed for, s; the law's own where not given.
    pub response_s: Option<f64>,
    /// Gains instead of the law's design; [`Case::linear`] takes them as they are.
    pub gains: Option<Gains>,
}

impl<'a> Case<'a> {
    /// A law as it is, at 1 kHz.
    pub fn new(plate: &'a Plate, law: LawId, condition: Condition) -> Self {
        Self { plate, law, condition, period_us: 1_000, response_s: None, gains: None }
    }

    /// The control period, s.
    pub fn period(&self) -> f64 {
        f64::from(self.period_us) * 1e-6
    }

    /// The response time that the gains are designed for, s.
    pub fn response(&self) -> f64 {
        self.response_s.unwrap_or(match self.law {
            LawId::DqPiEuler => PRINTED_RESPONSE,
            LawId::FrequencyOnly => FREQUENCY_ONLY_RESPONSE,
            LawId::Deadbeat => HOLDING_RESPONSE,
            _ => MATCHED_RESPONSE,
        })
    }

    /// The mode in the case's surroundings.
    pub fn mode(&self) -> Mode {
        self.plate.mode(&self.condition.surroundings())
    }

    /// The setpoint, µm: the paper's 2, and 1 for `frequency-only`, whose drive is fixed and reaches no more under the finger.
    pub fn setpoint(&self) -> f64 {
        if self.law == LawId::FrequencyOnly { 1.0 } else { 2.0 }
    }

    /// The drive's limit, Vpp: out of the way, but for the law that drives with half of it.
    pub fn limit(&self) -> f64 {
        if self.law == LawId::FrequencyOnly { self.plate.drive_limit_vpp } else { NO_LIMIT }
    }

    /// What the controller is told: the plate's nominal numbers, never the surroundings.
    pub fn configure(&self) -> Configure {
        Configure {
            law: self.law,
            paced_by_target: false,
            drives_own_plate: false,
            patience_ms: 0,
            loop_delay_us: 0,
            period_us: self.period_us,
            start_frequency_mhz: (self.condition.start(self.plate) / TAU * 1e3).round() as u32,
            gain_um_per_vpp: self.plate.gain as f32,
            time_constant_s: (1.0 / self.plate.sigma0) as f32,
            response_time_s: self.response_s.map_or(0.0, |seconds| seconds as f32),
            drive_limit_vpp: self.limit() as f32,
            frequency_range_hz: RANGE_HZ as f32,
            frequency_slew_hz: RANGE_HZ as f32,
            gains: self.gains,
        }
    }

    /// The drive and the excitation in the steady state that the law holds; `None` where it has none in reach.
    pub fn operating(&self, tier: Tier) -> Option<Drive> {
        let (mode, setpoint) = (self.mode(), self.setpoint());
        let start = self.condition.start(self.plate);
        let undisturbed = setpoint / self.plate.gain;
        Some(match self.law {
            LawId::OpenLoop => Drive { vpp: undisturbed, omega: start },
            LawId::Pll => Drive { vpp: undisturbed, omega: mode.omega0 },
            LawId::VoltageOnly => {
                let per_volt = steady(tier, &mode, &Drive { vpp: 1.0, omega: start }).norm();
                Drive { vpp: setpoint / per_volt, omega: start }
            }
            LawId::FrequencyOnly => {
                let vpp = FREQUENCY_ONLY_SHARE * self.limit();
                let (mut low, mut high) = (mode.omega0, start + RANGE_HZ * TAU);
                let reaches = |omega| steady(tier, &mode, &Drive { vpp, omega }).norm() >= setpoint;
                if !reaches(low) || reaches(high) {
                    return None;
                }
                for _ in 0..BISECTIONS {
                    let middle = f64::midpoint(low, high);
                    *(if reaches(middle) { &mut low } else { &mut high }) = middle;
                }
                Drive { vpp, omega: low }
            }
            LawId::DqPi | LawId::DqPiEuler | LawId::DqPiFixed | LawId::BangBang | LawId::Deadbeat => {
                Drive { vpp: mode.drive_for(setpoint), omega: mode.omega0 }
            }
        })
    }

    /// The law as it answers small motions around its steady state, and the plate there. `None` where there is no steady state.
    ///
    /// * `dq-pi` and `deadbeat` follow the plate's damping. In a steady state they know it, and what a small motion changes in their gains acts on an error
    ///   that is small itself: to first order they are loops matched to the plate as it is.
    /// * `deadbeat` holds; its steering is over. It is taken to know of no delay.
    /// * `bang-bang`'s relay has no linear form; what is here is its amplitude loop.
    pub fn linear(&self, tier: Tier) -> Option<(Plant, Controller)> {
        let drive = self.operating(tier)?;
        let plant = Plant::around(tier, &self.mode(), &drive);
        let at = plant.at();
        let size = at.norm();
        // δ(Wq/Wd) at Wd = W0, Wq = 0; δ arg W at any phase; δ|W|.
        let ratio = [0.0, 1.0 / at.re];
        let phase = [-at.im / (size * size), at.re / (size * size)];
        let magnitude = [at.re / size, at.im / size];
        let [amplitude, frequency] = self.loops();
        let error_of = |sees: [f64; 2]| Channel { pi: amplitude, error: sees.map(|part| -part) };
        let follows = |sees| Some(Channel { pi: frequency, error: sees });
        let controller = match self.law {
            LawId::OpenLoop => Controller { feedforward: 1.0 / self.plate.gain, ..Controller::default() },
            LawId::DqPi | LawId::DqPiEuler | LawId::DqPiFixed | LawId::Deadbeat => {
                Controller { drive: Some(error_of([1.0, 0.0])), frequency: follows(ratio), feedforward: 0.0 }
            }
            LawId::VoltageOnly | LawId::BangBang => {
                Controller { drive: Some(error_of(magnitude)), ..Controller::default() }
            }
            LawId::FrequencyOnly => {
                let sees = magnitude.map(|part| part / self.setpoint());
                Controller { frequency: follows(sees), ..Controller::default() }
            }
            LawId::Pll => {
                Controller { frequency: follows(phase), feedforward: 1.0 / self.plate.gain, ..Controller::default() }
            }
        };
        Some((plant, controller))
    }

    /// The gains of the amplitude's and the frequency's loop: plants K1/(1 + τp) and −τ/(1 + τp), of the untouched plate or of the one that is there.
    fn loops(&self) -> [Pi; 2] {
        let period = self.period();
        if let Some(gains) = self.gains {
            let given =
                |kp: f32, ki: f32| Pi { proportional: f64::from(kp), integral_per_period: f64::from(ki) * period };
            let frequency = given(gains.frequency_kp, gains.frequency_ki);
            let frequency = match self.law {
                LawId::FrequencyOnly => Pi::integral_at_once(frequency.integral_per_period),
                _ => frequency,
            };
            return [given(gains.amplitude_kp, gains.amplitude_ki), frequency];
        }
        let (gain, tau, response) = (self.plate.gain, 1.0 / self.plate.sigma0, self.response());
        match self.law {
            LawId::DqPiEuler => [gain, tau].map(|gain| Pi::as_printed(Integral::Forward, gain, tau, response, period)),
            LawId::DqPi | LawId::Deadbeat => {
                let there = 1.0 / self.mode().sigma;
                [gain * there / tau, there].map(|gain| Pi::matched(gain, there, response, period))
            }
            LawId::FrequencyOnly => {
                let ratio = FREQUENCY_ONLY_SHARE * self.limit() * gain / self.setpoint();
                let x = (ratio * ratio - 1.0).max(0.0).sqrt().max(SMALLEST_DETUNING);
                let share = 1.0 - (-3.0 * period / response).exp();
                [gain, tau].map(|_| Pi::integral_at_once(share * (1.0 + x * x) / (x * tau)))
            }
            _ => [gain, tau].map(|gain| Pi::matched(gain, tau, response, period)),
        }
    }
}
