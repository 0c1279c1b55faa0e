//! Builds the loops of laws: their linear form, the firmware's f32 controller on the exact plate,
//! and the two PI loops of the paper's block diagram.
//!
//! **Measured boundary.** The firmware's loop reaches its steady state without delay. Then its
//! commands act late, one sample is perturbed, and the perturbation decays or grows. The drive
//! limit does not act. `deadbeat` starts without delay and compensates none.
//!
//! **Plain loops.** `V` follows from `Wd_ref − Wd` and ω from `Wq/Wd`, without limits, guard for
//! small amplitudes and anti-windup. The ratio `Wq/Wd` is not linear. Far from the resonance a loop
//! with a small spectral radius may diverge.

use crate::loops::{
    ClosedLoop, Discretisation, LinearController, LinearPlant, LoopChannel, LoopError, LoopTiming, PiGains,
    steady_state,
};
use platebench_controller::design;
use platebench_engine::delay_boundary::{DelayBoundary, DelayedLoop, search_boundary};
use platebench_model::scenario::Scenario;
use platebench_plate::{Complex64, Conditions, Drive, Flow, Mode, Model, Plate, State, Time};
use platebench_verdict::statistics::bisect;
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
    pub conditions: Conditions,
    /// Excitation at the start, rad/s.
    pub start_omega: f64,
    pub setpoint: f64,
    /// Drive limit, Vpp.
    pub limit: f64,
    /// Control period, µs, above 0.
    pub period_us: u32,
    /// 5 % response time of the design, s. `None` means the law's default.
    pub response_s: Option<f64>,
    pub gains: Option<Gains>,
}

impl<'a> LoopCase<'a> {
    /// The setpoint is 2 µm as in the paper, and 1 µm for `frequency-only`, which cannot reach 2 µm
    /// under a finger. Only this law gets the plate's drive limit, because its drive is half of it.
    pub fn new(plate: &'a Plate, law: LawId, condition: OperatingCondition) -> Self {
        let (setpoint, limit) =
            if law == LawId::FrequencyOnly { (1.0, plate.drive_limit_vpp) } else { (2.0, UNREACHED_LIMIT_VPP) };
        let (conditions, start_omega) = (condition.conditions(), condition.start_omega(plate));
        Self { plate, law, conditions, start_omega, setpoint, limit, period_us: 1_000, response_s: None, gains: None }
    }

    /// The loop at the highest setpoint and the first conditions of `scenario`. `None` if the linear
    /// form does not describe it: another design plate, a specified delay, an effect of the plate, or
    /// a steady state beyond the limits of drive and frequency.
    pub fn of_scenario(scenario: &'a Scenario, law: LawId) -> Option<Self> {
        let (plate, controller) = (&scenario.plate, &scenario.controller);
        let is_described = controller.design_plate.is_none()
            && controller.design_delay == Time::ZERO
            && controller.loop_delay_jitter == Time::ZERO
            && plate.first_effect().is_none();
        let case = Self {
            plate,
            law,
            conditions: scenario.conditions.at(Time::ZERO),
            start_omega: controller.start_frequency_hz * TAU,
            setpoint: scenario.setpoint.range().1,
            limit: plate.drive_limit_vpp,
            period_us: controller.period.wrapping_micros(),
            response_s: controller.response_time_ms.map(|ms| ms / 1e3),
            gains: platebench_engine::configure(scenario, law).gains,
        };
        let steady = case.steady_drive(Model::Modal)?;
        let offset_hz = (steady.omega - case.start_omega).abs() / TAU;
        let is_reached = steady.vpp < plate.drive_limit_vpp && offset_hz < controller.frequency_range_hz;
        (is_described && is_reached).then_some(case)
    }

    pub fn period(&self) -> f64 {
        f64::from(self.period_us) * 1e-6
    }

    pub fn response(&self) -> f64 {
        self.response_s.unwrap_or(design::default_response_time_s(self.law))
    }

    pub fn mode(&self) -> Mode {
        self.plate.mode(&self.conditions)
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
            start_frequency_mhz: (self.start_omega / TAU * 1e3).round() as u32,
            gain_um_per_vpp: self.plate.gain as f32,
            time_constant_s: (1.0 / self.plate.sigma0) as f32,
            response_time_s: self.response_s.map_or(0.0, |seconds| seconds as f32),
            drive_limit_vpp: self.limit as f32,
            frequency_range_hz: RANGE_HZ as f32,
            frequency_slew_hz: RANGE_HZ as f32,
            gains: self.gains,
        }
    }

    /// Drive and excitation of the law's steady state. `None` if the law cannot reach the setpoint.
    pub fn steady_drive(&self, model: Model) -> Option<Drive> {
        let (mode, setpoint) = (self.mode(), self.setpoint);
        let start = self.start_omega;
        let undisturbed = setpoint / self.plate.gain;
        Some(match self.law {
            LawId::OpenLoop => Drive { vpp: undisturbed, omega: start },
            LawId::Pll => Drive { vpp: undisturbed, omega: mode.omega0 },
            LawId::VoltageOnly => {
                let per_volt = steady_state(model, &mode, &Drive { vpp: 1.0, omega: start }).norm();
                Drive { vpp: setpoint / per_volt, omega: start }
            }
            LawId::FrequencyOnly => {
                let vpp = self.frequency_only_drive();
                let (low, high) = (mode.omega0, start + RANGE_HZ * TAU);
                let reaches = |omega| steady_state(model, &mode, &Drive { vpp, omega }).norm() >= setpoint;
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
        f64::from(design::FREQUENCY_ONLY_DRIVE_SHARE) * self.limit
    }

    /// Plate and law, linearised around the steady state. `None` if the law cannot reach it.
    /// * `dq-pi` and `deadbeat` adapt to the plate's damping. In the steady state they know the
    ///   damping, and a small motion changes gains that act on a small error. To first order they
    ///   are loops matched to the present plate.
    /// * `deadbeat` is in its holding phase and assumes no delay.
    /// * The relay of `bang-bang` has no linear form, so only its amplitude loop is analysed.
    pub fn linearise(&self, model: Model) -> Option<(LinearPlant, LinearController)> {
        let drive = self.steady_drive(model)?;
        let plant = LinearPlant::linearised_at(model, &self.mode(), &drive);
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
                let sees = magnitude.map(|part| part / self.setpoint);
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
            let ratio = self.frequency_only_drive() * gain / self.setpoint;
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

/// Periods without delay until the steady state. [`AVERAGED_PERIODS`] at their end are averaged.
const WARM_UP: u32 = 700;
const AVERAGED_PERIODS: u32 = 100;
/// Largest spread of |W| over the averaged periods, as a share of the setpoint.
const STEADY_TOLERANCE: f64 = 1e-4;
/// Perturbation of one sample as a share of the setpoint.
const PERTURBATION: f64 = 3e-2;
/// Smaller, because laws that identify the plate must treat the perturbation as noise.
const PERTURBATION_OF_ADAPTIVE_LAWS: f64 = 3e-3;
const DIVERGENCE_FACTOR: f64 = 8.0;
/// Resolution of the frequency (1 mHz) and of f32, as a share of the setpoint.
const RESOLUTION: f64 = 5e-5;
/// Periods until the slowest pole dominates. Then two windows of [`WINDOW`] periods are compared.
const TRANSIENT_PERIODS: usize = 40;
const WINDOW: usize = 160;
/// A hunting loop (limit cycle of `bang-bang`) is stable if |W| stays within this share of the
/// setpoint for the last [`HUNT_WINDOW`] periods.
const HUNT_BAND: f64 = 0.05;
const HUNT_PERIODS: usize = 3_000;
const HUNT_WINDOW: usize = 300;
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LoopMotion {
    /// The perturbation decays or grows by this factor per period.
    Factor(f64),
    Decayed,
    BoundedHunting,
    UnboundedHunting,
}

impl LoopMotion {
    pub fn is_stable(self) -> bool {
        match self {
            Self::Factor(factor) => factor < 1.0,
            Self::Decayed | Self::BoundedHunting => true,
            Self::UnboundedHunting => false,
        }
    }
}

#[derive(Debug, Clone)]
pub struct LoopSimulation {
    delayed_loop: DelayedLoop,
    is_hunting_law: bool,
    perturbation: f64,
    steady: Complex64,
}

/// `None` if the firmware rejects the configuration.
pub fn loop_at_rest(case: &LoopCase<'_>) -> Option<DelayedLoop> {
    DelayedLoop::new(&case.configure(), case.plate, case.conditions, Model::Modal, case.setpoint)
}

impl LoopSimulation {
    /// `None` if there is no steady state without delay.
    pub fn in_steady_state(case: &LoopCase<'_>) -> Option<Self> {
        let mut delayed_loop = loop_at_rest(case)?;
        let mut steady = Complex64::ZERO;
        let (mut lowest, mut highest) = (f64::INFINITY, f64::NEG_INFINITY);
        for period in 0..WARM_UP {
            let w = delayed_loop.step(Time::ZERO, 0.0)?;
            if period >= WARM_UP - AVERAGED_PERIODS {
                steady += w / f64::from(AVERAGED_PERIODS);
                (lowest, highest) = (lowest.min(w.norm()), highest.max(w.norm()));
            }
        }
        let perturbation = match case.law {
            LawId::DqPi | LawId::Deadbeat => PERTURBATION_OF_ADAPTIVE_LAWS,
            _ => PERTURBATION,
        };
        let is_hunting_law = case.law == LawId::BangBang;
        let spread = (highest - lowest) / case.setpoint;
        let perturbation = case.setpoint * perturbation;
        (spread < if is_hunting_law { HUNT_BAND } else { STEADY_TOLERANCE }).then_some(Self {
            delayed_loop,
            is_hunting_law,
            perturbation,
            steady,
        })
    }

    pub fn perturbed_motion(mut self, delay: Time) -> LoopMotion {
        if self.is_hunting_law {
            return self.hunting_motion(delay);
        }
        let mut windows = [0.0_f64; 2];
        for number in 0..TRANSIENT_PERIODS + 2 * WINDOW {
            let perturbation = if number == 0 { self.perturbation } else { 0.0 };
            let Some(w) = self.delayed_loop.step(delay, perturbation) else { return LoopMotion::Factor(f64::INFINITY) };
            let share = (w - self.steady).norm() / self.perturbation;
            if share > DIVERGENCE_FACTOR && number > TRANSIENT_PERIODS {
                return LoopMotion::Factor(share.powf(1.0 / number as f64));
            }
            if let Some(window) =
                number.checked_sub(TRANSIENT_PERIODS).and_then(|since| windows.get_mut(since / WINDOW))
            {
                *window = window.max(share);
            }
        }
        match windows {
            [_, late] if late < RESOLUTION * self.delayed_loop.setpoint() / self.perturbation => LoopMotion::Decayed,
            [early, late] => LoopMotion::Factor((late / early).powf(1.0 / WINDOW as f64)),
        }
    }

    /// Applies no perturbation, because a hunting loop oscillates by itself.
    fn hunting_motion(mut self, delay: Time) -> LoopMotion {
        for number in 0..HUNT_PERIODS {
            let Some(w) = self.delayed_loop.step(delay, 0.0) else { return LoopMotion::UnboundedHunting };
            let share = (w.norm() / self.delayed_loop.setpoint() - 1.0).abs();
            if share > HUNT_BAND && number >= HUNT_PERIODS - HUNT_WINDOW {
                return LoopMotion::UnboundedHunting;
            }
        }
        LoopMotion::BoundedHunting
    }
}

/// Longest delay, up to `longest` s, with a stable steady state. `None` without steady state.
pub fn measure_delay_boundary(case: &LoopCase<'_>, longest: f64) -> Option<DelayBoundary> {
    let simulation = LoopSimulation::in_steady_state(case)?;
    Some(search_boundary(case.period(), longest, |delay| simulation.clone().perturbed_motion(delay).is_stable()))
}

/// Longest delay, up to `longest` s, with which |W| reaches and keeps the 5 % band from rest.
pub fn measure_delay_boundary_from_rest(case: &LoopCase<'_>, longest: f64) -> DelayBoundary {
    loop_at_rest(case).map_or(DelayBoundary::Unstable, |at_rest| at_rest.settling_boundary(longest))
}

const BAND: f64 = 0.05;
/// |W| above this many setpoints counts as divergence.
const DIVERGENCE_LIMIT: f64 = 1e6;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlainLoops {
    /// PI from the error of Wd to the drive, Vpp per µm.
    pub amplitude: PiGains,
    /// PI from Wq/Wd to the excitation frequency, rad/s.
    pub frequency: PiGains,
    pub period: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StartResult {
    /// First control instant from which |W| stays within 5 % of the setpoint, s.
    pub settled: Option<f64>,
    /// Smallest and largest |W|/setpoint in the last quarter of the start.
    pub range: [f64; 2],
    /// ω − ω0 at the end, rad/s.
    pub detuning: f64,
    /// True if W diverged or the detuning reached the resonance frequency.
    pub diverged: bool,
}

impl PlainLoops {
    /// Gains by equation 24 for the untouched plate. `response` is in s (2 ms in the paper).
    pub fn new(plate: &Plate, discretisation: Discretisation, response: f64, period: f64) -> Self {
        let tau = 1.0 / plate.sigma0;
        let [amplitude, frequency] = [plate.gain, tau].map(|gain| discretisation.gains(gain, tau, response, period));
        Self { amplitude, frequency, period }
    }

    /// Linearises around the steady state under `condition`, on the envelope and without delay.
    pub fn linearise(
        &self,
        plate: &Plate,
        condition: OperatingCondition,
        setpoint: f64,
    ) -> Result<ClosedLoop, LoopError> {
        let mode = plate.mode(&condition.conditions());
        let drive = Drive { vpp: mode.drive_for(setpoint), omega: mode.omega0 };
        let controller = LinearController {
            drive: Some(LoopChannel { pi: self.amplitude, error_weights: [-1.0, 0.0] }),
            frequency: Some(LoopChannel { pi: self.frequency, error_weights: [0.0, 1.0 / setpoint] }),
            feedforward: 0.0,
        };
        let timing = LoopTiming { period: self.period, delay: 0.0 };
        ClosedLoop::new(LinearPlant::linearised_at(Model::Envelope, &mode, &drive), controller, timing)
    }

    /// Starts from rest towards `setpoint` µm, without delay.
    pub fn simulate_start(
        &self,
        plate: &Plate,
        condition: OperatingCondition,
        setpoint: f64,
        periods: u32,
    ) -> StartResult {
        let mode = plate.mode(&condition.conditions());
        let start = condition.start_omega(plate);
        let (mut state, mut integrals) = (State::default(), [0.0; 2]);
        let mut result = StartResult { settled: None, range: [f64::INFINITY, 0.0], detuning: 0.0, diverged: false };
        for number in 0..periods {
            let Complex64 { re: wd, im: wq } = state.w;
            let share = state.w.norm() / setpoint;
            let inside = (share - 1.0).abs() <= BAND;
            result.settled = inside.then(|| result.settled.unwrap_or(f64::from(number) * self.period));
            if number >= periods - periods / 4 {
                result.range = [result.range[0].min(share), result.range[1].max(share)];
            }
            let ratio = if wd == 0.0 { 0.0 } else { wq / wd };
            let mut outputs = [0.0; 2];
            let loops = [(self.amplitude, setpoint - wd), (self.frequency, ratio)];
            for ((output, integral), (pi, error)) in outputs.iter_mut().zip(&mut integrals).zip(loops) {
                *output = pi.proportional * error + *integral;
                *integral += pi.integral_per_period * error;
            }
            let omega = start + outputs[1];
            result.detuning = omega - mode.omega0;
            let lost = !(share < DIVERGENCE_LIMIT && result.detuning.abs() < mode.omega0);
            if lost {
                return StartResult { settled: None, diverged: true, ..result };
            }
            let drive = Drive { vpp: outputs[0], omega };
            state = Flow::new(Model::Modal, &mode, &drive, &state).after(self.period);
        }
        result
    }
}
