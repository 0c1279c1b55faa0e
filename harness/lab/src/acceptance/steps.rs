//! Describes a session (plan, rig, record folder, operator, observer) and runs its steps:
//! questions, self-test of the bench, trust of the scenarios, scenarios.

use crate::acceptance::plan::{AcceptancePlan, AnswerKind, Ask, QuestionTime, RepeatedScenario};
use crate::acceptance::seal::SecretKey;
use crate::acceptance::session_record::{
    AcceptError, AnswerRecord, SelfTestRecord, SessionDetails, StepKind, StepRecord, TrustRecord, write_file,
};
use platebench_engine::{
    Answer, CancelToken, Clock, Event, LiveTap, Operator, Pacing, Question, QuestionKind, RunError, RunHooks, RunPlan,
    TimeBase, rejudge, run,
};
use platebench_experiments::trust::report::{CONFIDENCE, MutantOutcome, Rate};
use platebench_model::record::{Overrides, Quantiles, RunFolder, RunRecord, Verdict};
use platebench_model::scenario::Scenario;
use platebench_model::trace::{AtPath, create_folder};
use platebench_rig::{CANCEL_POLL_INTERVAL, ConnectOptions, RigSpec};
use std::path::{Path, PathBuf};
use std::{io, thread};

#[derive(Debug, Clone)]
pub struct SessionConfig {
    pub plan: AcceptancePlan,
    pub rig: RigSpec,
    pub clock: Clock,
    pub jobs: usize,
    pub out: PathBuf,
    /// If true, `out` must contain a session to resume.
    pub resume: bool,
    pub details: SessionDetails,
    pub signing_key: Option<SecretKey>,
    /// Names of instruments whose invalid calibration does not stop the session.
    pub waived_calibrations: Vec<String>,
}

pub struct SessionHooks<'a> {
    pub operator: &'a dyn Operator,
    pub observer: &'a mut dyn SessionObserver,
    pub cancel: &'a CancelToken,
}

pub trait SessionObserver {
    fn step_started(&mut self, step: &StepRecord);
    fn step_ended(&mut self, step: &StepRecord);
    fn run_event(&mut self, event: &Event);
    fn live_tap(&mut self, plan: &RunPlan) -> LiveTap;
}

#[derive(Debug, Clone, Copy)]
pub(crate) enum StepAction<'a> {
    Identity,
    Ask(&'a Ask),
    SelfTest,
    Trust,
    Scenario(&'a RepeatedScenario),
}

pub(crate) fn step_actions(plan: &AcceptancePlan) -> Vec<StepAction<'_>> {
    let asks = |when| plan.asks.iter().filter(move |ask| ask.when == when).map(StepAction::Ask);
    let mut actions = vec![StepAction::Identity];
    actions.extend(asks(QuestionTime::Before));
    actions.extend([StepAction::SelfTest, StepAction::Trust]);
    actions.extend(plan.scenarios.iter().map(StepAction::Scenario));
    actions.extend(asks(QuestionTime::After));
    actions
}

pub(crate) fn step_records(plan: &AcceptancePlan) -> Vec<StepRecord> {
    let describe = |action: StepAction<'_>| match action {
        StepAction::Identity => ("identity".to_owned(), "Board and firmware".to_owned(), StepKind::Identity),
        StepAction::Ask(ask) => (format!("ask-{}", ask.id), ask.question.clone(), StepKind::Ask),
        StepAction::SelfTest => {
            ("self-test".to_owned(), "Timing and repeatability of the bench".to_owned(), StepKind::SelfTest)
        }
        StepAction::Trust => {
            ("trust".to_owned(), "How well the scenarios catch faulty controllers".to_owned(), StepKind::Trust)
        }
        StepAction::Scenario(planned) => {
            let name = planned.scenario.name().replace(['/', '\\'], "-");
            (name, planned.scenario.title.clone(), StepKind::Scenario)
        }
    };
    let numbered = step_actions(plan).into_iter().enumerate();
    numbered
        .map(|(index, action)| {
            let (name, title, kind) = describe(action);
            StepRecord::new(format!("{:02}-{name}", index + 1), &title, kind)
        })
        .collect()
}

pub(crate) struct ScenarioRun<'a> {
    pub(crate) scenario: &'a Scenario,
    pub(crate) trials: u32,
    pub(crate) rig: &'a RigSpec,
    pub(crate) clock: Clock,
    pub(crate) jobs: usize,
}

impl ScenarioRun<'_> {
    pub(crate) fn play(&self, folder: &Path, hooks: &mut SessionHooks<'_>) -> Result<RunRecord, AcceptError> {
        let overrides = Overrides { trials: Some(self.trials), ..Overrides::default() };
        let mut scenario = self.scenario.clone();
        rejudge::apply_overrides(&overrides, &mut scenario);
        let plan = RunPlan::new(self.rig, self.clock, self.jobs, vec![scenario], overrides);
        let folder = RunFolder::create(Some(folder)).map_err(RunError::from)?;
        let options = ConnectOptions { cancel: hooks.cancel.clone(), ..ConnectOptions::default() };
        let run_hooks = RunHooks {
            cancel: hooks.cancel.clone(),
            live_tap: hooks.observer.live_tap(&plan),
            on_event: Box::new(|event| hooks.observer.run_event(&event)),
            ..RunHooks::default()
        };
        run(&plan, &folder, &|| self.clock.connect(self.rig, &options), run_hooks).map_err(|error| match error {
            RunError::Cancelled => AcceptError::Cancelled,
            error => error.into(),
        })
    }
}

/// Asks the question and stores the answer in `step`. Before the first scenario, a no stops the
/// session. A missing answer stops it if the rig may drive a plate.
pub(crate) fn ask_operator(
    ask: &Ask,
    rig: &RigSpec,
    step: &mut StepRecord,
    operator: &dyn Operator,
    cancel: &CancelToken,
) -> Result<(), AcceptError> {
    let kind = match ask.answer {
        AnswerKind::Confirm => QuestionKind::Confirm,
        AnswerKind::Text => QuestionKind::Text,
        AnswerKind::Number => QuestionKind::Number,
    };
    let answer = operator.ask(Question { text: &ask.question, kind }, cancel);
    if cancel.is_cancelled() {
        return Err(AcceptError::Cancelled);
    }
    if ask.answer == AnswerKind::Confirm {
        if ask.when == QuestionTime::Before && !answer.is_yes() {
            let question = ask.question.clone();
            match answer {
                Answer::Absent if !rig.is_simulated() => {
                    return Err(AcceptError::Unanswered { question, rig: rig.to_string() });
                }
                Answer::Absent => {}
                Answer::Terminal(_) | Answer::CommandLine(_) => return Err(AcceptError::AnsweredNo(question)),
            }
        }
        step.verdict = Some(if answer.is_yes() { Verdict::Pass } else { Verdict::Inconclusive });
        step.reason = match answer.text() {
            None => Some("no answer".to_owned()),
            Some(_) if !answer.is_yes() => Some("the answer was no".to_owned()),
            Some(_) => None,
        };
    }
    let from = match answer {
        Answer::Terminal(_) => "terminal",
        Answer::CommandLine(_) => "command-line",
        Answer::Absent => "not-asked",
    };
    step.answer = Some(AnswerRecord { text: answer.text().map(str::to_owned), from: from.to_owned() });
    Ok(())
}

/// Seed of the first clean run. It equals the default of `platebench suite trust --seed`.
const SEED: u64 = 31_415;
const TRUST_FILE: &str = "trust.json";

/// Plays the shortest scenario to the hosted controller: twice in lockstep to compare the traces,
/// then in real time to measure lateness.
pub(crate) fn run_self_test(
    plan: &AcceptancePlan,
    real_time: bool,
    folder: &Path,
    step: &mut StepRecord,
    hooks: &mut SessionHooks<'_>,
) -> Result<(), AcceptError> {
    let shortest = plan.scenarios.iter().map(|planned| &planned.scenario).min_by_key(|scenario| scenario.duration);
    let Some(scenario) = shortest else { return Err(AcceptError::NoSession(folder.to_owned())) };
    let lockstep = ScenarioRun {
        scenario,
        trials: 1,
        rig: &RigSpec::hosted(),
        clock: Clock::Lockstep { wire_time: false },
        jobs: 1,
    };
    let first = trace_hashes(&lockstep.play(&folder.join("first"), hooks)?);
    let second = trace_hashes(&lockstep.play(&folder.join("second"), hooks)?);
    let repeats = first.iter().all(Option::is_some) && !first.is_empty() && first == second;
    let clock = Clock::RealTime(TimeBase { time_scale: 1.0, pacing: Pacing::Bench });
    let timed = ScenarioRun { trials: plan.bench.timing_trials, clock, ..lockstep };
    let result = self_test_record(&timed.play(&folder.join("real-time"), hooks)?, scenario, repeats);
    let SelfTestRecord { periods, overruns, lateness_us: Quantiles { p50, p99, max, .. }, .. } = result;
    let same = if repeats { "equal traces" } else { "different traces" };
    let relevance = if real_time { "" } else { " (not relevant to a session in lockstep)" };
    step.reason = Some(format!(
        "two lockstep runs gave {same}; in real time the bench was too late for {overruns} of {periods} control \
         instants{relevance}, lateness {p50:.0} µs median, {p99:.0} µs at 99 %, {max:.0} µs maximum"
    ));
    let punctual = !real_time || (periods > 0 && overruns == 0);
    step.verdict = Some(if repeats && punctual { Verdict::Pass } else { Verdict::Inconclusive });
    step.self_test = Some(result);
    Ok(())
}

fn trace_hashes(record: &RunRecord) -> Vec<Option<String>> {
    record.scenarios.iter().flat_map(|scenario| &scenario.trials).map(|trial| trial.sha256.clone()).collect()
}

fn self_test_record(timed: &RunRecord, scenario: &Scenario, repeats: bool) -> SelfTestRecord {
    let trials = timed.scenarios.iter().flat_map(|scenario| &scenario.trials);
    let mut found = SelfTestRecord {
        scenario: scenario.file.clone(),
        repeats,
        periods: 0,
        overruns: 0,
        lateness_us: Quantiles::default(),
        scheduling: String::new(),
    };
    for timing in trials.filter_map(|trial| trial.telemetry.timing.as_ref()) {
        found.periods += timing.periods;
        found.overruns += timing.overruns;
        found.scheduling.clone_from(&timing.scheduling);
        let (worst, now) = (&mut found.lateness_us, timing.lateness_us);
        *worst = Quantiles {
            p50: worst.p50.max(now.p50),
            p99: worst.p99.max(now.p99),
            p999: worst.p999.max(now.p999),
            max: worst.max.max(now.max),
        };
    }
    found
}

pub(crate) fn measure_trust(
    plan: &AcceptancePlan,
    folder: &Path,
    step: &mut StepRecord,
    cancel: &CancelToken,
) -> Result<(), AcceptError> {
    let config = platebench_experiments::trust::TrustConfig {
        scenarios: plan.scenarios.iter().map(|planned| planned.scenario.clone()).collect(),
        mutants: platebench_experiments::trust::catalogue(),
        protocol_faults: Vec::new(),
        variants: platebench_experiments::trust::clean_variants(),
        clean_runs: plan.bench.clean_runs,
        seed: SEED,
        jobs: thread::available_parallelism().map_or(1, std::num::NonZero::get),
    };
    // If the session is cancelled, this thread runs on until the program ends. This is safe because
    // the measurement drives no plate.
    let measurement = thread::spawn(move || platebench_experiments::trust::measure(&config));
    while !measurement.is_finished() {
        if cancel.is_cancelled() {
            return Err(AcceptError::Cancelled);
        }
        cancel.sleep(CANCEL_POLL_INTERVAL);
    }
    let report = measurement.join().unwrap_or(Err(platebench_experiments::trust::TrustError::Internal))?;
    create_folder(folder).at(folder)?;
    let text = serde_json::to_vec_pretty(&report).map_err(io::Error::from).at(&folder.join(TRUST_FILE))?;
    write_file(folder, TRUST_FILE, &text)?;
    let survived = report.faults.iter().filter(|fault| fault.outcome != MutantOutcome::Caught);
    let result = TrustRecord {
        faults: report.kill_rate.count,
        caught: report.kill_rate.seen,
        survived: survived.map(|fault| fault.name.clone()).collect(),
        clean_runs: report.clean.false_alarm_rate.count,
        false_alarms: report.clean.alarms.len() as u32,
    };
    let required = plan.bench.least_kill_rate_percent;
    let bound = lower_bound_percent(report.kill_rate);
    let confidence = CONFIDENCE * 100.0;
    let alarm_bound = report.clean.false_alarm_rate.bounds.map_or(f64::NAN, |[_, high]| high * 100.0);
    let survivors = match result.survived.len() {
        0 => String::new(),
        count => {
            format!("; the record names the {count} that the plan's {} scenarios did not catch", plan.scenarios.len())
        }
    };
    step.reason = Some(format!(
        "{} of {} faulty controllers caught for a right reason: at least {bound:.1} % at {confidence} % confidence, \
         the plan requires {required} %; {} false alarms in {} clean runs: at most {alarm_bound:.2} % at \
         {confidence} % confidence{survivors}",
        result.caught, result.faults, result.false_alarms, result.clean_runs,
    ));
    let trusted = result.false_alarms == 0 && result.clean_runs > 0 && bound >= required;
    step.verdict = Some(if trusted { Verdict::Pass } else { Verdict::Inconclusive });
    step.trust = Some(result);
    Ok(())
}

fn lower_bound_percent(rate: Rate) -> f64 {
    rate.bounds.map_or(f64::NAN, |[low, _]| low * 100.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acceptance::session_record::StepKind;
    use rstest::rstest;

    struct FixedAnswer(Answer);

    impl Operator for FixedAnswer {
        fn ask(&self, _: Question<'_>, _: &CancelToken) -> Answer {
            self.0.clone()
        }
    }

    fn ask_with_answer(
        rig: &str,
        answer: AnswerKind,
        when: QuestionTime,
        given: Answer,
    ) -> Result<StepRecord, AcceptError> {
        let ask = Ask { id: "safe".to_owned(), question: "Is it safe?".to_owned(), answer, when };
        let mut step = StepRecord::new("02-ask-safe".to_owned(), &ask.question, StepKind::Ask);
        ask_operator(&ask, &rig.parse().unwrap(), &mut step, &FixedAnswer(given), &CancelToken::never()).map(|()| step)
    }

    const BOARD_RIGS: [&str; 4] =
        ["serial:/dev/ttyUSB0", "exec:a {port}", "probe:STM32F407VG", "probe:STM32F407VG,elf=a"];
    const SIMULATED_RIGS: [&str; 3] = ["hosted", "emulated", "emulated:a.elf"];

    #[test]
    fn a_rig_with_a_board_needs_a_confirmation() {
        for rig in BOARD_RIGS {
            let stopped = ask_with_answer(rig, AnswerKind::Confirm, QuestionTime::Before, Answer::Absent).unwrap_err();
            assert!(matches!(&stopped, AcceptError::Unanswered { question, .. } if question == "Is it safe?"), "{rig}");
            let message = stopped.to_string();
            assert!(message.contains(rig) && message.contains("--yes"), "{message}");
        }
        for rig in SIMULATED_RIGS {
            let step = ask_with_answer(rig, AnswerKind::Confirm, QuestionTime::Before, Answer::Absent).unwrap();
            assert_eq!(step.verdict, Some(Verdict::Inconclusive), "{rig}");
        }
    }

    #[rstest]
    #[case::terminal(Answer::Terminal("yes".to_owned()))]
    #[case::command_line(Answer::CommandLine("yes".to_owned()))]
    fn yes_continues_and_no_stops_on_every_rig(#[case] yes: Answer) {
        for rig in BOARD_RIGS.iter().chain(&SIMULATED_RIGS) {
            let step = ask_with_answer(rig, AnswerKind::Confirm, QuestionTime::Before, yes.clone()).unwrap();
            assert_eq!(step.verdict, Some(Verdict::Pass), "{rig}");
            let no = ask_with_answer(rig, AnswerKind::Confirm, QuestionTime::Before, Answer::Terminal("no".to_owned()));
            assert!(matches!(no, Err(AcceptError::AnsweredNo(_))), "{rig}");
        }
    }

    #[test]
    fn a_no_after_the_last_scenario_does_not_stop() {
        for given in [Answer::Absent, Answer::Terminal("no".to_owned())] {
            let step = ask_with_answer("serial:p", AnswerKind::Confirm, QuestionTime::After, given).unwrap();
            assert_eq!(step.verdict, Some(Verdict::Inconclusive));
        }
        let step = ask_with_answer("serial:p", AnswerKind::Text, QuestionTime::Before, Answer::Absent).unwrap();
        assert_eq!((step.verdict, step.answer.unwrap().text), (None, None), "a text decides nothing");
    }

    /// Clopper-Pearson: at a rate equal to the bound, `seen` or more catches have probability 5 %.
    #[rstest]
    #[case::of_the_plan(25, 34, 58.35)]
    #[case::one_less(24, 34, 55.24)]
    #[case::all(34, 34, 91.57)]
    #[case::none(0, 34, 0.0)]
    fn lower_bound_is_below_the_observed_share(#[case] seen: usize, #[case] count: usize, #[case] percent: f64) {
        let bound = lower_bound_percent(Rate::new(seen, count));
        assert!((bound - percent).abs() < 0.01, "{bound}");
    }

    #[test]
    fn lower_bound_of_no_trials_is_not_a_number() {
        assert!(lower_bound_percent(Rate::new(0, 0)).is_nan());
    }
}
