//! Plays one trial on a real plate. The controller drives the plate with its own sensor and timer.
//! The bench sends setpoints, prompts the operator and records telemetry.

mod telemetry_loop;

use telemetry_loop::{TelemetryLoop, TelemetryLoopResult};

use crate::controller_log::{is_controller_failure, refused_configuration};
use crate::plan::{Answer, Operator, Question, QuestionKind};
use crate::plant_simulation::{RowQueue, watch_rows};
use crate::trial::{Trial, TrialAbort, TrialResult};
use platebench_model::record::{OperatorRequest, RealPlateRecord, Telemetry};
use platebench_model::scenario::Scenario;
use platebench_model::trace::Row;
use platebench_plate::{Profile, Time};
use platebench_rig::{CancelToken, FaultInjector, Link, RigError, Session};
use platebench_verdict::exclusion::{needs_operator, operator_exclusion, scene_changes};
use std::panic::resume_unwind;
use std::thread;
use std::time::Duration;

const COUNTDOWN_S: u32 = 3;
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// `None` if the trial was cancelled. Fails if the controller was lost before its first telemetry.
pub(crate) fn play<L: Link>(
    session: &mut Session<FaultInjector<L>>,
    trial: &Trial<'_>,
    operator: &dyn Operator,
) -> Result<Option<TrialResult>, RigError> {
    let (scenario, cancel) = (trial.scenario, &trial.cancel);
    let Some(preparation) = prepare_plate(scenario, operator, cancel) else { return Ok(None) };
    // A fault could break a real plate, so the planned faults are removed.
    session.link_mut().set_faults(&[], 0);
    let (queue, consumer) = RowQueue::new();
    let is_attended = needs_operator(scenario) && preparation.not_done.is_none();
    let mut prompts = Prompts::from_scenario(scenario);
    let telemetry_loop = TelemetryLoop::new(session, trial, queue);
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
    let refused = refused_configuration(link_error.as_ref());
    let telemetry = Telemetry {
        violations: refused.into_iter().chain(violation).collect(),
        ended: link_error.as_ref().map(ToString::to_string),
        ended_by_controller: link_error.as_ref().is_some_and(is_controller_failure),
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
    for action in initial_prompts(scenario) {
        if !preparation.request(action, operator, cancel)? {
            return Some(preparation);
        }
    }
    for seconds in (1..=COUNTDOWN_S).rev() {
        operator.announce("the trial starts", seconds);
        cancel.sleep(Duration::from_secs(1));
        if cancel.is_cancelled() {
            return None;
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

const COUNTDOWN_STEPS_S: [u32; 4] = [3, 2, 1, 0];
/// If two actions are closer in time, only the earlier one is announced.
const MIN_PROMPT_SPACING: Time = Time::from_nanos(500_000_000);

#[derive(Debug, Clone, PartialEq)]
struct Prompt {
    at: Time,
    what: String,
}

#[derive(Debug)]
pub(super) struct Prompts {
    list: Vec<Prompt>,
    /// Time of the announcement, seconds until the action, and index in `list`.
    schedule: Vec<(Time, u32, usize)>,
    next: usize,
}

fn force_prompt(force_n: f64) -> String {
    if force_n == 0.0 {
        "take the finger off the plate".to_owned()
    } else {
        format!("press the plate with {force_n} N and hold")
    }
}

fn temperature_prompt(scenario: &Scenario, offset_k: f64) -> String {
    let reference = scenario.plate.reference_temperature_c;
    format!("bring the plate to {} °C ({offset_k:+} K)", ((reference + offset_k) * 1e3).round() / 1e3)
}

pub(super) fn initial_prompts(scenario: &Scenario) -> Vec<String> {
    let start = scenario.conditions.at(Time::ZERO);
    let mut asked = Vec::new();
    if start.temperature_offset_k != 0.0 {
        asked.push(temperature_prompt(scenario, start.temperature_offset_k));
    }
    asked.push(if start.finger_force_n == 0.0 {
        "leave the plate untouched".to_owned()
    } else {
        force_prompt(start.finger_force_n)
    });
    asked
}

impl Prompts {
    pub(super) fn from_scenario(scenario: &Scenario) -> Self {
        let scene = &scenario.conditions;
        let mut prompts = profile_prompts(&scene.finger_force_n, scenario.duration, force_prompt);
        prompts.extend(profile_prompts(&scene.temperature_offset_k, scenario.duration, |offset| {
            temperature_prompt(scenario, offset)
        }));
        prompts.sort_by_key(|prompt| prompt.at);
        let mut schedule: Vec<(Time, u32, usize)> = Vec::new();
        for (number, prompt) in prompts.iter().enumerate() {
            let instants =
                COUNTDOWN_STEPS_S.map(|left| (prompt.at.as_nanos().checked_sub(u64::from(left) * 1_000_000_000), left));
            schedule.extend(instants.into_iter().filter_map(|(at, left)| Some((Time::from_nanos(at?), left, number))));
        }
        schedule.sort_by_key(|(at, left, _)| (*at, *left));
        Self { list: prompts, schedule, next: 0 }
    }

    pub(super) fn next_due(&mut self, now: Time) -> Option<(&str, u32)> {
        let (at, left, number) = *self.schedule.get(self.next)?;
        if at > now {
            return None;
        }
        self.next += 1;
        self.list.get(number).map(|prompt| (prompt.what.as_str(), left))
    }
}

fn profile_prompts(profile: &Profile, duration: Time, word: impl Fn(f64) -> String) -> Vec<Prompt> {
    if let Profile::Sine { mean, amplitude, omega, sweep, .. } = profile {
        let hertz = |omega: f64| omega / std::f64::consts::TAU;
        let swept = || format!(", changing to {:.3} Hz", hertz(omega + sweep * duration.seconds()));
        let swept = if *sweep == 0.0 { String::new() } else { swept() };
        let what = format!("{}, then vary this value by ±{amplitude} at {} Hz{swept}", word(*mean), hertz(*omega));
        return if *amplitude == 0.0 { Vec::new() } else { vec![Prompt { at: Time::ZERO, what }] };
    }
    let mut prompts: Vec<Prompt> = Vec::new();
    let points = std::iter::successors(Some(Time::ZERO), |point| profile.next_point_after(*point));
    let mut before = profile.at(Time::ZERO);
    for point in points.take_while(|point| *point < duration) {
        // The prompt for a linear segment states the value at its end.
        let (until, goal) = match (profile, profile.next_point_after(point)) {
            (Profile::Linear(_), Some(next)) => (Some(next), profile.at(next)),
            _ => (None, profile.at(point)),
        };
        let is_new = goal != before && prompts.last().is_none_or(|last| point >= last.at + MIN_PROMPT_SPACING);
        if is_new {
            let slowly = until.map_or_else(String::new, |until| format!(", as a ramp until {} s", until.seconds()));
            prompts.push(Prompt { at: point, what: word(goal) + &slowly });
        }
        before = if is_new { goal } else { profile.at(point) };
    }
    prompts
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(value: f64) -> Time {
        Time::from_ms(value).unwrap()
    }

    fn prompt_texts(profile: &Profile) -> Vec<(f64, String)> {
        profile_prompts(profile, ms(60_000.0), force_prompt)
            .into_iter()
            .map(|prompt| (prompt.at.ms(), prompt.what))
            .collect()
    }

    #[test]
    fn announces_levels_and_ramps_at_their_start() {
        assert_eq!(prompt_texts(&Profile::constant(2.0)), []);
        let held = Profile::Hold(vec![(Time::ZERO, 0.0), (ms(5_000.0), 2.0), (ms(9_000.0), 0.0)]);
        let expected = [(5_000.0, force_prompt(2.0)), (9_000.0, "take the finger off the plate".to_owned())];
        assert_eq!(prompt_texts(&held), expected);
        let line = Profile::Linear(vec![(Time::ZERO, 0.0), (ms(5_000.0), 0.0), (ms(9_000.0), 1.5)]);
        assert_eq!(
            prompt_texts(&line),
            [(5_000.0, "press the plate with 1.5 N and hold, as a ramp until 9 s".to_owned())]
        );
        assert_eq!(profile_prompts(&held, ms(5_000.0), force_prompt), []);
        let fast = Profile::Hold((0..20).map(|n| (ms(f64::from(n) * 100.0), f64::from(n))).collect());
        assert_eq!(prompt_texts(&fast).iter().map(|(at, _)| *at).collect::<Vec<_>>(), [100.0, 600.0, 1_100.0, 1_600.0]);
    }

    #[test]
    fn counts_down_each_action_once() {
        let mut scenario = platebench_test_kit::load_scenario("paper/fig13-closed-loop.toml");
        scenario.duration = ms(10_000.0);
        scenario.conditions.finger_force_n = Profile::Hold(vec![(Time::ZERO, 0.0), (ms(2_500.0), 2.0)]);
        scenario.conditions.temperature_offset_k = Profile::constant(9.0);
        assert_eq!(initial_prompts(&scenario), ["bring the plate to 33 °C (+9 K)", "leave the plate untouched"]);
        let mut prompts = Prompts::from_scenario(&scenario);
        assert_eq!(prompts.next_due(ms(499.0)), None);
        let mut announced = Vec::new();
        for at in [500.0, 501.0, 2_400.0, 2_500.0, 9_000.0] {
            while let Some((_, left)) = prompts.next_due(ms(at)) {
                announced.push((at, left));
            }
        }
        assert_eq!(announced, [(500.0, 2), (2_400.0, 1), (2_500.0, 0)]);
    }
}
