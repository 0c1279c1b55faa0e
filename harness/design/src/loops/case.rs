//! Defines a case (law, plate, condition) and derives the law's linear form.

use crate::loops::controller::{LinearController, LoopChannel, PiGains};
use crate::loops::plant::{LinearPlant, steady_state};
use platebench_controller::design;
use platebench_plate::{Conditions, Drive, Mode, Plate, Tier};
use platebench_verdict::bisection::bisect;
use platebench_wire::{Configure, Gains, LawId};
use std::f64::consts::TAU;

const UNREACHED_LIMIT_VPP: f64 = 1e5;
/// Frequency range, which covers a start 9 K off the resonance and the flank of the resonance curve
/// that `frequency-only` uses.
const RANGE_HZ: f64 = 400.0;
const BISECTIONS: u32 = 60;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, strum::IntoStaticStr)]
#[strum(const_into_str, serialize_all = "lowercase")]
pub enum OperatingCondition {
    Resonant,
    /// Untouched plate. The excitation starts 545 rad/s too low (resonance at 33 °C, Fig. 14).
    Detuned,
    /// Under a finger of 2 N (Fig. 16 of the paper).
    Finger,
}

impl OperatingCondition {
    pub const ALL: [Self; 3] = [Self::Resonant, Self::Detuned, Self::Finger];

    pub const fn name(self) -> &'static str {
        self.into_str()
    }

    pub fn conditions(self) -> Conditions {
        let finger_force_n = if self == Self::Finger { 2.0 } else { 0.0 };
        Conditions { temperature_offset_k: 0.0, finger_force_n }
    }

    pub fn start_omega(self, plate: &Plate) -> f64 {
        let mode = plate.mode(&self.conditions());
        let warmer_k = if self == Self::Detuned { 9.0 } else { 0.0 };
        mode.omega0 + warmer_k * plate.omega0_per_k
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopCase<'a> {
    pub plate: &'a Plate,
    pub law: LawId,
    pub condition: OperatingCondition,
    /// Control period, µs, above 0.
    pub period_us: u32,
    /// 5 % response time of the design, s. `None` means the law's default.
    pub response_s: Option<f64>,
    pub gains: Option<Gains>,
}

impl<'a> LoopCase<'a> {
    pub fn new(plate: &'a Plate, law: LawId, condition: OperatingCondition) -> Self {
        Self { plate, law, condition, period_us: 1_000, response_s: None, gains: None }
    }

    pub fn period(&self) -> f64 {
        f64::from(self.period_us) * 1e-6
    }

    pub fn response(&self) -> f64 {
        self.response_s.unwrap_or(design::default_response_time_s(self.law))
    }

    pub fn mode(&self) -> Mode {
        self.plate.mode(&self.condition.conditions())
    }

    /// 2 µm as in the paper. 1 µm for `frequency-only`, which cannot reach 2 µm under a finger.
    pub fn setpoint(&self) -> f64 {
        if self.law == LawId::FrequencyOnly { 1.0 } else { 2.0 }
    }

    /// Only `frequency-only` gets the plate's drive limit, because its drive is half of this limit.
    pub fn limit(&self) -> f64 {
        if self.law == LawId::FrequencyOnly { self.plate.drive_limit_vpp } else { UNREACHED_LIMIT_VPP }
    }

    /// Configures the controller for the nominal plate, not for the condition.
    pub fn configure(&self) -> Configure {
        Configure {
            law: self.law,
            paced_by_target: false,
            drives_own_plate: false,
            watchdog_timeout_ms: 0,
            loop_delay_us: 0,
            period_us: self.period_us,
            start_frequency_mhz: (self.condition.start_omega(self.plate) / TAU * 1e3).round() as u32,
            gain_um_per_vpp: self.plate.gain as f32,
            time_constant_s: (1.0 / self.plate.sigma0) as f32,
            response_time_s: self.response_s.map_or(0.0, |seconds| seconds as f32),
            drive_limit_vpp: self.limit() as f32,
            frequency_range_hz: RANGE_HZ as f32,
            frequency_slew_hz: RANGE_HZ as f32,
            gains: self.gains,
        }
    }

    /// Drive and excitation of the law's steady state. `None` if the law cannot reach the setpoint.
    pub fn steady_drive(&self, tier: Tier) -> Option<Drive> {
        let (mode, setpoint) = (self.mode(), self.setpoint());
        let start = self.condition.start_omega(self.plate);
        let undisturbed = setpoint / self.plate.gain;
        Some(match self.law {
            LawId::OpenLoop => Drive { vpp: undisturbed, omega: start },
            LawId::Pll => Drive { vpp: undisturbed, omega: mode.omega0 },
            LawId::VoltageOnly => {
                let per_volt = steady_state(tier, &mode, &Drive { vpp: 1.0, omega: start }).norm();
                Drive { vpp: setpoint / per_volt, omega: start }
            }
            LawId::FrequencyOnly => {
                let vpp = self.frequency_only_drive();
                let (low, high) = (mode.omega0, start + RANGE_HZ * TAU);
                let reaches = |omega| steady_state(tier, &mode, &Drive { vpp, omega }).norm() >= setpoint;
                if !reaches(low) || reaches(high) {
                    return None;
                }
                let [low, _] = bisect([low, high], BISECTIONS, reaches);
                Drive { vpp, omega: low }
            }
            LawId::DqPi | LawId::DqPiEuler | LawId::DqPiFixed | LawId::BangBang | LawId::Deadbeat => {
                Drive { vpp: mode.drive_for(setpoint), omega: mode.omega0 }
            }
        })
    }

    fn frequency_only_drive(&self) -> f64 {
        f64::from(design::FREQUENCY_ONLY_DRIVE_SHARE) * self.limit()
    }

    /// Plate and law, linearised around the steady state. `None` if the law cannot reach it.
    /// * `dq-pi` and `deadbeat` adapt to the plate's damping. In the steady state they know the
    ///   damping, and a small motion changes gains that act on a small error. To first order they
    ///   are loops matched to the present plate.
    /// * `deadbeat` is in its holding phase and assumes no delay.
    /// * The relay of `bang-bang` has no linear form, so only its amplitude loop is analysed.
    pub fn linearise(&self, tier: Tier) -> Option<(LinearPlant, LinearController)> {
        let drive = self.steady_drive(tier)?;
        let plant = LinearPlant::linearised_at(tier, &self.mode(), &drive);
        let at = plant.at();
        let size = at.norm();
        // Gradients with respect to (Wd, Wq) of Wq/Wd at Wq = 0, of arg W, and of |W|.
        let ratio = [0.0, 1.0 / at.re];
        let phase = [-at.im / (size * size), at.re / (size * size)];
        let magnitude = [at.re / size, at.im / size];
        let [amplitude, frequency] = self.loop_gains();
        let error_of = |sees: [f64; 2]| LoopChannel { pi: amplitude, error_weights: sees.map(|part| -part) };
        let follows = |sees| Some(LoopChannel { pi: frequency, error_weights: sees });
        let controller = match self.law {
            LawId::OpenLoop => LinearController { feedforward: 1.0 / self.plate.gain, ..LinearController::default() },
            LawId::DqPi | LawId::DqPiEuler | LawId::DqPiFixed | LawId::Deadbeat => {
                LinearController { drive: Some(error_of([1.0, 0.0])), frequency: follows(ratio), feedforward: 0.0 }
            }
            LawId::VoltageOnly | LawId::BangBang => {
                LinearController { drive: Some(error_of(magnitude)), ..LinearController::default() }
            }
            LawId::FrequencyOnly => {
                let sees = magnitude.map(|part| part / self.setpoint());
                LinearController { frequency: follows(sees), ..LinearController::default() }
            }
            LawId::Pll => LinearController {
                frequency: follows(phase),
                feedforward: 1.0 / self.plate.gain,
                ..LinearController::default()
            },
        };
        Some((plant, controller))
    }

    /// Gains for the plants K1/(1 + τp) and −τ/(1 + τp). Adaptive laws use the present plate's τ.
    fn loop_gains(&self) -> [PiGains; 2] {
        let period = self.period();
        if let Some(gains) = self.gains {
            let given =
                |kp: f32, ki: f32| PiGains { proportional: f64::from(kp), integral_per_period: f64::from(ki) * period };
            let frequency = given(gains.frequency_kp, gains.frequency_ki);
            let frequency = match self.law {
                LawId::FrequencyOnly => integral_only(frequency.integral_per_period),
                _ => frequency,
            };
            return [given(gains.amplitude_kp, gains.amplitude_ki), frequency];
        }
        let (gain, tau, response) = (self.plate.gain, 1.0 / self.plate.sigma0, self.response());
        if self.law == LawId::FrequencyOnly {
            let ratio = self.frequency_only_drive() * gain / self.setpoint();
            let detuning = (ratio * ratio - 1.0).max(0.0).sqrt();
            let share = 1.0 - design::closed_loop_pole(response, period);
            return [integral_only(share * design::inverse_slope(detuning, tau)); 2];
        }
        let is_adaptive = matches!(self.law, LawId::DqPi | LawId::Deadbeat);
        let present_tau = if is_adaptive { 1.0 / self.mode().sigma } else { tau };
        let plants = [gain * present_tau / tau, present_tau];
        plants.map(|gain| PiGains::of_law(self.law, gain, present_tau, response, period))
    }
}

/// Gains of an integral that includes the present error: `x += gain · e`, then `u = x`.
fn integral_only(gain: f64) -> PiGains {
    PiGains { proportional: gain, integral_per_period: gain }
}
