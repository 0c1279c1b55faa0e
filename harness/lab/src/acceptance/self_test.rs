//! Tests the bench: timing, repeatability, and the share of faulty controllers that the plan's
//! scenarios catch.

use crate::acceptance::config::SessionHooks;
use crate::acceptance::error::AcceptError;
use crate::acceptance::plan::Plan;
use crate::acceptance::scenario_run::ScenarioRun;
use crate::acceptance::session_record::{SelfTestRecord, StepRecord, TrustRecord, write_file};
use platebench_engine::{CancelToken, Clock, Pacing, TimeBase};
use platebench_experiments::trust::report::{CONFIDENCE, MutantOutcome, Rate};
use platebench_model::record::{Quantiles, RunRecord, Verdict};
use platebench_model::scenario::Scenario;
use platebench_model::trace::AtPath;
use platebench_rig::RigSpec;
use std::path::Path;
use std::time::Duration;
use std::{fs, io, thread};

/// Seed of the first clean run. It equals the default of `platebench suite trust --seed`.
const SEED: u64 = 31_415;
const TRUST_FILE: &str = "trust.json";
const CANCEL_POLL_INTERVAL: Duration = Duration::from_millis(20);

/// Plays the shortest scenario to the hosted controller: twice in lockstep to compare the traces,
/// then in real time to measure lateness.
pub(crate) fn run_self_test(
    plan: &Plan,
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
    plan: &Plan,
    folder: &Path,
    step: &mut StepRecord,
    cancel: &CancelToken,
) -> Result<(), AcceptError> {
    let config = platebench_experiments::trust::TrustConfig {
        scenarios: plan.scenarios.iter().map(|planned| planned.scenario.clone()).collect(),
        mutants: platebench_experiments::trust::catalogue(),
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
        thread::sleep(CANCEL_POLL_INTERVAL);
    }
    let report = measurement.join().unwrap_or(Err(platebench_experiments::trust::TrustError::Internal))?;
    fs::create_dir_all(folder).at(folder)?;
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
    use rstest::rstest;

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
