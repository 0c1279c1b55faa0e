//! Plays one trial on a real plate. The controller drives the plate with its own sensor and timer.
//! The bench sends setpoints, prompts the operator and records telemetry.

mod prompts;
mod telemetry_loop;
mod telemetry_rows;

use crate::operator::{Answer, Operator, Question, QuestionKind};
use crate::row_queue::{RowQueue, watch_rows};
use crate::trial::{Trial, TrialAbort, TrialResult};
use platebench_model::record::{OperatorRequest, RealPlateRecord, Telemetry};
use platebench_model::scenario::Scenario;
use platebench_model::trace::Row;
use platebench_plate::Time;
use platebench_rig::{CancelToken, FaultInjector, Link, RigError, Session};
use platebench_verdict::real_plate::{needs_operator, operator_exclusion, scene_changes};
use prompts::Prompts;
use std::panic::resume_unwind;
use std::thread;
use std::time::{Duration, Instant};
use telemetry_loop::{TelemetryLoop, TelemetryLoopResult};

const COUNTDOWN_S: u32 = 3;
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// `None` if the trial was cancelled. Fails if the controller was lost before its first telemetry.
pub(crate) fn play<L: Link>(
    session: &mut Session<FaultInjector<L>>,
    trial: Trial<'_>,
    operator: &dyn Operator,
) -> Result<Option<TrialResult>, RigError> {
    let (scenario, cancel) = (trial.scenario, &trial.cancel);
    let Some(preparation) = prepare_plate(scenario, operator, cancel) else { return Ok(None) };
    // A fault could break a real plate, so the planned faults are removed.
    session.link_mut().set_faults(&[]);
    let (queue, consumer) = RowQueue::new();
    let is_attended = needs_operator(scenario) && preparation.not_done.is_none();
    let mut prompts = Prompts::from_scenario(scenario);
    let telemetry_loop = TelemetryLoop::new(session, &trial, queue);
    let (trace_rows, result) = thread::scope(|scope| {
        let telemetry_loop = scope.spawn(move || telemetry_loop.run());
        let rows = watch_rows(consumer, Vec::new(), POLL_INTERVAL, |rows| {
            if is_attended {
                prompt(rows, scenario, &mut prompts, operator);
            }
        });
        (rows, telemetry_loop.join().unwrap_or_else(|panic| resume_unwind(panic)))
    });
    let TelemetryLoopResult { abort, stop_reason, real_plate, violation } = result;
    let link_error = match abort {
        Some(TrialAbort::Cancelled) => return Ok(None),
        Some(TrialAbort::Lost(error)) if trace_rows.is_empty() => return Err(error),
        Some(TrialAbort::Lost(error)) => Some(error),
        None => None,
    };
    let Some(preparation) = confirm_actions(scenario, preparation, operator, cancel, &real_plate) else {
        return Ok(None);
    };
    let real_plate = RealPlateRecord { asked: preparation.requests, undone: preparation.not_done, ..real_plate };
    let safe_confirmed = real_plate.safe_confirmed;
    let telemetry = Telemetry {
        violations: violation.into_iter().collect(),
        ended: link_error.as_ref().map(ToString::to_string),
        stopped: stop_reason.map(str::to_owned),
        real_plate: Some(Box::new(real_plate)),
        ..Telemetry::default()
    };
    Ok(Some(TrialResult { trace_rows, telemetry, link_error, safe_confirmed }))
}

#[derive(Default)]
struct Preparation {
    requests: Vec<OperatorRequest>,
    not_done: Option<String>,
}

impl Preparation {
    /// Returns true if the operator did the action, and `None` if the run was cancelled.
    fn request(&mut self, action: String, operator: &dyn Operator, cancel: &CancelToken) -> Option<bool> {
        let answer = operator.ask(Question { text: &action, kind: QuestionKind::Action }, cancel);
        if answer == Answer::Absent && cancel.is_cancelled() {
            return None;
        }
        let done = answer.is_yes();
        self.not_done = match answer {
            _ if done => None,
            Answer::Absent => Some(format!("no operator was present for an action of the scenario: {action}")),
            Answer::Terminal(_) | Answer::CommandLine(_) => Some(format!("not done by the operator: {action}")),
        };
        self.requests.push(OperatorRequest { what: action, done });
        Some(done)
    }
}

fn prepare_plate(scenario: &Scenario, operator: &dyn Operator, cancel: &CancelToken) -> Option<Preparation> {
    let mut preparation = Preparation::default();
    if !needs_operator(scenario) {
        return Some(preparation);
    }
    if let Some(exclusion) = operator_exclusion(scenario) {
        preparation.not_done = Some(exclusion.to_string());
        return Some(preparation);
    }
    for action in prompts::initial_prompts(scenario) {
        if !preparation.request(action, operator, cancel)? {
            return Some(preparation);
        }
    }
    for seconds in (1..=COUNTDOWN_S).rev() {
        operator.announce("the trial starts", seconds);
        let until = Instant::now() + Duration::from_secs(1);
        while Instant::now() < until {
            if cancel.is_cancelled() {
                return None;
            }
            thread::sleep(POLL_INTERVAL);
        }
    }
    operator.announce("the trial runs", 0);
    Some(preparation)
}

/// Asks the operator to confirm the announced actions, unless a sensor measured them.
fn confirm_actions(
    scenario: &Scenario,
    mut preparation: Preparation,
    operator: &dyn Operator,
    cancel: &CancelToken,
    record: &RealPlateRecord,
) -> Option<Preparation> {
    operator.trial_ended();
    let (coldest, warmest) = scenario.conditions.temperature_offset_k.range();
    let is_measured = record.force_measured && coldest == warmest;
    if preparation.not_done.is_none() && scene_changes(scenario) && !is_measured {
        let action = "confirm that finger and heat were as announced during the trial";
        preparation.request(action.to_owned(), operator, cancel)?;
    }
    Some(preparation)
}

fn prompt(rows: &[Row], scenario: &Scenario, prompts: &mut Prompts, operator: &dyn Operator) {
    let Some(row) = rows.last() else { return };
    let now = Time::from_seconds(row.t_s).unwrap_or(Time::ZERO);
    while let Some((action, seconds)) = prompts.next_due(now) {
        operator.announce(action, seconds);
    }
    let force = Some(row.finger_force_n).filter(|force| !force.is_nan());
    operator.show_force(now, scenario.conditions.at(now).finger_force_n, force);
}
