//! Gains for a plate: equation 24 in its readings, what each does, whether a demand can be met, and what could be met instead.
//!
//! * [`design`]: what is asked, and the gains.
//! * [`transient`]: what |W| does on the exact plate.
//! * [`search`]: which response time to design for, and the fastest there is.
//! * [`spread`]: the same gains on plates that are not quite the one designed for.
//! * [`shown`]: all of it in words.
//!
//! Field names of what is told carry their units, because they are those of the JSON.

pub mod design;
pub mod search;
pub mod shown;
pub mod spread;
pub mod transient;

use crate::closed_loop::AnalysisError;
use crate::controller::Pi;
use crate::margins::{DelayBoundary, delay_boundary};
use crate::step::StepResponse;
use design::{Demand, Design, Reading};
use platebench_plate::{Plate, Tier};
use search::Search;
use serde::Serialize;
use spread::{Sensitivity, Spread};
use transient::Transient;

/// A delay boundary is looked for up to so many periods and time constants of the plate beyond the delay.
const LONGEST: f64 = 8.0;
/// Poles closer to 0 than this are those of commands on their way.
const ON_THE_WAY: f64 = 1e-6;

/// One loop of a design, with the other one open. Margins are those at the demand's delay.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LoopFigures {
    /// Vpp per µm, or rad/s per unit of Wq/Wd.
    pub kp: f64,
    /// The same and per second.
    pub ki_per_s: f64,
    /// Poles in the z plane, [re, im], without those of commands on their way.
    pub poles: Vec<[f64; 2]>,
    /// The largest distance of a pole from 0.
    pub spectral_radius: f64,
    /// Factor by which the gain may rise; `None` where any may.
    pub gain_margin: Option<f64>,
    /// Degrees; `None` where |L| never is 1.
    pub phase_margin_deg: Option<f64>,
    /// What the delay may grow by, ms: 0 or less where it is unstable already, `None` where it is stable as far as was looked.
    pub delay_margin_ms: Option<f64>,
}

/// What a setpoint step looks like.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StepFigures {
    /// 5 % settling time; `None` where it does not settle.
    pub settling_ms: Option<f64>,
    /// Overshoot.
    pub overshoot_percent: f64,
    /// Highest drive.
    pub peak_drive_vpp: f64,
}

impl From<StepResponse> for StepFigures {
    fn from(response: StepResponse) -> Self {
        Self {
            settling_ms: response.settling.map(|seconds| seconds * 1e3),
            overshoot_percent: response.overshoot * 100.0,
            peak_drive_vpp: response.peak_drive,
        }
    }
}

impl From<Transient> for StepFigures {
    fn from(transient: Transient) -> Self {
        Self {
            settling_ms: transient.settling.map(|seconds| seconds * 1e3),
            overshoot_percent: transient.overshoot * 100.0,
            peak_drive_vpp: transient.peak_drive,
        }
    }
}

/// A design and what it does.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Figures {
    /// How equation 24 was read.
    pub reading: Reading,
    /// The response time that was put into it, ms.
    pub designed_for_ms: f64,
    /// The amplitude's loop.
    pub amplitude: LoopFigures,
    /// The frequency's loop.
    pub frequency: LoopFigures,
    /// Both loops on the modal plate: the largest distance of a pole from 0.
    pub spectral_radius: f64,
    /// The linear loop on the envelope: no ripple and no limit.
    pub linear: StepFigures,
    /// |W| on the modal plate within the drive limit.
    pub plate: StepFigures,
    /// Control periods at the limit.
    pub saturated_periods: u32,
    /// The design itself.
    #[serde(skip)]
    pub design: Design,
}

/// Why a demand cannot be met.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case", tag = "kind")]
pub enum Obstacle {
    /// The drive limit does not hold the setpoint at all.
    OutOfReach {
        /// What would, Vpp.
        needed_vpp: f64,
    },
    /// The drive limit gets nobody there in time.
    DriveFloor {
        /// The shortest time, ms.
        floor_ms: f64,
        /// The drive that would be in time, Vpp.
        needed_vpp: f64,
    },
    /// The response is over before anything that was measured acts.
    Period {
        /// From the step to the first command with feedback in it, ms.
        first_feedback_ms: f64,
    },
    /// Equation 24 for this response is unstable at this delay.
    Delay {
        /// The longest delay that it bears, ms; 0 where it bears none.
        boundary_ms: f64,
    },
    /// It is met by designs with less phase to spare than was asked for.
    PhaseMargin {
        /// What the fastest of them that is stable leaves, degrees.
        found_deg: f64,
    },
    /// No design of this reading is that fast at this period and delay.
    Reading,
}

/// All that there is to say.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Tuning {
    /// True where the demand is met.
    pub met: bool,
    /// Why not.
    pub obstacles: Vec<Obstacle>,
    /// The shortest time in which the drive limit gets anybody there, ms; `None` where it does not at all.
    pub floor_ms: Option<f64>,
    /// Equation 24 for the demanded response, in each reading.
    pub readings: Vec<Figures>,
    /// The design that meets the demand.
    pub chosen: Option<Figures>,
    /// The fastest design, with the phase margin asked for; where the demand is not met.
    pub possible: Option<Figures>,
    /// The chosen, or else the possible design on other plates.
    pub sensitivity: Option<Sensitivity>,
}

/// Tunes: `reading` is the one to choose from.
///
/// # Errors
/// [`AnalysisError`] of any of the loops.
pub fn tune(demand: &Demand<'_>, reading: Reading, spread: &Spread) -> Result<Tuning, AnalysisError> {
    let printed = |reading| figures(demand, Design::new(demand, reading, demand.response));
    let readings = Reading::ALL.into_iter().map(printed).collect::<Result<Vec<_>, _>>()?;
    let search = Search::new(demand, reading);
    // Within the band of a setpoint that the limit does not hold is not at it.
    let holds = demand.mode().drive_for(demand.setpoint) <= demand.plate.drive_limit_vpp;
    let meeting = if holds { search.meeting(demand.phase_margin_deg)? } else { None };
    let chosen = meeting.map(|candidate| figures(demand, candidate.design)).transpose()?;
    let (mut obstacles, mut possible) = (Vec::new(), None);
    if chosen.is_none() {
        obstacles = self::obstacles(demand, reading, &search)?;
        let fastest = if holds { search.fastest(demand.phase_margin_deg)? } else { None };
        possible = fastest.map(|candidate| figures(demand, candidate.design)).transpose()?;
    }
    let shown = chosen.as_ref().or(possible.as_ref());
    let sensitivity = shown.map(|figures| spread::sensitivity(demand, &figures.design, spread)).transpose()?;
    let floor_ms = demand.floor().map(|seconds| seconds * 1e3);
    Ok(Tuning { met: chosen.is_some(), obstacles, floor_ms, readings, chosen, possible, sensitivity })
}

fn obstacles(demand: &Demand<'_>, reading: Reading, search: &Search<'_>) -> Result<Vec<Obstacle>, AnalysisError> {
    let mode = demand.mode();
    let mut found = Vec::new();
    let needed = |seconds: f64| 0.95 * mode.drive_for(demand.setpoint) / (1.0 - (-mode.sigma * seconds).exp());
    let holds = mode.drive_for(demand.setpoint);
    if holds > demand.plate.drive_limit_vpp {
        found.push(Obstacle::OutOfReach { needed_vpp: holds });
    } else if let Some(floor) = demand.floor().filter(|floor| *floor > demand.response) {
        found.push(Obstacle::DriveFloor { floor_ms: floor * 1e3, needed_vpp: needed(demand.response) });
    }
    let feedback = demand.period() + demand.delay;
    if demand.response < feedback {
        found.push(Obstacle::Period { first_feedback_ms: feedback * 1e3 });
    }
    let itself = Design::new(demand, reading, demand.response);
    let bears = boundary(demand, demand.plate, &itself)?;
    if let DelayBoundary::Never | DelayBoundary::At(_) = bears {
        let boundary = bears.seconds().unwrap_or(0.0);
        if boundary <= demand.delay {
            found.push(Obstacle::Delay { boundary_ms: boundary * 1e3 });
        }
    }
    if let Some(stable) = search.meeting(0.0)? {
        let closed = stable.design.closed(demand, demand.plate, Tier::Modal, [true; 2])?;
        found.push(Obstacle::PhaseMargin { found_deg: closed.margins().phase_deg.unwrap_or(180.0) });
    }
    if found.is_empty() {
        found.push(Obstacle::Reading);
    }
    Ok(found)
}

/// The delay that both loops of the design bear together on `plate`.
fn boundary(demand: &Demand<'_>, plate: &Plate, design: &Design) -> Result<DelayBoundary, AnalysisError> {
    let (plant, controller) = design.parts(&Demand { plate, ..*demand }, Tier::Modal);
    delay_boundary(&plant, &controller, demand.period(), longest(demand))
}

fn longest(demand: &Demand<'_>) -> f64 {
    demand.delay + LONGEST * (demand.period() + design_time(demand))
}

/// The plate's time constant or the response, whichever is longer, s.
fn design_time(demand: &Demand<'_>) -> f64 {
    (1.0 / demand.mode().sigma).max(demand.response)
}

/// What is left from the demand's delay to a boundary, ms.
fn left(demand: &Demand<'_>, boundary: DelayBoundary) -> Option<f64> {
    match boundary {
        DelayBoundary::Never => Some(0.0 - demand.delay * 1e3),
        DelayBoundary::At(seconds) => Some((seconds - demand.delay) * 1e3),
        DelayBoundary::Beyond(_) => None,
    }
}

/// A design and what it does.
///
/// # Errors
/// [`AnalysisError`] of any of the loops.
pub fn figures(demand: &Demand<'_>, design: Design) -> Result<Figures, AnalysisError> {
    let Design { amplitude, frequency, reading, response } = design;
    let both = design.closed(demand, demand.plate, Tier::Modal, [true; 2])?;
    let alone = design.closed(demand, demand.plate, Tier::Envelope, [true, false])?;
    let transient = design.step(demand, demand.plate, demand.force_n);
    Ok(Figures {
        reading,
        designed_for_ms: response * 1e3,
        amplitude: loop_figures(demand, &design, amplitude, [true, false])?,
        frequency: loop_figures(demand, &design, frequency, [false, true])?,
        spectral_radius: both.spectral_radius()?,
        linear: alone.step(demand.setpoint, demand.horizon()).into(),
        plate: transient.into(),
        saturated_periods: transient.saturated_periods,
        design,
    })
}

fn loop_figures(demand: &Demand<'_>, design: &Design, pi: Pi, which: [bool; 2]) -> Result<LoopFigures, AnalysisError> {
    let closed = design.closed(demand, demand.plate, Tier::Envelope, which)?;
    let mut poles = closed.poles()?;
    // At resonance Wd and Wq do not touch each other on the envelope: one pole is the other component's own.
    let other = (-demand.mode().sigma * demand.period()).exp();
    let distance = |pole: &nalgebra::Complex<f64>| (pole - other).norm();
    let nearest = (0..poles.len()).min_by(|a, b| distance(&poles[*a]).total_cmp(&distance(&poles[*b])));
    if let Some(nearest) = nearest {
        poles.remove(nearest);
    }
    poles.retain(|pole| pole.norm() > ON_THE_WAY);
    poles.sort_by(|a, b| b.norm().total_cmp(&a.norm()).then(b.im.total_cmp(&a.im)));
    let margins = closed.margins();
    let (plant, mut controller) = design.parts(demand, Tier::Envelope);
    controller.drive = controller.drive.filter(|_| which[0]);
    controller.frequency = controller.frequency.filter(|_| which[1]);
    let bears = delay_boundary(&plant, &controller, demand.period(), longest(demand))?;
    Ok(LoopFigures {
        kp: pi.proportional,
        ki_per_s: pi.integral_per_period / demand.period(),
        spectral_radius: poles.iter().fold(0.0, |largest, pole| pole.norm().max(largest)),
        poles: poles.iter().map(|pole| [pole.re, pole.im]).collect(),
        gain_margin: margins.gain,
        phase_margin_deg: margins.phase_deg,
        delay_margin_ms: left(demand, bears),
    })
}
