//! Compares the stored trials of a run with a reference: a baseline, a trace or another run. Builds
//! a baseline (the accepted reference response) from a run.

use crate::rejudge::{RejudgeError, load_stored_scenario, read_trial_rows};
use platebench_model::record::{RECORD_FILE, RecordError, RunRecord, ScenarioRecord, TrialRecord, Verdict};
use platebench_model::trace::{FileError, Row, TraceError, read_trace};
use platebench_verdict::golden::{
    Baseline, BaselineError, GoldenTubes, JudgedResponse, LearnError, LearningParameters, TubeComparison,
    gap_between_rows, row_step_ms,
};
use std::path::{Path, PathBuf};

#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    #[error(transparent)]
    Record(#[from] RecordError),
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error(transparent)]
    Stored(#[from] RejudgeError),
    #[error(transparent)]
    Baseline(#[from] BaselineError),
    #[error("{}: this trace is not in a run folder, so its scenario is unknown; \
        expected the .toml file of a baseline", .0.display())]
    NoScenario(PathBuf),
    #[error("{}: the run has {count} scenarios, expected one: a single trace is compared with it", path.display())]
    SeveralScenarios { path: PathBuf, count: usize },
    #[error(transparent)]
    File(#[from] FileError),
}

pub struct ScenarioTrials {
    /// Scenario file as in `run.json`, or path of the trace if the trials are a single trace.
    pub name: String,
    pub trials: Vec<StoredTrial>,
    pub excluded: Vec<String>,
}

pub struct StoredTrial {
    pub index: u32,
    /// Largest time between two rows that the scenario allows, ms. `None` if it is unknown.
    pub row_step_ms: Option<f64>,
    source: TraceSource,
}

enum TraceSource {
    File(PathBuf),
    Run { folder: PathBuf, trial: Box<TrialRecord> },
}

impl StoredTrial {
    pub fn rows(&self) -> Result<Vec<Row>, CompareError> {
        match &self.source {
            TraceSource::File(path) => Ok(read_trace(path)?),
            TraceSource::Run { folder, trial } => Ok(read_trial_rows(folder, trial)?),
        }
    }

    /// False if the controller was lost, so that the rest of the trace is a plate at 0 V.
    pub(crate) fn is_complete(&self) -> bool {
        match &self.source {
            TraceSource::File(_) => true,
            TraceSource::Run { trial, .. } => trial.telemetry.ended.is_none(),
        }
    }
}

pub fn is_run_folder(path: &Path) -> bool {
    path.join(RECORD_FILE).exists() || path.is_dir()
}

pub fn read_trials(path: &Path) -> Result<Vec<ScenarioTrials>, CompareError> {
    if !is_run_folder(path) {
        let trials = vec![StoredTrial { index: 0, row_step_ms: None, source: TraceSource::File(path.to_owned()) }];
        return Ok(vec![ScenarioTrials { name: path.display().to_string(), trials, excluded: Vec::new() }]);
    }
    Ok(read_trials_of(&RunRecord::read(path)?, path))
}

/// `folder` is the run folder of `record`.
pub fn read_trials_of(record: &RunRecord, folder: &Path) -> Vec<ScenarioTrials> {
    record.scenarios.iter().map(|scenario| read_scenario_trials(folder, scenario)).collect()
}

pub fn read_scenario_trials(folder: &Path, scenario: &ScenarioRecord) -> ScenarioTrials {
    let played = load_stored_scenario(folder, scenario).ok();
    let mut trials = ScenarioTrials { name: scenario.file.clone(), trials: Vec::new(), excluded: Vec::new() };
    for trial in &scenario.trials {
        if let Some(cause) = trial.cause {
            let reason = trial.reason.as_ref().map_or_else(|| "it was disturbed".to_owned(), ToString::to_string);
            trials.excluded.push(format!("trial {} does not count ({cause}): {reason}", trial.index));
        } else {
            let source = TraceSource::Run { folder: folder.to_owned(), trial: Box::new(trial.clone()) };
            // A real plate has one row per control period.
            let period = trial.telemetry.real_plate.as_ref().and(scenario.period_ms).unwrap_or_default();
            let row_step_ms = played.as_ref().map(|played| played.trace_step.ms().max(period));
            trials.trials.push(StoredTrial { index: trial.index, row_step_ms, source });
        }
    }
    trials
}

pub const BASELINE_KEYWORD: &str = "baseline";

pub struct Reference {
    curves: ReferenceCurves,
    /// `None` for a single trace, and if the reference does not contain the scenario.
    pub response: Option<JudgedResponse>,
}

enum ReferenceCurves {
    SameTubes(Box<GoldenTubes>),
    PerTrial(Vec<StoredTrial>),
    Nothing(&'static str),
}

const NO_SCENARIO: &str = "the reference does not contain this scenario";
const NO_TIME_RANGE: &str = "the reference has fewer than two rows, expected rows over a time range";

impl Reference {
    /// `against` is [`BASELINE_KEYWORD`] or the path of a baseline (TOML), trace or run folder.
    pub fn find(
        subject: &Path,
        against: &str,
        baselines: &Path,
        scenario: &ScenarioTrials,
    ) -> Result<Self, CompareError> {
        let trace = |golden: Option<GoldenTubes>| Self {
            curves: golden
                .map_or(ReferenceCurves::Nothing(NO_TIME_RANGE), |golden| ReferenceCurves::SameTubes(Box::new(golden))),
            response: None,
        };
        let nothing = Self { curves: ReferenceCurves::Nothing(NO_SCENARIO), response: None };
        let reference = Path::new(against);
        if against == BASELINE_KEYWORD {
            let named = if is_run_folder(subject) { Some(scenario.name.clone()) } else { scenario_of(subject) };
            let Some(name) = named else { return Err(CompareError::NoScenario(subject.to_owned())) };
            return Ok(Baseline::read(baselines, &name)?.map_or(nothing, Self::from));
        }
        if reference.extension().is_some_and(|extension| extension == "toml") {
            return Ok(Baseline::read_files(reference, &reference.with_extension("csv"))?.into());
        }
        if !is_run_folder(reference) {
            return Ok(trace(GoldenTubes::from_rows(&read_trace(reference)?)));
        }
        let record = RunRecord::read(reference)?;
        let mut others = read_trials_of(&record, reference);
        for other in &mut others {
            other.trials.retain(StoredTrial::is_complete);
        }
        if is_run_folder(subject) {
            let other = record.scenarios.iter().zip(others).find(|(_, other)| other.name == scenario.name);
            return Ok(other.map_or(nothing, |(other, trials)| Self {
                curves: ReferenceCurves::PerTrial(trials.trials),
                response: Some(JudgedResponse::of(&record, other)),
            }));
        }
        match (others.pop(), others.len()) {
            (Some(only), 0) => {
                let first = only.trials.first().map(StoredTrial::rows).transpose()?;
                Ok(trace(first.and_then(|rows| GoldenTubes::from_rows(&rows))))
            }
            (_, further) => Err(CompareError::SeveralScenarios { path: reference.to_owned(), count: further + 1 }),
        }
    }

    pub fn tubes_for(&self, index: u32) -> Result<Option<GoldenTubes>, CompareError> {
        match &self.curves {
            ReferenceCurves::SameTubes(golden) => Ok(Some((**golden).clone())),
            ReferenceCurves::PerTrial(others) => tubes_of_trial(others, index),
            ReferenceCurves::Nothing(_) => Ok(None),
        }
    }

    pub fn compare(&self, scenario: &ScenarioTrials) -> Result<TubeComparison, CompareError> {
        match &self.curves {
            ReferenceCurves::SameTubes(golden) => compare_with_tubes(golden, scenario),
            ReferenceCurves::PerTrial(others) => compare_trial_by_trial(others, scenario),
            ReferenceCurves::Nothing(why) => Ok(empty_comparison(why)),
        }
    }
}

impl From<Baseline> for Reference {
    fn from(accepted: Baseline) -> Self {
        let curves = ReferenceCurves::SameTubes(Box::new(accepted.golden));
        Self { curves, response: Some(accepted.response) }
    }
}

/// Describes the first time without rows that is longer than the row step. Curves are linear
/// between rows, so a difference in this time would not be found. The row step is that of the
/// scenario, or else that of the other trace.
fn describe_gap(
    golden: &GoldenTubes,
    golden_step_ms: Option<f64>,
    trial: &StoredTrial,
    rows: &[Row],
) -> Option<String> {
    let describe = |of: String, [from, to]: [f64; 2], step: f64| {
        // Instants are whole nanoseconds.
        let [from, to, step] = [from, to, step].map(|ms| (ms * 1e6).round() / 1e6);
        format!("{of} has no rows between {from} and {to} ms, expected one at least every {step} ms")
    };
    let step = trial.row_step_ms.unwrap_or_else(|| golden.row_step_ms());
    if let Some(gap) = gap_between_rows(rows, step) {
        return Some(describe(format!("trial {}", trial.index), gap, step));
    }
    let step = golden_step_ms.unwrap_or_else(|| row_step_ms(rows));
    // A trial of one row has another time range, which the comparison reports.
    (step > 0.0).then(|| golden.gap(step)).flatten().map(|gap| describe("the reference".to_owned(), gap, step))
}

fn tubes_of_trial(trials: &[StoredTrial], index: u32) -> Result<Option<GoldenTubes>, CompareError> {
    let trial = trials.iter().find(|trial| trial.index == index);
    Ok(trial.map(StoredTrial::rows).transpose()?.and_then(|rows| GoldenTubes::from_rows(&rows)))
}

fn empty_comparison(why: &str) -> TubeComparison {
    TubeComparison { verdict: Verdict::Inconclusive, trials: 0, outside: 0, worst: None, reason: Some(why.to_owned()) }
}

fn compare_trial_by_trial(others: &[StoredTrial], scenario: &ScenarioTrials) -> Result<TubeComparison, CompareError> {
    let mut all = empty_comparison("no trial to compare");
    let mut verdicts = Vec::new();
    let mut first_gap = None;
    let mut reasons = scenario.excluded.clone();
    for trial in &scenario.trials {
        let Some(golden) = tubes_of_trial(others, trial.index)? else {
            reasons.push(format!("the reference has no complete trial {} of two rows or more", trial.index));
            continue;
        };
        let rows = trial.rows()?;
        let other_step_ms = others.iter().find(|other| other.index == trial.index).and_then(|other| other.row_step_ms);
        let gap = describe_gap(&golden, other_step_ms, trial, &rows);
        let one = golden.compare([(trial.index, rows)]);
        verdicts.push(one.verdict);
        if gap.is_some() {
            verdicts.push(Verdict::Fail);
            first_gap = first_gap.or(gap);
        }
        all.trials += 1;
        all.outside += one.outside;
        if let Some((_, found)) = &one.worst
            && all.worst.as_ref().is_none_or(|(_, worst)| found.ratio() > worst.ratio())
        {
            all.worst = one.worst;
        } else if one.verdict == Verdict::Inconclusive {
            reasons.extend(one.reason);
        }
    }
    if !reasons.is_empty() {
        verdicts.push(Verdict::Inconclusive);
    }
    all.verdict = Verdict::combine(verdicts);
    let (outside, trials) = (all.outside, all.trials);
    all.reason = match all.verdict {
        Verdict::Pass => None,
        Verdict::Fail if outside == 0 => first_gap,
        Verdict::Fail => Some(format!("{outside} of {trials} trials are outside the tube")),
        Verdict::Inconclusive => reasons.into_iter().next().or(all.reason),
    };
    Ok(all)
}

/// Returns inconclusive instead of pass if the scenario has excluded trials.
fn compare_with_tubes(golden: &GoldenTubes, scenario: &ScenarioTrials) -> Result<TubeComparison, CompareError> {
    // Reads one trace at a time, because all traces together may exceed the memory.
    let mut failed = None;
    let mut gap = None;
    let readable = scenario.trials.iter().map_while(|trial| match trial.rows() {
        Ok(rows) => {
            if gap.is_none() {
                gap = describe_gap(golden, None, trial, &rows);
            }
            Some((trial.index, rows))
        }
        Err(error) => {
            failed = Some(error);
            None
        }
    });
    let comparison = golden.compare(readable);
    if let Some(error) = failed {
        return Err(error);
    }
    Ok(match scenario.excluded.first() {
        _ if gap.is_some() && comparison.outside == 0 => {
            TubeComparison { verdict: Verdict::Fail, reason: gap, ..comparison }
        }
        _ if gap.is_some() => TubeComparison { verdict: Verdict::Fail, ..comparison },
        Some(what) if comparison.verdict == Verdict::Pass => {
            TubeComparison { verdict: Verdict::Inconclusive, reason: Some(what.clone()), ..comparison }
        }
        _ => comparison,
    })
}

fn scenario_of(trace: &Path) -> Option<String> {
    let parts: Vec<_> = trace.parent()?.components().map(|part| part.as_os_str().to_string_lossy()).collect();
    let below = parts.iter().rposition(|part| part == "traces")? + 1;
    Some(format!("{}.toml", parts.get(below..).filter(|parts| !parts.is_empty())?.join("/")))
}

#[derive(Debug, thiserror::Error)]
pub enum BaselineAcceptError {
    #[error(transparent)]
    Compare(#[from] CompareError),
    #[error(transparent)]
    Learn(#[from] LearnError),
    #[error("the run contains no trial of this scenario; accept another run")]
    NoTrial,
    #[error("the run was cut off; accept a complete run")]
    Incomplete,
    #[error("the controller did not confirm 0 V at the end of the run; accept a run that ended safely")]
    NotSafe,
    #[error("{0}")]
    ExcludedTrial(String),
}

pub fn check_acceptable(record: &RunRecord, trials: &ScenarioTrials) -> Result<(), BaselineAcceptError> {
    if !record.complete {
        return Err(BaselineAcceptError::Incomplete);
    }
    if record.safe_confirmed != Some(true) {
        return Err(BaselineAcceptError::NotSafe);
    }
    match trials.excluded.first() {
        Some(reason) => Err(BaselineAcceptError::ExcludedTrial(reason.clone())),
        None => Ok(()),
    }
}

pub fn build_baseline(
    record: &RunRecord,
    scenario: &ScenarioRecord,
    stored: &ScenarioTrials,
    old: Option<&Baseline>,
    rate: f64,
) -> Result<Baseline, BaselineAcceptError> {
    let trials = stored.trials.iter().map(StoredTrial::rows).collect::<Result<Vec<_>, _>>()?;
    let Some(first) = trials.first() else { return Err(BaselineAcceptError::NoTrial) };
    // Events add rows, so the longest time between two rows is the trace step, in whole ns.
    let gaps = first.iter().zip(first.iter().skip(1)).map(|(left, right)| right.t_s - left.t_s);
    let step_ms = (gaps.fold(0.0, f64::max) * 1e9).round() / 1e6;
    let differ = trials.iter().any(|rows| rows != first);
    let (mut golden, learned) = if differ {
        let learned = LearningParameters { trials: trials.len() as u32, false_alarm_rate: rate };
        (GoldenTubes::learn(&trials, step_ms, rate)?, Some(learned))
    } else {
        (GoldenTubes::from_trial(first, step_ms).ok_or(BaselineAcceptError::NoTrial)?, None)
    };
    // A person may have edited the tolerances of the old baseline, so they are kept.
    for tube in &mut golden.tubes {
        if let Some(kept) = old.and_then(|old| old.golden.tubes.iter().find(|old| old.signal == tube.signal)) {
            tube.tolerance = kept.tolerance;
        }
    }
    Ok(Baseline { scenario: scenario.file.clone(), response: JudgedResponse::of(record, scenario), learned, golden })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_the_scenario_of_a_trace() {
        let of = |path: &str| scenario_of(Path::new(path));
        assert_eq!(of("/runs/x/traces/paper/fig13/000.csv").as_deref(), Some("paper/fig13.toml"));
        assert_eq!(of("traces/s/000.csv").as_deref(), Some("s.toml"));
        assert_eq!(of("elsewhere/000.csv"), None);
        assert_eq!(of("traces/000.csv"), None);
        assert_eq!(of("000.csv"), None);
    }
}
