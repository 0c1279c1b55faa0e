//! Judges a stored run again, without a rig.

use crate::delay_boundary::measure_trial;
use crate::run_recorder::empty_record;
use crate::trial::law;
use platebench_model::record::{
    Exclusion, FolderError, KeepTraces, Overrides, RECORD_FILE, RecordError, RunRecord, ScenarioRecord, TrialRecord,
    sha256, sha256_of_file,
};
use platebench_model::scenario::{Diagnostic, MAX_TRIALS, OWN_LAW, Scenario, Variation, load, load_copies};
use platebench_model::trace::{AtPath, Row, TraceError, read_trace};
use platebench_plate::Model;
use platebench_verdict::{
    Judgement, SequentialDecision, TrialMeasures, judge_at_time_limit, judge_sequentially, trial_record,
};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

#[derive(Debug, thiserror::Error)]
pub enum RejudgeError {
    #[error(transparent)]
    Record(#[from] RecordError),
    #[error("{0}")]
    Scenario(Box<Diagnostic>),
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error(transparent)]
    Folder(#[from] FolderError),
    #[error("{}: {what} differs from the scenario that was played; only expectations may differ", path.display())]
    DifferentExperiment { path: PathBuf, what: &'static str },
    #[error("{}: SHA-256 {found}, expected {expected}: changed after the run; restore the file", path.display())]
    Modified { path: PathBuf, found: String, expected: String },
    #[error(
        "{}: the amplitude at {t_s} s is {amplitude_um} µm, its components give {expected_um} µm; \
         the trace was changed",
        path.display()
    )]
    Contradiction {
        path: PathBuf,
        t_s: f64,
        amplitude_um: f64,
        /// Value of √(Wd² + Wq²), µm.
        expected_um: f64,
    },
    #[error("{}: run.json has one trace for the trials {first} and {second}, expected one per trial", path.display())]
    SameTrace { path: PathBuf, first: u32, second: u32 },
    #[error("{}: the run did not keep all traces, so it cannot be judged; run with --keep-traces all", .0.display())]
    NotKept(PathBuf),
    #[error("{}: no scenario of the run has this file name, expected one of {known}", path.display())]
    NoSuchScenario { path: PathBuf, known: String },
}

impl From<Diagnostic> for RejudgeError {
    fn from(diagnostic: Diagnostic) -> Self {
        Self::Scenario(Box::new(diagnostic))
    }
}

/// The file `expectations` replaces the expectations of the scenario with the same file name.
/// Judges trials with a record only, by their telemetry and their traces. A trial without a record
/// or without its trace makes its scenario inconclusive.
pub fn rejudge(folder: &Path, expectations: Option<&Path>) -> Result<RunRecord, RejudgeError> {
    rejudge_with_rows(folder, expectations, &mut |_, _| {})
}

/// As [`rejudge`]. `on_rows` receives each judged trace, so that it need not be read again.
pub fn rejudge_with_rows(
    folder: &Path,
    expectations: Option<&Path>,
    on_rows: &mut dyn FnMut(&str, Vec<Row>),
) -> Result<RunRecord, RejudgeError> {
    let mut record = RunRecord::read(folder)?;
    if record.overrides.keep_traces != KeepTraces::All {
        return Err(RejudgeError::NotKept(folder.to_owned()));
    }
    let replaced =
        expectations.map(|path| Ok::<_, RejudgeError>((path, matching_scenario(&record, path)?))).transpose()?;
    let mut scenarios = Vec::with_capacity(record.scenarios.len());
    for (number, stored) in record.scenarios.iter().enumerate() {
        // Each part of a joined run may have its own overrides.
        let own = record.merge.as_ref().and_then(|merge| merge.run_of(&stored.file));
        let overrides = own.map_or(&record.overrides, |run| &run.overrides);
        let mut scenario = load_stored_scenario(folder, stored)?;
        // Uses the model of the run, because this version of the bench might select another one.
        let model = Model::from_name(&stored.model).unwrap_or(scenario.model);
        if let Some((path, _)) = replaced.filter(|(_, chosen)| *chosen == number) {
            let other = replacement(path, &scenario, model, overrides)?;
            scenario.expectations = other.expectations;
            for (scene, other) in scenario.other_trials.iter_mut().zip(other.other_trials) {
                scene.expectations = other.expectations;
            }
        }
        apply_overrides(overrides, &mut scenario);
        if stored.law == OWN_LAW {
            scenario.set_law(OWN_LAW);
        }
        scenario.model = model;
        scenarios.push(rejudge_scenario(folder, &scenario, stored, record.complete, on_rows)?);
    }
    record.scenarios = scenarios;
    record.update_verdict();
    Ok(record)
}

pub fn apply_overrides(overrides: &Overrides, scenario: &mut Scenario) {
    if let Some(law) = &overrides.law {
        scenario.set_law(law);
    }
    if let Some(trials) = overrides.trials.filter(|trials| (1..=MAX_TRIALS).contains(trials)) {
        scenario.trials.count = trials;
        scenario.trials.max_count = trials;
    }
    if let Some(seed) = overrides.seed {
        scenario.trials.seed = seed;
        let others = scenario.between.iter_mut().chain(scenario.other_trials.as_deref_mut());
        others.for_each(|scene| scene.trials.seed = seed);
    }
    if let Some(seconds) = overrides.timeout_s {
        scenario.timeout_s = Some(seconds);
    }
    if let Some(model) = &overrides.model {
        let select = |scene: &mut Scenario| {
            scene.model = Scenario::model_for(model, &scene.plate).unwrap_or(scene.model);
        };
        select(scenario);
        scenario.other_trials.as_deref_mut().map(select);
    }
}

/// Fails if the overrides select a model that omits an effect of a scenario's plate.
pub fn check_overrides(overrides: &Overrides, scenarios: &[Scenario]) -> Result<(), Box<Diagnostic>> {
    let Some(model) = &overrides.model else { return Ok(()) };
    for scenario in scenarios.iter().flat_map(|scenario| [Some(scenario), scenario.other_trials.as_deref()]).flatten() {
        let model = Scenario::model_for(model, &scenario.plate);
        if let Some(message) = model.and_then(|model| Scenario::omitted_effect(model, &scenario.plate)) {
            return Err(Box::new(scenario.diagnostic("plate", message)));
        }
    }
    Ok(())
}

/// Index of the only scenario of the run, or of the scenario with the file name of `path`.
fn matching_scenario(record: &RunRecord, path: &Path) -> Result<usize, RejudgeError> {
    let file_name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let same_name = |scenario: &ScenarioRecord| scenario.file.rsplit('/').next() == Some(&*file_name);
    match &record.scenarios[..] {
        [_] => Ok(0),
        several => several.iter().position(same_name).ok_or_else(|| RejudgeError::NoSuchScenario {
            path: path.to_owned(),
            known: several.iter().map(|scenario| scenario.file.as_str()).collect::<Vec<_>>().join(", "),
        }),
    }
}

/// Loads the scenario at `path`. Except for its expectations, it must equal the played scenario.
fn replacement(path: &Path, played: &Scenario, model: Model, overrides: &Overrides) -> Result<Scenario, RejudgeError> {
    let other = load(path, &played.file)?;
    let scene = |scene: &Scenario| {
        let Scenario { duration, plate, controller, setpoint, conditions, .. } = scene.clone();
        (duration, plate, controller, setpoint, conditions)
    };
    let same_model = overrides.model.is_some() || other.model == model;
    let alike = [
        (other.duration == played.duration, "duration_ms"),
        (other.trace_step == played.trace_step, "trace_step_ms"),
        (other.plate == played.plate, "the plate"),
        (same_model, "model"),
        (other.controller == played.controller, "[controller]"),
        (other.setpoint == played.setpoint && other.conditions == played.conditions, "[profile]"),
        (other.trials == played.trials, "[trials]"),
        (other.faults == played.faults && other.chip_faults == played.chip_faults, "[[fault]]"),
        (other.between.iter().map(scene).eq(played.between.iter().map(scene)), "[[between]]"),
        (other.other_trials.as_deref().map(scene) == played.other_trials.as_deref().map(scene), "[other_trials]"),
    ];
    match alike.iter().find(|(holds, _)| !holds) {
        Some((_, what)) => Err(RejudgeError::DifferentExperiment { path: path.to_owned(), what }),
        None => Ok(other),
    }
}

pub(crate) fn load_stored_scenario(folder: &Path, stored: &ScenarioRecord) -> Result<Scenario, RejudgeError> {
    let incomplete = |what: &str| {
        let message = format!("the record of {} {what}", stored.file);
        RejudgeError::from(Diagnostic::for_file(&folder.join(RECORD_FILE), message))
    };
    if stored.inputs.is_empty() {
        return Err(incomplete("names no inputs"));
    }
    let copies: Vec<_> = stored.inputs.iter().map(|input| folder.join(&input.file)).collect();
    let mut scenario = load_copies(&copies, &stored.file)?;
    if scenario.inputs.len() != stored.inputs.len() {
        return Err(incomplete("names fewer inputs than the run was made with"));
    }
    for ((now, then), copy) in scenario.inputs.iter().zip(&stored.inputs).zip(&copies) {
        check_hash(copy, sha256(&now.bytes), &then.sha256)?;
    }
    scenario.requirement_texts.clone_from(&stored.requirement_texts);
    Ok(scenario)
}

fn check_hash(path: &Path, found: String, expected: &str) -> Result<(), RejudgeError> {
    if found == expected {
        return Ok(());
    }
    Err(RejudgeError::Modified { path: path.to_owned(), found, expected: expected.to_owned() })
}

pub fn read_trial_rows(folder: &Path, trial: &TrialRecord) -> Result<Vec<Row>, RejudgeError> {
    check_trace(folder, trial)?;
    Ok(read_trace(&folder.join(&trial.trace))?)
}

/// Fails if the SHA-256 of the trace differs from the record. Accepts a trial without a hash.
pub fn check_trace(folder: &Path, trial: &TrialRecord) -> Result<(), RejudgeError> {
    let Some(expected) = trial.sha256.as_deref() else { return Ok(()) };
    let path = folder.join(&trial.trace);
    let found = sha256_of_file(&path).at(&path).map_err(FolderError::from)?;
    check_hash(&path, found, expected)
}

/// Judges at the same interim looks as the run, and stops at the look that decides.
fn rejudge_scenario(
    folder: &Path,
    scenario: &Scenario,
    stored: &ScenarioRecord,
    complete: bool,
    on_rows: &mut dyn FnMut(&str, Vec<Row>),
) -> Result<ScenarioRecord, RejudgeError> {
    check_distinct_traces(folder, scenario, stored)?;
    let is_judged = complete || stored.time_limit_s.is_some();
    let mut measures: Vec<TrialMeasures> = Vec::new();
    let mut records = Vec::new();
    while let SequentialDecision::Continue { trials } = judge_sequentially(scenario, &measures) {
        let mut ends_early = false;
        for index in measures.len() as u32..trials {
            match stored.trials.iter().find(|trial| trial.index == index) {
                Some(then) => {
                    let (trial, record) = rejudge_trial(folder, scenario, then, on_rows)?;
                    measures.push(trial);
                    records.extend(record);
                }
                // A judged scenario lacks this trial only if `--fail-fast` or its time limit ended it.
                None if is_judged => ends_early = true,
                None => measures.push(excluded_trial(scenario, index, Exclusion::CutOff)),
            }
        }
        if ends_early {
            break;
        }
    }
    let judgement = judge_at_time_limit(scenario, &measures, stored.time_limit_s);
    let Judgement { verdict, expectations } = judgement.with_bench_errors(scenario);
    let (trials, time_limit_s) = (records, stored.time_limit_s);
    let record = empty_record(scenario, stored.inputs.clone());
    Ok(ScenarioRecord { verdict, expectations, trials, time_limit_s, ..record })
}

/// Fails if trials have the same file, or equal traces although the scenario is random.
fn check_distinct_traces(folder: &Path, scenario: &Scenario, stored: &ScenarioRecord) -> Result<(), RejudgeError> {
    let mut known: BTreeMap<&str, u32> = BTreeMap::new();
    for trial in &stored.trials {
        let hash = trial.sha256.as_deref().filter(|_| !scenario.is_deterministic());
        for key in [Some(trial.trace.as_str()), hash].into_iter().flatten() {
            if let Some(first) = known.insert(key, trial.index) {
                let path = folder.join(&trial.trace);
                return Err(RejudgeError::SameTrace { path, first, second: trial.index });
            }
        }
    }
    Ok(())
}

fn check_amplitude(path: &Path, rows: &[Row]) -> Result<(), RejudgeError> {
    // Only rounding may differ, because the bench computes the amplitude from the components.
    const RELATIVE_ERROR: f64 = 1e-9;
    const ABSOLUTE_ERROR_UM: f64 = 1e-12;
    let expected = |row: &Row| row.wd_um.hypot(row.wq_um);
    let is_wrong =
        |row: &&Row| (row.amplitude_um - expected(row)).abs() > RELATIVE_ERROR * expected(row) + ABSOLUTE_ERROR_UM;
    rows.iter().find(is_wrong).map_or(Ok(()), |row| {
        Err(RejudgeError::Contradiction {
            path: path.to_owned(),
            t_s: row.t_s,
            amplitude_um: row.amplitude_um,
            expected_um: expected(row),
        })
    })
}

/// Returns no record if the trial has no valid one.
fn rejudge_trial(
    folder: &Path,
    scenario: &Scenario,
    then: &TrialRecord,
    on_rows: &mut dyn FnMut(&str, Vec<Row>),
) -> Result<(TrialMeasures, Option<TrialRecord>), RejudgeError> {
    // A trial of 0.3 without a hash was cut off before its telemetry was recorded.
    if then.sha256.is_none() {
        return Ok((excluded_trial(scenario, then.index, Exclusion::CutOff), None));
    }
    let path = folder.join(&then.trace);
    if !path.exists() {
        return Ok((excluded_trial(scenario, then.index, Exclusion::MissingTrace), None));
    }
    let rows = read_trial_rows(folder, then)?;
    check_amplitude(&path, &rows)?;
    let measures = measure_trial(scenario, law(scenario)?, then.index, &rows, &then.telemetry);
    on_rows(&then.trace, rows);
    let record = trial_record(scenario, &measures, then.telemetry.clone(), then.trace.clone(), then.wall_ms);
    Ok((measures, Some(TrialRecord { sha256: then.sha256.clone(), ..record })))
}

fn excluded_trial(scenario: &Scenario, index: u32, exclusion: Exclusion) -> TrialMeasures {
    TrialMeasures {
        index,
        seed: Variation::of_trial(scenario, index).seed,
        exclusion: Some(exclusion),
        ..TrialMeasures::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejects_an_amplitude_that_contradicts_its_components() {
        let row = Row { wd_um: 0.3, wq_um: -0.4, amplitude_um: 0.5, ..Row::default() };
        assert!(check_amplitude(Path::new("a.csv"), &[row]).is_ok());
        let wrong = Row { amplitude_um: 2.0, ..row };
        let error = check_amplitude(Path::new("a.csv"), &[row, wrong]).unwrap_err();
        assert!(matches!(error, RejudgeError::Contradiction { amplitude_um: 2.0, .. }), "{error}");
    }
}
