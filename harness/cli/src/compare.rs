//! `platebench compare`: responses beside others, or beside what was accepted.

use crate::args::{Compare, Format};
use crate::exit::Exit;
use crate::output;
use platebench_report::comparison;
use platebench_runner::RejudgeError;
use platebench_runner::rejudge::rows_of;
use platebench_trace::{Row, TraceError, read};
use platebench_verdict::golden::{Accepted, BaselineError, Comparison, Golden};
use platebench_verdict::record::{FILE, RecordError};
use platebench_verdict::{RunRecord, ScenarioRecord, Verdict};
use serde::Serialize;
use std::fs;
use std::path::{Path, PathBuf};

/// Stands for the baselines of the scenarios.
const BASELINE: &str = "baseline";
/// Where drawings go in a run folder.
const DRAWINGS: &str = "comparison";

/// Why nothing can be compared.
#[derive(Debug, thiserror::Error)]
pub(crate) enum CompareError {
    #[error(transparent)]
    Record(#[from] RecordError),
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error(transparent)]
    Stored(#[from] RejudgeError),
    #[error(transparent)]
    Baseline(#[from] BaselineError),
    #[error("{}: a trace outside a run folder belongs to no scenario, expected --against FILE.toml of a baseline", .0.display())]
    NoScenario(PathBuf),
    #[error("{}: {count} scenarios, expected a run of one scenario to hold a trace against", path.display())]
    Several { path: PathBuf, count: usize },
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
}

/// The trials of a scenario, as they are compared.
pub(crate) struct Played {
    /// The scenario's file, or the trace's.
    pub(crate) name: String,
    pub(crate) trials: Vec<(u32, Vec<Row>)>,
    /// Trials that do not count, and why.
    pub(crate) disturbed: Vec<String>,
}

/// One comparison as it is shown.
#[derive(Serialize)]
struct Shown {
    scenario: String,
    #[serde(flatten)]
    comparison: Comparison,
    /// Where the worst place is drawn.
    drawing: Option<PathBuf>,
}

/// Compares and says what came of it.
pub(crate) fn compare(arguments: &Compare) -> Exit {
    match compared(arguments) {
        Ok(shown) => show(&shown, arguments.format),
        Err(error) => {
            output::error(&error.to_string());
            Exit::Invalid
        }
    }
}

fn show(shown: &[Shown], format: Format) -> Exit {
    match format {
        Format::Human => {
            for one in shown {
                let mut lines = comparison::lines(&one.scenario, &one.comparison);
                lines.extend(one.drawing.iter().map(|path| format!("  drawn in {}", path.display())));
                output::show(&(lines.join("\n") + "\n"));
            }
        }
        Format::Json => match serde_json::to_string_pretty(shown) {
            Ok(text) => output::show(&format!("{text}\n")),
            Err(fault) => output::error(&format!("the comparison cannot be shown as JSON: {fault}")),
        },
    }
    if shown.is_empty() {
        output::error("there is nothing to compare");
        return Exit::Nothing;
    }
    Exit::of_verdict(Verdict::over(shown.iter().map(|one| one.comparison.verdict)))
}

fn compared(arguments: &Compare) -> Result<Vec<Shown>, CompareError> {
    let subject = played(&arguments.subject)?;
    let drawings =
        arguments.draw.clone().or_else(|| is_run(&arguments.subject).then(|| arguments.subject.join(DRAWINGS)));
    note_missing(arguments, &subject)?;
    let mut shown = Vec::new();
    for scenario in subject {
        let reference = reference(arguments, &scenario)?;
        let comparison = match &reference {
            Reference::One(golden) => with_disturbed(golden, &scenario),
            Reference::Trials(others) => trial_by_trial(others, &scenario),
            Reference::Nothing => nothing("there is nothing of this name to compare with"),
        };
        let drawing = match &drawings {
            Some(folder) => draw(&reference, &scenario, &comparison, folder)?,
            None => None,
        };
        shown.push(Shown { scenario: scenario.name, comparison, drawing });
    }
    Ok(shown)
}

/// Says what the other run played and this one did not: less to compare looks just as good.
fn note_missing(arguments: &Compare, subject: &[Played]) -> Result<(), CompareError> {
    let against = Path::new(&arguments.against);
    if arguments.against == BASELINE || !is_run(&arguments.subject) || !is_run(against) {
        return Ok(());
    }
    for other in &RunRecord::read(against)?.scenarios {
        let here = subject.iter().find(|played| played.name == other.file);
        let [trials, others] =
            [here.map_or(0, |played| played.trials.len() + played.disturbed.len()), other.trials.len()];
        if trials < others {
            let (file, against) = (&other.file, against.display());
            output::note(&format!("{file}: {trials} of the {others} trials that {against} has"));
        }
    }
    Ok(())
}

/// What a scenario's trials are held against.
enum Reference {
    /// All of them against the same curves.
    One(Box<Golden>),
    /// Each against the one of its number.
    Trials(Vec<(u32, Vec<Row>)>),
    Nothing,
}

impl Reference {
    /// What the trial of that number is held against.
    fn of(&self, index: u32) -> Option<Golden> {
        match self {
            Self::One(golden) => Some((**golden).clone()),
            Self::Trials(others) => {
                others.iter().find(|(other, _)| *other == index).and_then(|(_, rows)| Golden::of_rows(rows))
            }
            Self::Nothing => None,
        }
    }
}

fn nothing(why: &str) -> Comparison {
    Comparison { verdict: Verdict::Inconclusive, trials: 0, outside: 0, worst: None, reason: Some(why.to_owned()) }
}

/// Each trial against the one of its number in another run: with the same seed they have the same plate and the same noise.
fn trial_by_trial(others: &[(u32, Vec<Row>)], scenario: &Played) -> Comparison {
    let mut all = nothing("there is no trial to compare");
    let mut verdicts = Vec::new();
    let mut reasons = scenario.disturbed.clone();
    for (index, rows) in &scenario.trials {
        let other = others.iter().find(|(other, _)| other == index).and_then(|(_, rows)| Golden::of_rows(rows));
        let Some(golden) = other else {
            reasons.push(format!("trial {index} has none of its number to be held against"));
            continue;
        };
        let one = golden.compare([(*index, rows.as_slice())]);
        verdicts.push(one.verdict);
        all.trials += 1;
        all.outside += one.outside;
        if let Some((_, found)) = &one.worst
            && all.worst.as_ref().is_none_or(|(_, worst)| found.severity() > worst.severity())
        {
            all.worst = one.worst;
        } else if one.verdict == Verdict::Inconclusive {
            reasons.extend(one.reason);
        }
    }
    if !reasons.is_empty() {
        verdicts.push(Verdict::Inconclusive);
    }
    all.verdict = Verdict::over(verdicts);
    let (outside, trials) = (all.outside, all.trials);
    all.reason = match all.verdict {
        Verdict::Pass => None,
        Verdict::Fail => Some(format!("{outside} of {trials} trials lie outside")),
        Verdict::Inconclusive => reasons.into_iter().next().or(all.reason),
    };
    all
}

/// A pass with trials that do not count is none.
pub(crate) fn with_disturbed(golden: &Golden, scenario: &Played) -> Comparison {
    let comparison = golden.compare(scenario.trials.iter().map(|(index, rows)| (*index, rows.as_slice())));
    match scenario.disturbed.first() {
        Some(what) if comparison.verdict == Verdict::Pass => {
            Comparison { verdict: Verdict::Inconclusive, reason: Some(what.clone()), ..comparison }
        }
        _ => comparison,
    }
}

fn draw(
    reference: &Reference,
    scenario: &Played,
    comparison: &Comparison,
    folder: &Path,
) -> Result<Option<PathBuf>, CompareError> {
    let Some((trial, worst)) = &comparison.worst else { return Ok(None) };
    let golden = reference.of(*trial);
    let tube = golden.as_ref().and_then(|golden| golden.tubes.iter().find(|tube| tube.signal == worst.signal));
    let rows = scenario.trials.iter().find(|(index, _)| index == trial).map(|(_, rows)| rows);
    let Some((tube, rows)) = tube.zip(rows) else { return Ok(None) };
    let svg = match comparison::drawing(tube, rows, *trial, worst) {
        Ok(svg) => svg,
        Err(error) => {
            output::error(&error.to_string());
            return Ok(None);
        }
    };
    // A trace may be called by a path that leads anywhere: only its name counts here.
    let name = if Path::new(&scenario.name).is_absolute() || scenario.name.contains("..") {
        Path::new(&scenario.name).file_name().map(PathBuf::from).unwrap_or_default()
    } else {
        PathBuf::from(&scenario.name)
    };
    let path = folder.join(name).with_extension("svg");
    let written = path.parent().map_or(Ok(()), fs::create_dir_all).and_then(|()| fs::write(&path, svg));
    written.map_err(|source| CompareError::Io { path: path.clone(), source })?;
    Ok(Some(path))
}

/// What a scenario's trials are held against, by the command line.
fn reference(arguments: &Compare, scenario: &Played) -> Result<Reference, CompareError> {
    let one = |golden: Option<Golden>| golden.map_or(Reference::Nothing, |golden| Reference::One(Box::new(golden)));
    let against = Path::new(&arguments.against);
    if arguments.against == BASELINE {
        let named =
            if is_run(&arguments.subject) { Some(scenario.name.clone()) } else { scenario_of(&arguments.subject) };
        let Some(name) = named else { return Err(CompareError::NoScenario(arguments.subject.clone())) };
        return Ok(one(Accepted::read(&arguments.baselines, &name)?.map(|accepted| accepted.golden)));
    }
    if against.extension().is_some_and(|extension| extension == "toml") {
        return Ok(one(Some(Accepted::read_files(against, &against.with_extension("csv"))?.golden)));
    }
    if !is_run(against) {
        return Ok(one(Golden::of_rows(&read(against)?)));
    }
    let mut others = played(against)?;
    if is_run(&arguments.subject) {
        let other = others.into_iter().find(|other| other.name == scenario.name);
        return Ok(other.map_or(Reference::Nothing, |other| Reference::Trials(other.trials)));
    }
    match (others.pop(), others.len()) {
        (Some(only), 0) => Ok(one(only.trials.first().and_then(|(_, rows)| Golden::of_rows(rows)))),
        (_, further) => Err(CompareError::Several { path: against.to_owned(), count: further + 1 }),
    }
}

pub(crate) fn is_run(path: &Path) -> bool {
    path.join(FILE).exists() || path.is_dir()
}

/// The scenario that a trace in a run folder belongs to: its path below `traces`.
fn scenario_of(trace: &Path) -> Option<String> {
    let parts: Vec<_> = trace.parent()?.components().map(|part| part.as_os_str().to_string_lossy()).collect();
    let below = parts.iter().rposition(|part| part == "traces")? + 1;
    Some(format!("{}.toml", parts.get(below..).filter(|parts| !parts.is_empty())?.join("/")))
}

/// Everything that was played in a run, or one trace.
pub(crate) fn played(path: &Path) -> Result<Vec<Played>, CompareError> {
    if !is_run(path) {
        let trials = vec![(0, read(path)?)];
        return Ok(vec![Played { name: path.display().to_string(), trials, disturbed: Vec::new() }]);
    }
    RunRecord::read(path)?.scenarios.iter().map(|scenario| trials_of(path, scenario)).collect()
}

/// The trials of a scenario with their rows.
pub(crate) fn trials_of(folder: &Path, scenario: &ScenarioRecord) -> Result<Played, CompareError> {
    let mut played = Played { name: scenario.file.clone(), trials: Vec::new(), disturbed: Vec::new() };
    for trial in &scenario.trials {
        if let Some(cause) = trial.cause {
            let what = trial.reason.as_deref().unwrap_or("it was disturbed");
            played.disturbed.push(format!("trial {} does not count ({cause}): {what}", trial.index));
        } else {
            played.trials.push((trial.index, rows_of(folder, trial)?));
        }
    }
    Ok(played)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trace_in_a_run_folder_knows_its_scenario() {
        let of = |path: &str| scenario_of(Path::new(path));
        assert_eq!(of("/runs/x/traces/paper/fig13/000.csv").as_deref(), Some("paper/fig13.toml"));
        assert_eq!(of("traces/s/000.csv").as_deref(), Some("s.toml"));
        assert_eq!(of("elsewhere/000.csv"), None);
        assert_eq!(of("traces/000.csv"), None);
        assert_eq!(of("000.csv"), None);
    }
}
