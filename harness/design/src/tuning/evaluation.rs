//! Evaluates a design: poles, margins and responses.

use crate::loops::closed_loop::AnalysisError;
use crate::loops::controller::{Discretisation, PiGains};
use crate::loops::margins::delay_boundary;
use crate::loops::step_response::StepResponse;
use crate::tuning::design::{GainDesign, TuningTarget};
use platebench_engine::delay_boundary::DelayBoundary;
use platebench_plate::{Plate, Tier};
use serde::Serialize;

/// The delay search ends this many times (period + design time) above the target's delay.
const MAX_DELAY_FACTOR: f64 = 8.0;
/// Poles with a smaller magnitude belong to pending commands.
const PENDING_POLE_RADIUS: f64 = 1e-6;

/// One loop of a design at the target's delay, while the other loop is open.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LoopEvaluation {
    /// Proportional gain, Vpp per µm or rad/s per unit of Wq/Wd.
    pub kp: f64,
    /// Integral gain, in the unit of `kp` per second.
    pub ki_per_s: f64,
    /// Poles in the z plane, [re, im], without the poles of pending commands.
    pub poles: Vec<[f64; 2]>,
    pub spectral_radius: f64,
    pub gain_margin: Option<f64>,
    pub phase_margin_deg: Option<f64>,
    /// Additional delay until the loop is unstable; 0 or less if it is unstable already. `None` if
    /// it is stable in the whole search range.
    pub delay_margin_ms: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
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

#[derive(Debug, Clone, PartialEq, Serialize)]
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
) -> Result<DelayBoundary, AnalysisError> {
    let (plant, controller) = design.linear_parts(&TuningTarget { plate, ..*target }, Tier::Modal, [true; 2]);
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

pub fn evaluate_design(target: &TuningTarget<'_>, design: GainDesign) -> Result<DesignEvaluation, AnalysisError> {
    let GainDesign { amplitude, frequency, discretisation, response } = design;
    let both = design.closed_loop(target, target.plate, Tier::Modal, [true; 2])?;
    let alone = design.closed_loop(target, target.plate, Tier::Envelope, [true, false])?;
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
) -> Result<LoopEvaluation, AnalysisError> {
    let closed = design.closed_loop(target, target.plate, Tier::Envelope, which)?;
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
    let margins = closed.margins();
    let (plant, controller) = design.linear_parts(target, Tier::Envelope, which);
    let bears = delay_boundary(&plant, &controller, target.period(), longest_delay(target))?;
    Ok(LoopEvaluation {
        kp: pi.proportional,
        ki_per_s: pi.integral_per_period / target.period(),
        spectral_radius: poles.iter().fold(0.0, |largest, pole| pole.norm().max(largest)),
        poles: poles.iter().map(|pole| [pole.re, pole.im]).collect(),
        gain_margin: margins.gain,
        phase_margin_deg: margins.phase_deg,
        delay_margin_ms: delay_margin_ms(target, bears),
    })
}
