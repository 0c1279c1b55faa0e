//! Searches a design that meets a target, and the causes if none does.

use crate::loops::closed_loop::AnalysisError;
use crate::loops::controller::Discretisation;
use crate::tuning::design::{GainDesign, TuningTarget};
use crate::tuning::evaluation::{DesignEvaluation, design_delay_boundary, evaluate_design};
use crate::tuning::search::DesignSearch;
use crate::tuning::spread::{PlateSpread, Sensitivity, evaluate_sensitivity};
use platebench_engine::delay_boundary::DelayBoundary;
use platebench_plate::Tier;
use serde::Serialize;

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case", tag = "kind")]
pub enum InfeasibilityCause {
    /// The drive limit cannot hold the setpoint.
    OutOfReach { needed_vpp: f64 },
    /// The drive limit does not allow the response time.
    DriveFloor { floor_ms: f64, needed_vpp: f64 },
    /// The response time ends before the first command with feedback acts.
    Period { first_feedback_ms: f64 },
    /// Equation 24 for the target's response time is unstable at the target's delay.
    Delay {
        /// Longest stable delay. 0 if the loop is unstable without delay.
        boundary_ms: f64,
    },
    /// Only designs with less phase margin meet the target.
    PhaseMargin {
        /// Phase margin of the design that otherwise meets the target, degrees.
        found_deg: f64,
    },
    /// No design of this discretisation is fast enough at this period and delay.
    Discretisation,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TuningResult {
    pub met: bool,
    pub obstacles: Vec<InfeasibilityCause>,
    /// Shortest time into the band with the drive limit. `None` if the setpoint is out of reach.
    pub floor_ms: Option<f64>,
    /// Equation 24 for the target's response time, in each discretisation.
    pub readings: Vec<DesignEvaluation>,
    pub chosen: Option<DesignEvaluation>,
    /// The fastest design with the target's phase margin, if no design meets the target.
    pub possible: Option<DesignEvaluation>,
    /// The chosen design on other plates, or the possible design if none is chosen.
    pub sensitivity: Option<Sensitivity>,
}

pub fn tune(
    target: &TuningTarget<'_>,
    discretisation: Discretisation,
    spread: &PlateSpread,
) -> Result<TuningResult, AnalysisError> {
    let printed = |discretisation| evaluate_design(target, GainDesign::new(target, discretisation, target.response));
    let readings = Discretisation::ALL.into_iter().map(printed).collect::<Result<Vec<_>, _>>()?;
    let search = DesignSearch::new(target, discretisation);
    // If the drive limit cannot hold the setpoint, a response inside the band does not count.
    let holds = target.mode().drive_for(target.setpoint) <= target.plate.drive_limit_vpp;
    let meeting = if holds { search.meeting_target(target.phase_margin_deg)? } else { None };
    let chosen = meeting.map(|candidate| evaluate_design(target, candidate.design)).transpose()?;
    let (mut obstacles, mut possible) = (Vec::new(), None);
    if chosen.is_none() {
        obstacles = infeasibility_causes(target, discretisation, &search)?;
        let fastest = if holds { search.fastest(target.phase_margin_deg)? } else { None };
        possible = fastest.map(|candidate| evaluate_design(target, candidate.design)).transpose()?;
    }
    let design = chosen.as_ref().or(possible.as_ref());
    let sensitivity = design.map(|figures| evaluate_sensitivity(target, &figures.design, spread)).transpose()?;
    let floor_ms = target.time_floor().map(|seconds| seconds * 1e3);
    Ok(TuningResult { met: chosen.is_some(), obstacles, floor_ms, readings, chosen, possible, sensitivity })
}

fn infeasibility_causes(
    target: &TuningTarget<'_>,
    discretisation: Discretisation,
    search: &DesignSearch<'_>,
) -> Result<Vec<InfeasibilityCause>, AnalysisError> {
    let mode = target.mode();
    let mut causes = Vec::new();
    let needed = |seconds: f64| 0.95 * mode.drive_for(target.setpoint) / (1.0 - (-mode.sigma * seconds).exp());
    let holds = mode.drive_for(target.setpoint);
    if holds > target.plate.drive_limit_vpp {
        causes.push(InfeasibilityCause::OutOfReach { needed_vpp: holds });
    } else if let Some(floor) = target.time_floor().filter(|floor| *floor > target.response) {
        causes.push(InfeasibilityCause::DriveFloor { floor_ms: floor * 1e3, needed_vpp: needed(target.response) });
    }
    let feedback = target.period() + target.delay;
    if target.response < feedback {
        causes.push(InfeasibilityCause::Period { first_feedback_ms: feedback * 1e3 });
    }
    let itself = GainDesign::new(target, discretisation, target.response);
    let bears = design_delay_boundary(target, target.plate, &itself)?;
    if let DelayBoundary::Unstable | DelayBoundary::At(_) = bears {
        let boundary = bears.seconds().unwrap_or(0.0);
        if boundary <= target.delay {
            causes.push(InfeasibilityCause::Delay { boundary_ms: boundary * 1e3 });
        }
    }
    if let Some(stable) = search.meeting_target(0.0)? {
        let closed = stable.design.closed_loop(target, target.plate, Tier::Modal, [true; 2])?;
        causes.push(InfeasibilityCause::PhaseMargin { found_deg: closed.margins().phase_deg.unwrap_or(180.0) });
    }
    if causes.is_empty() {
        causes.push(InfeasibilityCause::Discretisation);
    }
    Ok(causes)
}
