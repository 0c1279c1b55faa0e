//! The bench under test: is it punctual, does it repeat itself, does it catch what it should.

use crate::durable;
use crate::error::AcceptError;
use crate::order::Desk;
use crate::plan::Plan;
use crate::session::{SelfTestRecord, StepRecord, TrustRecord};
use platebench_rig::RigSpec;
use platebench_runner::{Cancel, Clock, Pace, Pacing, RunFolder, rejudge, run};
use platebench_scenario::Scenario;
use platebench_trust::report::{CONFIDENCE, Outcome, Rate};
use platebench_verdict::record::{Overrides, Quantiles};
use platebench_verdict::{RunRecord, Verdict};
use std::fs;
use std::path::Path;
use std::thread;
use std::time::Duration;

/// Seed of the first clean run, as `platebench trust` has it.
const SEED: u64 = 31_415;
/// How often somebody looks whether the session was ended while the bench measures itself.
const LOOK: Duration = Duration::from_millis(20);

/// Plays the plan's shortest scenario to the bench's own controller: twice in lockstep, which must leave the same bytes, and then in real time.
pub(crate) fn self_test(
    plan: &Plan,
    real_time: bool,
    folder: &Path,
    step: &mut StepRecord,
    desk: &mut dyn Desk,
    cancel: &Cancel,
) -> Result<(), AcceptError> {
    let shortest = plan.scenarios.iter().map(|planned| &planned.scenario).min_by_key(|scenario| scenario.duration);
    let Some(scenario) = shortest else { return Err(AcceptError::NoSession(folder.to_owned())) };
    let lockstep = Clock::Lockstep { wire_time: false };
    let first = play(scenario, 1, lockstep, &folder.join("first"), desk, cancel)?;
    let second = play(scenario, 1, lockstep, &folder.join("second"), desk, cancel)?;
    let traces = |record: &RunRecord| -> Vec<Option<String>> {
        record.scenarios.iter().flat_map(|scenario| &scenario.trials).map(|trial| trial.sha256.clone()).collect()
    };
    let left = traces(&first);
    let repeats = left.iter().all(Option::is_some) && !left.is_empty() && left == traces(&second);
    let pace = Clock::RealTime(Pace { time_scale: 1.0, pacing: Pacing::Bench });
    let timed = play(scenario, plan.bench.timing_trials, pace, &folder.join("real-time"), desk, cancel)?;
    let found = punctuality(&timed, scenario, repeats);
    let SelfTestRecord { periods, overruns, lateness_us: Quantiles { p50, p99, max, .. }, .. } = found;
    let same = if repeats { "the same bytes twice" } else { "other bytes the second time" };
    let late = format!("{overruns} of {periods} control instants too late");
    let counts = if real_time { "" } else { " (in lockstep this decides nothing)" };
    step.reason = Some(format!(
        "{same} in lockstep; in real time {late}{counts}, lateness {p50:.0} µs in the median, {p99:.0} µs at 99 %, {max:.0} µs at most"
    ));
    let punctual = !real_time || (periods > 0 && overruns == 0);
    step.verdict = Some(if repeats && punctual { Verdict::Pass } else { Verdict::Inconclusive });
    step.self_test = Some(found);
    Ok(())
}

fn play(
    scenario: &Scenario,
    trials: u32,
    clock: Clock,
    folder: &Path,
    desk: &mut dyn Desk,
    cancel: &Cancel,
) -> Result<RunRecord, AcceptError> {
    let overrides = Overrides { trials: Some(trials), ..Overrides::default() };
    let mut scenario = scenario.clone();
    rejudge::apply(&overrides, &mut scenario);
    let rig = RigSpec::Hosted;
    let plan = platebench_runner::Plan {
        scenarios: vec![scenario],
        jobs: 1,
        clock,
        own_clock: rig.has_own_clock(),
        rig: rig.to_string(),
        overrides,
    };
    let connect = || match clock {
        Clock::Lockstep { .. } => rig.connect(),
        Clock::RealTime(_) | Clock::OwnPlate => rig.connect_in_real_time(),
    };
    let folder = RunFolder::create(Some(folder)).map_err(platebench_runner::RunError::from)?;
    Ok(run(&plan, &folder, &connect, cancel, &mut |event| desk.event(&event))?)
}

fn punctuality(timed: &RunRecord, scenario: &Scenario, repeats: bool) -> SelfTestRecord {
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

/// Plays the catalogue of faulty controllers and clean runs through the plan's scenarios.
pub(crate) fn trust(plan: &Plan, folder: &Path, step: &mut StepRecord, cancel: &Cancel) -> Result<(), AcceptError> {
    let order = platebench_trust::Order {
        scenarios: plan.scenarios.iter().map(|planned| planned.scenario.clone()).collect(),
        faults: platebench_trust::catalogue(),
        clean: plan.bench.clean_runs,
        seed: SEED,
        jobs: thread::available_parallelism().map_or(1, std::num::NonZero::get),
    };
    // No plate hangs on this: where the session is ended it is left to itself, and ends with the program.
    let measuring = thread::spawn(move || platebench_trust::measure(&order));
    while !measuring.is_finished() {
        if cancel.is_cancelled() {
            return Err(AcceptError::Cancelled);
        }
        thread::sleep(LOOK);
    }
    let report = measuring.join().unwrap_or(Err(platebench_trust::TrustError::Bench))?;
    fs::create_dir_all(folder).map_err(AcceptError::io(folder))?;
    let path = folder.join("trust.json");
    let text = serde_json::to_vec_pretty(&report).map_err(|error| AcceptError::io(&path)(error.into()))?;
    durable::write(&path, &text)?;
    let survived = report.faults.iter().filter(|fault| fault.outcome != Outcome::Caught);
    let found = TrustRecord {
        faults: report.kill_rate.count,
        caught: report.kill_rate.seen,
        survived: survived.map(|fault| fault.name.clone()).collect(),
        clean_runs: report.clean.false_alarm_rate.count,
        false_alarms: report.clean.alarms.len() as u32,
    };
    let least = plan.bench.least_kill_rate_percent;
    let shown = shown_at_least(report.kill_rate);
    let confidence = CONFIDENCE * 100.0;
    let most = report.clean.false_alarm_rate.bounds.map_or(f64::NAN, |[_, high]| high * 100.0);
    let blind = match found.survived.len() {
        0 => String::new(),
        others => format!(
            "; the other {others}, not caught by the plan's own scenarios ({}), are named in the record",
            plan.scenarios.len()
        ),
    };
    step.reason = Some(format!(
        "{} of {} faulty controllers caught for a right reason, which shows at {confidence} % that at least {shown:.1} % are; the plan asks that at least {least} % be shown; {} false alarms in {} clean runs, at {confidence} % at most {most:.2} %{blind}",
        found.caught, found.faults, found.false_alarms, found.clean_runs,
    ));
    let trusted = found.false_alarms == 0 && found.clean_runs > 0 && shown >= least;
    step.verdict = Some(if trusted { Verdict::Pass } else { Verdict::Inconclusive });
    step.trust = Some(found);
    Ok(())
}

/// What `seen` of `count` shows of a share, percent: its lower bound. Nothing, and that is no number, where nothing was tried.
fn shown_at_least(rate: Rate) -> f64 {
    rate.bounds.map_or(f64::NAN, |[low, _]| low * 100.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    /// By the binomial distribution: at these shares one in twenty would show as many or more.
    #[rstest]
    #[case::of_the_plan(25, 34, 58.35)]
    #[case::one_less(24, 34, 55.24)]
    #[case::all(34, 34, 91.57)]
    #[case::none(0, 34, 0.0)]
    fn what_was_seen_shows_less_than_its_share(#[case] seen: usize, #[case] count: usize, #[case] percent: f64) {
        let shown = shown_at_least(Rate::of(seen, count));
        assert!((shown - percent).abs() < 0.01, "{shown}");
    }

    #[test]
    fn where_nothing_was_tried_nothing_is_shown() {
        assert!(shown_at_least(Rate::of(0, 0)).is_nan());
    }
}
