//! Designs gains by equation 24 of the paper in three discretisations, and evaluates a design:
//! poles, margins and responses.
//!
//! A step on the exact plate uses the firmware's loops, including their limits. In contrast to
//! [`crate::loops::ClosedLoop::step_response`] the drive saturates with anti-windup, |W| includes
//! the ripple of the fast mode, and the frequency loop is inactive while Wd is small.

use crate::law_loops::{LoopCase, OperatingCondition};
use crate::loops::{
    ClosedLoop, Discretisation, LinearController, LinearPlant, LoopChannel, LoopError, LoopTiming, Margins, PiGains,
    StepResponse, delay_boundary,
};
use platebench_controller::{Law, Measurement};
use platebench_engine::delay_boundary::DelayBoundary;
use platebench_plate::{
    BandMonitor, BandSignal, ConditionProfiles, Conditions, Drive, Mode, Model, Plant, Plate, Profile, Time,
};
use platebench_wire::{Configure, Gains, LawId, flags};
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::VecDeque;
use std::f64::consts::TAU;

/// The horizon is the simulated time of a step. It is the longest of these numbers of periods,
/// response times and time constants, plus the delays.
const HORIZON_PERIODS: f64 = 60.0;
const HORIZON_RESPONSES: f64 = 6.0;
const HORIZON_TIME_CONSTANTS: f64 = 20.0;
const HORIZON_DELAYS: f64 = 20.0;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TuningTarget<'a> {
    pub plate: &'a Plate,
    pub force_n: f64,
    /// Setpoint, µm, above 0.
    pub setpoint: f64,
    /// 5 % response time of |W|, s, above 0.
    pub response: f64,
    /// Control period, µs, above 0.
    pub period_us: u32,
    /// Delay from sampling to actuation, s.
    pub delay: f64,
    /// Smallest allowed phase margin of each loop, degrees.
    pub phase_margin_deg: f64,
}

impl TuningTarget<'_> {
    pub fn period(&self) -> f64 {
        f64::from(self.period_us) * 1e-6
    }

    pub fn mode(&self) -> Mode {
        self.plate.mode(&Conditions { temperature_offset_k: 0.0, finger_force_n: self.force_n })
    }

    /// Shortest time, s, from rest into the band with the drive limit. `None` if out of reach.
    pub fn time_floor(&self) -> Option<f64> {
        self.mode().min_rise_time(self.setpoint, 0.95, self.plate.drive_limit_vpp)
    }

    pub fn horizon(&self) -> u32 {
        let slowest = (HORIZON_RESPONSES * self.response).max(HORIZON_TIME_CONSTANTS / self.mode().sigma);
        let seconds = (HORIZON_PERIODS * self.period()).max(slowest) + HORIZON_DELAYS * self.delay;
        (seconds / self.period()).ceil() as u32
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GainDesign {
    pub discretisation: Discretisation,
    pub response: f64,
    /// PI from the error of Wd to the drive, Vpp per µm.
    pub amplitude: PiGains,
    /// PI from Wq/Wd to the excitation frequency, rad/s.
    pub frequency: PiGains,
}

impl GainDesign {
    /// Gains by equation 24 under the target's finger. For the amplitude K = b/σ, for the frequency
    /// K = τ, for both τ = 1/σ.
    pub fn new(target: &TuningTarget<'_>, discretisation: Discretisation, response: f64) -> Self {
        let mode = target.mode();
        let tau = 1.0 / mode.sigma;
        let [amplitude, frequency] =
            [mode.envelope_constant * tau, tau].map(|gain| discretisation.gains(gain, tau, response, target.period()));
        Self { discretisation, response, amplitude, frequency }
    }

    /// Gains for the firmware's forward-Euler integral. `period` is in s.
    pub fn firmware_gains(&self, period: f64) -> Gains {
        let Self { amplitude, frequency, .. } = self;
        Gains {
            amplitude_kp: amplitude.proportional as f32,
            amplitude_ki: (amplitude.integral_per_period / period) as f32,
            frequency_kp: frequency.proportional as f32,
            frequency_ki: (frequency.integral_per_period / period) as f32,
        }
    }

    /// `which` selects the closed loops (drive, frequency). The target's finger presses `plate`.
    pub fn closed_loop(
        &self,
        target: &TuningTarget<'_>,
        plate: &Plate,
        model: Model,
        which: [bool; 2],
    ) -> Result<ClosedLoop, LoopError> {
        let (plant, controller) = self.linear_parts(&TuningTarget { plate, ..*target }, model, which);
        ClosedLoop::new(plant, controller, LoopTiming { period: target.period(), delay: target.delay })
    }

    pub(crate) fn linear_parts(
        &self,
        target: &TuningTarget<'_>,
        model: Model,
        [drive, frequency]: [bool; 2],
    ) -> (LinearPlant, LinearController) {
        let mode = target.mode();
        let steady = Drive { vpp: mode.drive_for(target.setpoint), omega: mode.omega0 };
        let plant = LinearPlant::linearised_at(model, &mode, &steady);
        let controller = LinearController {
            drive: drive.then_some(LoopChannel { pi: self.amplitude, error_weights: [-1.0, 0.0] }),
            frequency: frequency
                .then_some(LoopChannel { pi: self.frequency, error_weights: [0.0, 1.0 / plant.at().re] }),
            feedforward: 0.0,
        };
        (plant, controller)
    }
}

pub(crate) const BAND: f64 = 0.05;
/// Points of |W| per period, as in the rows of a trace at 1 kHz.
const POINTS_PER_PERIOD: u64 = 20;
/// If |W| enters the band after this share of the horizon, the response has not settled.
const LATEST_ENTRY_SHARE: f64 = 0.9;
/// Default frequency range in Hz and slew limit in Hz per period of a scenario.
const RANGE_HZ: f32 = 250.0;
const SLEW_HZ: f32 = 100.0;

impl GainDesign {
    /// Steps the setpoint from rest. The excitation starts at the untouched plate's resonance.
    /// Settling is the last entry of |W| into the band. Returns the default response if the
    /// firmware rejects the gains.
    pub fn simulate_step(&self, target: &TuningTarget<'_>, plate: &Plate) -> StepResponse {
        let TuningTarget { period_us, delay, setpoint, force_n, .. } = *target;
        let gains = Some(self.firmware_gains(target.period()));
        let case =
            LoopCase { period_us, gains, ..LoopCase::new(plate, LawId::DqPiFixed, OperatingCondition::Resonant) };
        let configure = Configure {
            drive_limit_vpp: plate.drive_limit_vpp as f32,
            frequency_range_hz: RANGE_HZ,
            frequency_slew_hz: SLEW_HZ,
            ..case.configure()
        };
        let Ok((mut law, _)) = Law::design(&configure) else { return StepResponse::default() };
        let scene = ConditionProfiles {
            temperature_offset_k: Profile::constant(0.0),
            finger_force_n: Profile::constant(force_n),
        };
        let mut plant = Plant::new(plate.clone(), scene, Model::Modal);
        plant.set_drive(Drive { vpp: 0.0, omega: plate.omega0 });
        let band =
            BandMonitor { signal: BandSignal::Amplitude, low: (1.0 - BAND) * setpoint, high: (1.0 + BAND) * setpoint };
        let (period, delay) = (u64::from(period_us) * 1_000, (delay * 1e9).round() as u64);
        let mut pending: VecDeque<(u64, Drive)> = VecDeque::new();
        let (mut found, mut inside, mut crossings) = (StepResponse::default(), None, Vec::new());
        for number in 0..target.horizon() {
            let now = u64::from(number) * period;
            let w = plant.state().w;
            let measurement = Measurement { setpoint_um: setpoint as f32, wd_um: w.re as f32, wq_um: w.im as f32 };
            let actuation = law.step(&measurement);
            found.saturated_periods += u32::from(actuation.flags & flags::SATURATED != 0);
            let drive = Drive {
                vpp: f64::from(actuation.drive_vpp).min(plate.drive_limit_vpp),
                omega: plate.omega0 + TAU * f64::from(actuation.frequency_offset_hz),
            };
            pending.push_back((now + delay, drive));
            let end = now + period;
            let points = (1..=POINTS_PER_PERIOD).map(|point| now + period * point / POINTS_PER_PERIOD);
            let late = pending.iter().map(|(at, _)| *at).filter(|at| *at < end);
            let mut stops: Vec<u64> = points.chain(late).collect();
            stops.sort_unstable();
            for stop in stops {
                while let Some(&(at, drive)) = pending.front()
                    && at <= plant.time().as_nanos()
                {
                    plant.set_drive(drive);
                    found.peak_drive = found.peak_drive.max(drive.vpp);
                    pending.pop_front();
                }
                plant.advance(Time::from_nanos(stop), &[band], &mut crossings);
                for crossing in crossings.drain(..) {
                    let holds = (band.low..=band.high).contains(&crossing.state.amplitude());
                    inside = holds.then(|| crossing.time.seconds());
                }
                found.overshoot = found.overshoot.max(plant.state().amplitude() / setpoint - 1.0);
            }
            if !plant.state().is_finite() {
                return StepResponse { settling: None, diverged: true, ..found };
            }
        }
        let latest = LATEST_ENTRY_SHARE * f64::from(target.horizon()) * (f64::from(period_us) * 1e-6);
        StepResponse { settling: inside.filter(|entered| *entered <= latest), ..found }
    }
}

/// The delay search ends this many times (period + design time) above the target's delay.
const MAX_DELAY_FACTOR: f64 = 8.0;
/// Poles with a smaller magnitude belong to pending commands.
const PENDING_POLE_RADIUS: f64 = 1e-6;

/// One loop of a design at the target's delay, while the other loop is open.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct LoopEvaluation {
    /// Proportional gain, Vpp per µm or rad/s per unit of Wq/Wd.
    pub kp: f64,
    /// Integral gain, in the unit of `kp` per second.
    pub ki_per_s: f64,
    /// Poles in the z plane, [re, im], without the poles of pending commands.
    pub poles: Vec<[f64; 2]>,
    pub spectral_radius: f64,
    #[serde(flatten)]
    pub margins: Margins,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct StepEvaluation {
    /// 5 % settling time. `None` if the response does not settle.
    pub settling_ms: Option<f64>,
    pub overshoot_percent: f64,
    pub peak_drive_vpp: f64,
}

impl From<StepResponse> for StepEvaluation {
    fn from(response: StepResponse) -> Self {
        Self {
            settling_ms: response.settling.map(|seconds| seconds * 1e3),
            overshoot_percent: response.overshoot * 100.0,
            peak_drive_vpp: response.peak_drive,
        }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct DesignEvaluation {
    pub discretisation: Discretisation,
    pub designed_for_ms: f64,
    pub amplitude: LoopEvaluation,
    pub frequency: LoopEvaluation,
    /// Spectral radius of both loops together on the modal plate.
    pub spectral_radius: f64,
    /// Step of the amplitude loop on the envelope, without ripple and limits.
    pub linear: StepEvaluation,
    /// Step of |W| on the modal plate with the drive limit.
    pub plate: StepEvaluation,
    pub saturated_periods: u32,
    #[serde(skip)]
    pub design: GainDesign,
}

pub(crate) fn design_delay_boundary(
    target: &TuningTarget<'_>,
    plate: &Plate,
    design: &GainDesign,
) -> Result<DelayBoundary, LoopError> {
    let (plant, controller) = design.linear_parts(&TuningTarget { plate, ..*target }, Model::Modal, [true; 2]);
    delay_boundary(&plant, &controller, target.period(), longest_delay(target))
}

fn longest_delay(target: &TuningTarget<'_>) -> f64 {
    target.delay + MAX_DELAY_FACTOR * (target.period() + design_time(target))
}

fn design_time(target: &TuningTarget<'_>) -> f64 {
    (1.0 / target.mode().sigma).max(target.response)
}

pub(crate) fn delay_margin_ms(target: &TuningTarget<'_>, boundary: DelayBoundary) -> Option<f64> {
    match boundary {
        DelayBoundary::Unstable => Some(0.0 - target.delay * 1e3),
        DelayBoundary::At(seconds) => Some((seconds - target.delay) * 1e3),
        DelayBoundary::Beyond(_) => None,
    }
}

pub fn evaluate_design(target: &TuningTarget<'_>, design: GainDesign) -> Result<DesignEvaluation, LoopError> {
    let GainDesign { amplitude, frequency, discretisation, response } = design;
    let both = design.closed_loop(target, target.plate, Model::Modal, [true; 2])?;
    let alone = design.closed_loop(target, target.plate, Model::Envelope, [true, false])?;
    let transient = design.simulate_step(target, target.plate);
    Ok(DesignEvaluation {
        discretisation,
        designed_for_ms: response * 1e3,
        amplitude: evaluate_loop(target, &design, amplitude, [true, false])?,
        frequency: evaluate_loop(target, &design, frequency, [false, true])?,
        spectral_radius: both.spectral_radius()?,
        linear: alone.step_response(target.setpoint, target.horizon()).into(),
        plate: transient.into(),
        saturated_periods: transient.saturated_periods,
        design,
    })
}

fn evaluate_loop(
    target: &TuningTarget<'_>,
    design: &GainDesign,
    pi: PiGains,
    which: [bool; 2],
) -> Result<LoopEvaluation, LoopError> {
    let closed = design.closed_loop(target, target.plate, Model::Envelope, which)?;
    let mut poles = closed.poles()?;
    // Wd and Wq are decoupled here. Removes the pole of the component of the other, open loop.
    let other = (-target.mode().sigma * target.period()).exp();
    let distance = |pole: &nalgebra::Complex<f64>| (pole - other).norm();
    let nearest = (0..poles.len()).min_by(|a, b| distance(&poles[*a]).total_cmp(&distance(&poles[*b])));
    if let Some(nearest) = nearest {
        poles.remove(nearest);
    }
    poles.retain(|pole| pole.norm() > PENDING_POLE_RADIUS);
    poles.sort_by(|a, b| b.norm().total_cmp(&a.norm()).then(b.im.total_cmp(&a.im)));
    let (plant, controller) = design.linear_parts(target, Model::Envelope, which);
    let bears = delay_boundary(&plant, &controller, target.period(), longest_delay(target))?;
    Ok(LoopEvaluation {
        kp: pi.proportional,
        ki_per_s: pi.integral_per_period / target.period(),
        spectral_radius: poles.iter().fold(0.0, |largest, pole| pole.norm().max(largest)),
        poles: poles.iter().map(|pole| [pole.re, pole.im]).collect(),
        margins: closed.margins(delay_margin_ms(target, bears)),
    })
}
