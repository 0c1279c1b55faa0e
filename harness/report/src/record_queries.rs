//! Finds keys, trials and missed expectations in a record.

use platebench_model::record::{
    Assessment, Cause, ClockKind, Exclusion, Excuse, ExpectationRecord, Limit, LoopSymptom, Metric, MissingShard,
    MissingValue, NotApplicable, NotPlayed, Reason, RunRecord, ScenarioRecord, Statistic, TrialFinding, TrialRecord,
    UnmodelledInstance, Verdict, ViolationKind, defmt_path,
};
use platebench_model::scenario::NotApplicableExpectation;
use platebench_model::{quoted, quoted_path};
use std::cmp::Reverse;
use std::mem::{Discriminant, discriminant};
use std::ops::Range;
use std::path::Path;

const MAX_PROTOCOL_DIFFERENCES: usize = 3;

pub(crate) fn trial_to_inspect(scenario: &ScenarioRecord, index: usize) -> Option<&TrialRecord> {
    scenario.expectations.get(index).filter(|found| found.verdict != Verdict::Pass)?;
    deciding_trial(scenario, index)
}

/// The trial that decided the verdict of the expectation, otherwise the first trial.
pub(crate) fn deciding_trial(scenario: &ScenarioRecord, index: usize) -> Option<&TrialRecord> {
    let expectation = scenario.expectations.get(index)?;
    let recorded = expectation.worst.as_ref();
    if let Some(trial) = recorded.and_then(|worst| scenario.trials.iter().find(|trial| trial.index == worst.trial)) {
        return Some(trial);
    }
    let key = scenario.metric_key(index);
    let number = |trial: &TrialRecord| trial.metrics.number(&key);
    let decided = match (expectation.cause, expectation.value) {
        (Some(cause @ (Cause::Rig | Cause::Bench)), _) => {
            scenario.trials.iter().find(|trial| trial.cause == Some(cause))
        }
        (_, None) => scenario.trials.iter().find(|trial| trial.metrics.get(&key) == Some(None)),
        (_, value) if expectation.statistic == Statistic::Worst => {
            scenario.trials.iter().find(|trial| trial.cause.is_none() && number(trial) == value)
        }
        (_, Some(_)) => {
            let sized = scenario.trials.iter().filter_map(|trial| Some((trial, number(trial)?.abs())));
            sized.max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.index.cmp(&a.0.index))).map(|(trial, _)| trial)
        }
    };
    decided.or_else(|| scenario.trials.first())
}

fn with_verdict(scenario: &ScenarioRecord, verdict: Verdict) -> impl Iterator<Item = usize> {
    let all = scenario.expectations.iter().enumerate();
    all.filter(move |(_, found)| found.verdict == verdict).map(|(index, _)| index)
}

pub(crate) fn indices_not_passed(scenario: &ScenarioRecord) -> impl Iterator<Item = usize> {
    with_verdict(scenario, Verdict::Fail).chain(with_verdict(scenario, Verdict::Inconclusive))
}

pub(crate) fn expectations_not_passed(record: &RunRecord) -> Vec<(&ScenarioRecord, usize)> {
    let of = |verdict: Verdict| {
        let scenarios = record.scenarios.iter();
        scenarios.flat_map(move |scenario| with_verdict(scenario, verdict).map(move |index| (scenario, index)))
    };
    of(Verdict::Fail).chain(of(Verdict::Inconclusive)).collect()
}

/// Cause that several expectations and scenarios can share.
#[derive(Debug, Clone, Copy, PartialEq)]
enum SharedCause<'a> {
    /// The controller was lost for the same fault at the same place.
    Lost(&'a str),
    Stopped(Option<&'a str>),
    Violation(ViolationKind),
    Excluded(Discriminant<Exclusion>),
    NotPlayed,
    TimeLimit,
    TooFewTrials,
}

/// Expectations that did not pass for one cause.
#[derive(Debug, Clone)]
pub(crate) struct CauseGroup<'a> {
    pub(crate) verdict: Verdict,
    cause: Option<SharedCause<'a>>,
    /// Index of the scenario, the scenario, and index of its expectation.
    pub(crate) members: Vec<(usize, &'a ScenarioRecord, usize)>,
}

impl<'a> CauseGroup<'a> {
    /// Each scenario once, with the indices of its expectations.
    pub(crate) fn scenarios(&self) -> Vec<(usize, &'a ScenarioRecord, Vec<usize>)> {
        let parts = self.members.chunk_by(|one, other| one.0 == other.0);
        let scenario = |part: &[(usize, &'a ScenarioRecord, usize)]| {
            let (place, scenario, _) = part.first().copied()?;
            Some((place, scenario, part.iter().map(|member| member.2).collect()))
        };
        parts.filter_map(scenario).collect()
    }

    /// Number of trials in which the controller was lost. `None` for other causes.
    pub(crate) fn lost_trials(&self) -> Option<usize> {
        let Some(SharedCause::Lost(cause)) = self.cause else { return None };
        let scenarios = self.scenarios();
        let trials = scenarios.iter().flat_map(|(_, scenario, _)| &scenario.trials);
        Some(trials.filter(|trial| end_cause(trial) == Some(cause)).count())
    }
}

/// Groups the expectations that did not pass. Failures come first, and the groups have the order
/// of their first expectations.
pub(crate) fn cause_groups(record: &RunRecord) -> Vec<CauseGroup<'_>> {
    let mut groups: Vec<CauseGroup<'_>> = Vec::new();
    for verdict in [Verdict::Fail, Verdict::Inconclusive] {
        for (place, scenario) in record.scenarios.iter().enumerate() {
            for index in with_verdict(scenario, verdict) {
                let cause = shared_cause(scenario, index);
                let same = |group: &&mut CauseGroup<'_>| group.verdict == verdict && group.cause == cause;
                match groups.iter_mut().find(same).filter(|_| cause.is_some()) {
                    Some(group) => group.members.push((place, scenario, index)),
                    None => groups.push(CauseGroup { verdict, cause, members: vec![(place, scenario, index)] }),
                }
            }
        }
    }
    groups
}

fn end_cause(trial: &TrialRecord) -> Option<&str> {
    trial.telemetry.end_cause.as_deref().or(trial.telemetry.ended.as_deref())
}

fn shared_cause(scenario: &ScenarioRecord, index: usize) -> Option<SharedCause<'_>> {
    let trial = |number: u32| scenario.trials.iter().find(|trial| trial.index == number);
    match scenario.expectations.get(index)?.reason.as_ref()? {
        Reason::Trial { trial: number, ended: Some(ended), .. } => {
            Some(SharedCause::Lost(trial(*number).and_then(end_cause).unwrap_or(ended)))
        }
        Reason::Trial { trial: number, finding: TrialFinding::Missing(MissingValue::NotRunning), .. } => {
            Some(SharedCause::Stopped(trial(*number).and_then(|trial| trial.telemetry.stopped.as_deref())))
        }
        Reason::Violation { violation, .. } => Some(SharedCause::Violation(violation.kind)),
        Reason::Excluded { exclusion, .. } => Some(SharedCause::Excluded(discriminant(exclusion))),
        Reason::NotPlayed { .. } => Some(SharedCause::NotPlayed),
        Reason::TimeLimit { .. } => Some(SharedCause::TimeLimit),
        Reason::TooFewTrials { .. } => Some(SharedCause::TooFewTrials),
        _ => None,
    }
}

/// Time scale of the run if a slower `--time-scale` or `--clock lockstep` may decide an expectation.
/// [`Excuse::LoopDelay`] and [`Excuse::OwnLawDelay`] say so themselves.
pub(crate) fn late_time_scale(record: &RunRecord) -> Option<f64> {
    let is_late = |expectation: &ExpectationRecord| {
        matches!(
            expectation.reason,
            Some(
                Reason::Excluded { exclusion: Exclusion::LateBench { .. } | Exclusion::NoAnswer { .. }, .. }
                    | Reason::Excused(Excuse::RealTimeDelay)
            )
        )
    };
    let expectations = || record.scenarios.iter().flat_map(|scenario| &scenario.expectations);
    let mut trials = record.scenarios.iter().flat_map(|scenario| &scenario.trials);
    let scale = trials.find_map(|trial| Some(trial.telemetry.timing.as_deref()?.time_scale));
    (record.clock == ClockKind::RealTime && expectations().any(is_late)).then(|| scale.unwrap_or(1.0))
}

/// Wall time by which ser2net 4 delays every answer by default, ms: 3.2 on an idle machine.
const SERVER_DELAY_MS: Range<f64> = 2.8..4.2;
/// The delay of a server is constant; that of a busy network or bench is not.
const MAX_SERVER_SPREAD_MS: f64 = 1.0;

/// Median wall time from a sample to its answer over a network, if it has the signature of a server
/// that collects characters: about 3 ms, and constant.
pub(crate) fn server_delay_ms(record: &RunRecord) -> Option<f64> {
    let is_network = matches!(record.rig.kind(), "tcp" | "rfc2217") && record.clock == ClockKind::RealTime;
    let trials = record.scenarios.iter().flat_map(|scenario| &scenario.trials).filter(|_| is_network);
    let delays = trials.filter_map(|trial| {
        let timing = trial.telemetry.timing.as_deref()?;
        let wall_ms = |delay_us: f64| delay_us / timing.time_scale / 1e3;
        timing.loop_delay_us.map(|delay| (wall_ms(delay.p50), wall_ms(delay.p99)))
    });
    let mut typical = None;
    for (median, high) in delays {
        if !SERVER_DELAY_MS.contains(&median) || high - median > MAX_SERVER_SPREAD_MS {
            return None;
        }
        typical.get_or_insert(median);
    }
    typical
}

pub(crate) fn smallest_margin(record: &RunRecord) -> Option<(&ScenarioRecord, &ExpectationRecord, f64)> {
    smallest_margins(record).first().map(|(_, scenario, expectation, margin)| (*scenario, *expectation, *margin))
}

/// Passed expectations whose limits leave a margin, the smallest first, with the scenario's index.
pub(crate) fn smallest_margins(record: &RunRecord) -> Vec<(usize, &ScenarioRecord, &ExpectationRecord, f64)> {
    let scenarios = record.scenarios.iter().enumerate();
    let all = scenarios.flat_map(|(index, scenario)| scenario.expectations.iter().map(move |of| (index, scenario, of)));
    let passed = all.filter(|(_, _, found)| found.verdict == Verdict::Pass && allows_margin(found));
    let rated = passed.filter_map(|(index, scenario, found)| Some((index, scenario, found, found.margin?)));
    let mut rated: Vec<_> = rated.collect();
    rated.sort_by(|a, b| a.3.total_cmp(&b.3));
    rated
}

pub(crate) fn closest_expectation(scenario: &ScenarioRecord) -> Option<usize> {
    let rated = scenario.expectations.iter().enumerate().filter(|(_, found)| allows_margin(found));
    let rated = rated.filter_map(|(index, found)| Some((index, found.margin?)));
    rated.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(index, _)| index)
}

/// False if only one value can meet the limit, as for `overruns ≤ 0` or `missed_replies 5 … 5`.
fn allows_margin(expectation: &ExpectationRecord) -> bool {
    let (least, most) = expectation.metric.spec().value_range;
    match expectation.limit {
        Limit::AtMost(high) => high > least,
        Limit::AtLeast(low) => low < most,
        Limit::Within(low, high) => low < high,
        Limit::About(_) => true,
    }
}

/// The slowest scenario, with the wall time of its trials in ms. `None` for a single scenario.
pub(crate) fn slowest_scenario(record: &RunRecord) -> Option<(&ScenarioRecord, f64)> {
    let wall_ms = |scenario: &ScenarioRecord| scenario.trials.iter().filter_map(|trial| trial.wall_ms).sum::<f64>();
    let timed = record.scenarios.iter().map(|scenario| (scenario, wall_ms(scenario)));
    let timed = timed.filter(|(_, wall_ms)| *wall_ms > 0.0 && record.scenarios.len() > 1);
    timed.max_by(|a, b| a.1.total_cmp(&b.1))
}

/// Scenarios whose longest control step fits barely into the period on the emulated chip, with its
/// share in percent, the largest first. Omits scenarios that state a limit of their own.
pub(crate) fn tight_steps(record: &RunRecord) -> Vec<(&ScenarioRecord, f64)> {
    let states_limit =
        |scenario: &ScenarioRecord| scenario.expectations.iter().any(|found| found.metric == Metric::StepTime);
    let mut tight: Vec<_> = record
        .scenarios
        .iter()
        .filter(|scenario| !states_limit(scenario))
        .filter_map(|scenario| {
            let steps = scenario.trials.iter().filter_map(|trial| trial.telemetry.step_time);
            let longest = steps.max_by(|a, b| a.longest_percent.total_cmp(&b.longest_percent))?;
            longest.is_tight().then_some((scenario, longest.longest_percent))
        })
        .collect();
    tight.sort_by(|a, b| b.1.total_cmp(&a.1));
    tight
}

/// The first trial of each scenario whose trace shows a likely cause.
pub(crate) fn symptoms(record: &RunRecord) -> impl Iterator<Item = (&ScenarioRecord, u32, LoopSymptom)> {
    record.scenarios.iter().filter_map(|scenario| {
        let (trial, symptom) = symptom_of(scenario)?;
        Some((scenario, trial, symptom))
    })
}

/// The first scenario of each kind of symptom, and the number of further scenarios that show it. The
/// most frequent kind is first.
pub(crate) fn symptom_groups(record: &RunRecord) -> Vec<((&ScenarioRecord, u32, LoopSymptom), usize)> {
    let mut groups: Vec<((&ScenarioRecord, u32, LoopSymptom), usize)> = Vec::new();
    for found in symptoms(record) {
        let kind = discriminant(&found.2);
        match groups.iter_mut().find(|((.., known), _)| discriminant(known) == kind) {
            Some((_, further)) => *further += 1,
            None => groups.push((found, 0)),
        }
    }
    groups.sort_by_key(|(_, further)| Reverse(*further));
    groups
}

/// The first trial with a symptom. A scenario that passed needs no explanation.
pub(crate) fn symptom_of(scenario: &ScenarioRecord) -> Option<(u32, LoopSymptom)> {
    let is_shown = |symptom: &LoopSymptom| scenario.verdict != Verdict::Pass || !symptom.explains_failures_only();
    scenario.trials.iter().find_map(|trial| Some((trial.index, trial.symptom.filter(is_shown)?)))
}

/// Command that decodes the frames of `defmt` of the first trial with a remark, or else of the
/// first trial with frames.
pub(crate) fn defmt_command(elf: &str, scenarios: &[ScenarioRecord]) -> Option<String> {
    let trials = scenarios.iter().flat_map(|scenario| &scenario.trials);
    let mut trials = trials.filter(|trial| trial.telemetry.defmt_bytes.is_some());
    let trial = trials.clone().find(|trial| trial.reason.is_some()).or_else(|| trials.next())?;
    let frames = defmt_path(&trial.trace);
    Some(format!("defmt-print -e {} < {}", quoted_path(Path::new(elf)), quoted_path(Path::new(&frames))))
}

/// Names the instances of the emulated chip without a model that the firmware used.
pub(crate) fn unmodelled_instances(record: &RunRecord) -> Option<String> {
    let trials = record.scenarios.iter().flat_map(|scenario| &scenario.trials);
    let used = trials.map(|trial| &trial.telemetry.unmodelled_instances).max_by_key(|instances| instances.len())?;
    let name = |used: &UnmodelledInstance| {
        format!("{} ({}, accesses: {})", used.instance, used.registers.join(", "), used.accesses)
    };
    (!used.is_empty()).then(|| used.iter().map(name).collect::<Vec<_>>().join(", "))
}

/// Names the scripts of the protocol check that some trial did not play. `None` if all were played.
pub fn scripts_not_played(record: &RunRecord) -> Option<String> {
    let trials = record.scenarios.iter().flat_map(|scenario| &scenario.trials);
    let scripts =
        crate::format::distinct(trials.flat_map(|trial| &trial.telemetry.scripts_not_played).map(String::as_str));
    let count = crate::format::count(scripts.len(), "script");
    let names = scripts.join(", ");
    (!scripts.is_empty()).then(|| format!("{count} of the protocol check ({names}); `run --long-scripts` plays them"))
}

/// Files of the scenarios that `--fail-fast` did not play.
pub(crate) fn unplayed_scenarios(record: &RunRecord) -> Vec<&str> {
    let scenarios = Assessment::of(record).scenarios.into_iter();
    let unplayed = scenarios.filter(|found| found.played == 0 && found.not_played == Some(NotPlayed::FailFast));
    unplayed.map(|scenario| scenario.file).collect()
}

/// The first differences that the check of the protocol found, if they are why an expectation is not
/// met. Sentences of the controller's answers.
pub(crate) fn protocol_differences(scenario: &ScenarioRecord, index: usize) -> &[String] {
    let is_of_check = |expectation: &ExpectationRecord| {
        expectation.metric == Metric::ProtocolDifferences && expectation.verdict == Verdict::Fail
    };
    let differences = scenario
        .expectations
        .get(index)
        .filter(|expectation| is_of_check(expectation))
        .and_then(|_| trial_to_inspect(scenario, index)?.telemetry.protocol_differences.as_deref())
        .unwrap_or_default();
    differences.get(..MAX_PROTOCOL_DIFFERENCES).unwrap_or(differences)
}

/// Scenarios that fail the run, because they are not applicable although `--require-all` needs them.
pub(crate) fn required_not_applicable(record: &RunRecord) -> &[NotApplicable] {
    if record.overrides.require_all { &record.not_applicable } else { &[] }
}

/// Scenarios that change no verdict, because they are not applicable.
pub(crate) fn skipped_scenarios(record: &RunRecord) -> &[NotApplicable] {
    if record.overrides.require_all { &[] } else { &record.not_applicable }
}

/// Verdict of a run or a scenario that none of its parts has, with its reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct OwnVerdict {
    pub(crate) verdict: Verdict,
    pub(crate) reason: String,
}

/// The only place that derives a verdict of the run for a report. `None` if the verdicts of the
/// scenarios explain that of the run.
pub(crate) fn own_verdict_of_run(record: &RunRecord) -> Option<OwnVerdict> {
    let of_scenarios = Verdict::combine(record.scenarios.iter().map(|scenario| scenario.verdict));
    let required = required_not_applicable(record);
    let is_empty = record.scenarios.is_empty() && required.is_empty();
    let shards = record.merge.iter().flat_map(|merge| &merge.missing_shards);
    let shards = shards
        .map(|MissingShard { board, shard, shards }| format!("shard {shard}/{shards} of {} is missing", quoted(board)));
    let unfinished = (!record.complete).then_some("the run was not finished");
    let empty = (record.complete && is_empty).then_some("the run has no scenarios");
    let reasons = record.unsafe_end().into_iter().chain(unfinished).chain(empty).map(str::to_owned);
    let mut reasons: Vec<String> = reasons.chain(shards).collect();
    if reasons.is_empty() {
        let is_explained = record.verdict == Verdict::Pass || of_scenarios != Verdict::Pass || !required.is_empty();
        reasons.extend((!is_explained).then(|| "the run did not pass".to_owned()));
    }
    let is_own_failure = record.drive_after_safe || (of_scenarios != Verdict::Fail && required.is_empty());
    let is_failure = record.verdict == Verdict::Fail && is_own_failure;
    let verdict = if is_failure { Verdict::Fail } else { Verdict::Inconclusive };
    (!reasons.is_empty()).then(|| OwnVerdict { verdict, reason: reasons.join("; ") })
}

/// As [`own_verdict_of_run`], for a scenario and its expectations.
pub(crate) fn own_verdict_of_scenario(scenario: &ScenarioRecord) -> Option<OwnVerdict> {
    let is_explained = scenario.expectations.iter().any(|expectation| expectation.verdict != Verdict::Pass);
    let reason =
        if scenario.expectations.is_empty() { "no expectation was judged" } else { "the scenario did not pass" };
    let is_own = scenario.verdict != Verdict::Pass && !is_explained;
    is_own.then(|| OwnVerdict { verdict: scenario.verdict, reason: reason.to_owned() })
}

/// Index of the scenario `X-open-loop` for a scenario `X-closed-loop`.
pub(crate) fn open_loop_counterpart(record: &RunRecord, scenario: &ScenarioRecord) -> Option<usize> {
    let bare = |file: &str| file.strip_suffix(".toml").unwrap_or(file).to_owned();
    let wanted = format!("{}-open-loop", bare(&scenario.file).strip_suffix("-closed-loop")?);
    record.scenarios.iter().position(|other| bare(&other.file) == wanted)
}

/// Expectations that do not apply to the controller's own law, for one reason.
pub(crate) struct NotApplicableGroup<'a> {
    pub(crate) reason: &'a str,
    pub(crate) expectations: usize,
    /// Number of scenarios that were not played, because this reason applies to all of their
    /// expectations.
    pub(crate) unplayed: usize,
}

/// Expectations of played scenarios that do not apply to the controller's own law.
pub(crate) fn skipped_expectations(
    record: &RunRecord,
) -> impl Iterator<Item = (&ScenarioRecord, &NotApplicableExpectation)> {
    record.scenarios.iter().flat_map(|scenario| scenario.not_applicable.iter().map(move |skipped| (scenario, skipped)))
}

/// The largest group comes first.
pub(crate) fn not_applicable_groups(record: &RunRecord) -> Vec<NotApplicableGroup<'_>> {
    let played = skipped_expectations(record).map(|(_, expectation)| (expectation.reason.as_str(), 1, 0));
    let unplayed = record.not_applicable.iter().filter(|scenario| scenario.expectations > 0);
    let unplayed = unplayed.map(|scenario| (scenario.reason.as_str(), scenario.expectations, 1));
    let mut groups: Vec<NotApplicableGroup<'_>> = Vec::new();
    for (reason, expectations, unplayed) in played.chain(unplayed) {
        match groups.iter_mut().find(|group| group.reason == reason) {
            Some(group) => {
                group.expectations += expectations;
                group.unplayed += unplayed;
            }
            None => groups.push(NotApplicableGroup { reason, expectations, unplayed }),
        }
    }
    groups.sort_by_key(|group| Reverse(group.expectations));
    groups
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_model::record::{Evidence, MetricDefinition, MetricValues, Telemetry};

    #[test]
    fn behind_a_mean_stands_the_trial_that_is_farthest_off() {
        let expectation = ExpectationRecord {
            name: String::new(),
            windows_ms: Vec::new(),
            worst: None,
            metric: Metric::StaticError,
            verdict: Verdict::Fail,
            value: Some(2.0),
            statistic: Statistic::Mean,
            limit: Limit::AtMost(1.0),
            margin: None,
            bench_error: None,
            interval: None,
            confidence: None,
            cause: None,
            reason: None,
            paper: None,
            requirement: None,
            definition: MetricDefinition::default(),
            evidence: Evidence::default(),
        };
        let trial_of = |index, value| {
            let mut metrics = MetricValues::default();
            metrics.set("static_error_percent", Some(value));
            TrialRecord {
                index,
                seed: 1,
                trace: String::new(),
                metrics,
                cause: None,
                reason: None,
                sha256: None,
                telemetry: Telemetry::default(),
                symptom: None,
                diverged_at_s: None,
                wall_ms: None,
            }
        };
        let mut scenario = ScenarioRecord {
            file: "a.toml".to_owned(),
            title: String::new(),
            source: None,
            tags: Vec::new(),
            verdict: Verdict::Fail,
            law: String::new(),
            model: String::new(),
            period_ms: None,
            inputs: Vec::new(),
            expectations: vec![expectation],
            not_applicable: Vec::new(),
            requirement_texts: std::collections::BTreeMap::new(),
            time_limit_s: None,
            planned_trials: None,
            trials: vec![trial_of(0, 1.0), trial_of(1, 3.0), trial_of(2, 3.0), trial_of(3, 2.0)],
        };
        assert_eq!(trial_to_inspect(&scenario, 0).unwrap().index, 1);
        scenario.expectations[0].verdict = Verdict::Pass;
        assert!(trial_to_inspect(&scenario, 0).is_none(), "a pass needs no look");
    }
}
