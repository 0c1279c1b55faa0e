//! A stored run, judged again without a rig.

use crate::configure;
use crate::folder::{FolderError, sha256, sha256_of, trace_file};
use crate::measured::measured;
use crate::run::empty_record;
use crate::worker::Done;
use platebench_plate::Tier;
use platebench_scenario::{Diagnostic, Expectation, Scenario, load, load_copies};
use platebench_trace::{Row, TraceError, read};
use platebench_verdict::judge::trial_record;
use platebench_verdict::record::{Cause, Overrides, RecordError};
use platebench_verdict::{
    Decision, RunRecord, ScenarioRecord, Telemetry, TrialMeasures, TrialRecord, judge, sequential,
};
use std::path::{Path, PathBuf};

/// As many as the command line takes.
const MOST_TRIALS: u32 = 100_000;

/// Why a stored run cannot be judged.
#[derive(Debug, thiserror::Error)]
pub enum RejudgeError {
    /// There is no record that could be read.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// A scenario, stored or given, is not one.
    #[error("{0}")]
    Scenario(Box<Diagnostic>),
    /// A trace is not one.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// A file is not there.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The given scenario describes another experiment than the one that was played.
    #[error("{}: {what} differs from what was played; only expectations can be held against stored traces", path.display())]
    OtherExperiment {
        /// The file.
        path: PathBuf,
        /// What differs.
        what: &'static str,
    },
    /// An input or a trace is no longer what it was.
    #[error("{}: SHA-256 {found}, expected {expected}: not the file that the run was made with", path.display())]
    Changed {
        /// The file.
        path: PathBuf,
        /// What it is.
        found: String,
        /// What the record says.
        expected: String,
    },
    /// The given scenario belongs to none of the run's.
    #[error("{}: none of the run's scenarios has this name ({known})", path.display())]
    NoSuchScenario {
        /// The file.
        path: PathBuf,
        /// The names that there are.
        known: String,
    },
}

impl From<Diagnostic> for RejudgeError {
    fn from(diagnostic: Diagnostic) -> Self {
        Self::Scenario(Box::new(diagnostic))
    }
}

/// Judges the traces in `folder` again, with the scenarios that are stored beside them; for the one of that name with the
/// expectations of `replacement`.
///
/// Trials whose trace is not there were cut off; they leave what they should have decided undecided.
///
/// # Errors
/// [`RejudgeError`].
pub fn rejudge(folder: &Path, replacement: Option<&Path>) -> Result<RunRecord, RejudgeError> {
    let mut record = RunRecord::read(folder)?;
    let replaced = replacement.map(|path| Ok::<_, RejudgeError>((path, chosen(&record, path)?))).transpose()?;
    let mut scenarios = Vec::with_capacity(record.scenarios.len());
    for (number, stored) in record.scenarios.iter().enumerate() {
        let mut scenario = stored_scenario(folder, stored)?;
        // Whatever would be chosen today, that plate was played.
        let tier = Tier::from_name(&stored.model).unwrap_or(scenario.tier);
        if let Some((path, _)) = replaced.filter(|(_, chosen)| *chosen == number) {
            scenario.expectations = other_expectations(path, &scenario, tier, &record.overrides)?;
        }
        apply(&record.overrides, &mut scenario);
        scenario.tier = tier;
        scenarios.push(judged(folder, &scenario, stored, record.complete)?);
    }
    record.scenarios = scenarios;
    record.decide();
    Ok(record)
}

/// Changes a scenario as the run's command line asked for.
pub fn apply(overrides: &Overrides, scenario: &mut Scenario) {
    if let Some(law) = &overrides.law {
        scenario.controller.law.clone_from(law);
    }
    if let Some(trials) = overrides.trials.filter(|trials| (1..=MOST_TRIALS).contains(trials)) {
        scenario.trials.count = trials;
        scenario.trials.max_count = trials;
    }
    if let Some(seed) = overrides.seed {
        scenario.trials.seed = seed;
    }
    if let Some(model) = &overrides.model {
        scenario.model.asked = Tier::from_name(model);
    }
    scenario.choose_model(true);
}

/// Which of the run's scenarios `path` stands for: the only one, or the one with the same file name.
fn chosen(record: &RunRecord, path: &Path) -> Result<usize, RejudgeError> {
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

/// The expectations of the scenario at `path`, which must otherwise describe what was played.
fn other_expectations(
    path: &Path,
    played: &Scenario,
    tier: Tier,
    overrides: &Overrides,
) -> Result<Vec<Expectation>, RejudgeError> {
    let other = load(path, &played.file)?;
    let named = other.model.asked.is_none_or(|asked| overrides.model.is_some() || asked == tier);
    // What is expected now may need a more exact plate than what was expected then; whoever names one knows what he wants.
    let mut chosen = other.clone();
    apply(overrides, &mut chosen);
    let good_enough = chosen.model.asked.is_some() || chosen.tier <= tier;
    let alike = [
        (other.duration == played.duration, "duration_ms"),
        (other.trace_step == played.trace_step, "trace_step_ms"),
        (other.plate == played.plate, "the plate"),
        (named, "model"),
        (good_enough, "the model that the expectations need"),
        (other.controller == played.controller, "[controller]"),
        (other.setpoint == played.setpoint && other.scene == played.scene, "[profile]"),
        (other.trials == played.trials, "[trials]"),
        (other.faults == played.faults, "[[fault]]"),
    ];
    match alike.iter().find(|(holds, _)| !holds) {
        Some((_, what)) => Err(RejudgeError::OtherExperiment { path: path.to_owned(), what }),
        None => Ok(other.expectations),
    }
}

fn stored_scenario(folder: &Path, stored: &ScenarioRecord) -> Result<Scenario, RejudgeError> {
    if stored.inputs.is_empty() {
        let message = format!("the record of {} names no inputs", stored.file);
        return Err(Diagnostic::of_file(&folder.join(platebench_verdict::record::FILE), message).into());
    }
    let copies: Vec<_> = stored.inputs.iter().map(|input| folder.join(&input.file)).collect();
    let scenario = load_copies(&copies, &stored.file)?;
    if scenario.inputs.len() != stored.inputs.len() {
        let message = format!("the record of {} does not name all inputs", stored.file);
        return Err(Diagnostic::of_file(&folder.join(platebench_verdict::record::FILE), message).into());
    }
    for ((now, then), copy) in scenario.inputs.iter().zip(&stored.inputs).zip(&copies) {
        unchanged(copy, &now.bytes, &then.sha256)?;
    }
    Ok(scenario)
}

/// Refuses a file whose content is not what the record says.
fn unchanged(path: &Path, bytes: &[u8], expected: &str) -> Result<(), RejudgeError> {
    same(path, sha256(bytes), expected)
}

fn same(path: &Path, found: String, expected: &str) -> Result<(), RejudgeError> {
    if found == expected {
        return Ok(());
    }
    Err(RejudgeError::Changed { path: path.to_owned(), found, expected: expected.to_owned() })
}

/// The rows of a trial of the run in `folder`, where its trace is still the one that was recorded.
///
/// # Errors
/// [`RejudgeError`] where it is another, or none.
pub fn rows_of(folder: &Path, trial: &TrialRecord) -> Result<Vec<Row>, RejudgeError> {
    trace_unchanged(folder, trial)?;
    Ok(read(&folder.join(&trial.trace))?)
}

/// Refuses a trial of the run in `folder` whose trace is no longer the one that was recorded.
///
/// # Errors
/// [`RejudgeError::Changed`] where it is another, [`RejudgeError::Folder`] where there is none. A trial without a hash was cut off; nothing is known of its trace.
pub fn trace_unchanged(folder: &Path, trial: &TrialRecord) -> Result<(), RejudgeError> {
    let Some(expected) = trial.sha256.as_deref() else { return Ok(()) };
    let path = folder.join(&trial.trace);
    let found = sha256_of(&path).map_err(|source| FolderError::Io { path: path.clone(), source })?;
    same(&path, found, expected)
}

/// Judges the trials up to the look that decides; the same one as live, since the trials are the same.
fn judged(
    folder: &Path,
    scenario: &Scenario,
    stored: &ScenarioRecord,
    complete: bool,
) -> Result<ScenarioRecord, RejudgeError> {
    let mut measures: Vec<TrialMeasures> = Vec::new();
    let mut records = Vec::new();
    while let Decision::Go { trials } = sequential(scenario, &measures) {
        let played = measures.len();
        for index in measures.len() as u32..trials {
            match judged_trial(folder, scenario, stored, index)? {
                Some(done) => {
                    measures.push(done.measures);
                    records.push(done.record);
                }
                None => measures.push(cut_off(scenario, index)),
            }
        }
        // A run that was not cut off has all the trials that it was meant to have; other expectations may ask for more.
        if complete && records.len() == played {
            measures.truncate(played);
            break;
        }
    }
    let mut record = empty_record(scenario, stored.inputs.clone());
    record.model_choice.clone_from(&stored.model_choice);
    let judgement = judge(scenario, &measures);
    record.verdict = judgement.verdict;
    record.expectations = judgement.expectations;
    record.trials = records;
    Ok(record)
}

/// The stored trial with number `index`, judged by itself; `None` where its trace is not there.
fn judged_trial(
    folder: &Path,
    scenario: &Scenario,
    stored: &ScenarioRecord,
    index: u32,
) -> Result<Option<Done>, RejudgeError> {
    let trace = trace_file(scenario.name(), index);
    let path = folder.join(&trace);
    if !path.exists() {
        return Ok(None);
    }
    let then = stored.trials.iter().find(|then| then.index == index);
    let rows = match then {
        Some(then) => rows_of(folder, then)?,
        None => read(&path)?,
    };
    let telemetry = then.map(|then| then.telemetry.clone()).unwrap_or_default();
    let law = configure::law(scenario)?;
    let measures = measured(scenario, law, index, &rows, &telemetry);
    let mut record = trial_record(scenario, &measures, trace, None);
    if let Some(then) = then {
        record.sha256.clone_from(&then.sha256);
        record.wall_ms = then.wall_ms;
    }
    Ok(Some(Done { measures, record }))
}

/// What is known of a trial that was never played to its end.
fn cut_off(scenario: &Scenario, index: u32) -> TrialMeasures {
    TrialMeasures {
        index,
        seed: scenario.variation(index).seed,
        measures: Vec::new(),
        excuses: Vec::new(),
        telemetry: Telemetry::default(),
        diverged: None,
        cause: Some((Cause::Bench, "the run was cut off before this trial was whole".to_owned())),
        sensed: false,
    }
}
