//! `platebench compare`: compares responses with other responses or with baselines.

mod trials;

pub(crate) use trials::{CompareError, ScenarioTrials, StoredTrial, read_scenario_trials};

use crate::exit::Exit;
use crate::options::{BASELINES, OutputFormat};
use crate::stdio;
use clap::Args;
use platebench_record::{RunRecord, Verdict};
use platebench_report::comparison;
use platebench_trace::read_trace;
use platebench_verdict::golden::{Baseline, GoldenTubes, TubeComparison};
use serde::Serialize;
use std::fs;
use std::path::{Path, PathBuf};
use trials::{is_run_folder, read_trials};

/// `platebench compare`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench compare runs/tonight --against baseline
  platebench compare runs/tonight --against runs/yesterday
  platebench compare board.csv --against scenarios/baselines/paper/fig13-closed-loop.toml

Exit codes: 0 all inside, 1 something outside, 3 no reference or not comparable to the end")]
pub(crate) struct CompareArgs {
    /// A trace or a run folder
    #[arg(value_name = "TRACE|RUN")]
    subject: PathBuf,
    /// The reference: a trace, a run folder, the .toml file of a baseline, or `baseline` for the scenarios' own
    #[arg(long, value_name = "TRACE|RUN|baseline")]
    against: String,
    /// Folder of the baselines
    #[arg(long, value_name = "FOLDER", default_value = BASELINES)]
    baselines: PathBuf,
    /// Folder for a drawing of each scenario's largest deviation; default for a run: RUN/comparison
    #[arg(long, value_name = "FOLDER")]
    draw: Option<PathBuf>,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
}

/// Means the baselines of the scenarios.
const BASELINE_KEYWORD: &str = "baseline";
/// The folder of drawings in a run folder.
const DRAWINGS_FOLDER: &str = "comparison";

/// A comparison in the output.
#[derive(Serialize)]
struct ComparisonOutput {
    scenario: String,
    #[serde(flatten)]
    comparison: TubeComparison,
    /// The drawing of the largest deviation.
    drawing: Option<PathBuf>,
}

/// Compares and prints the result.
pub(crate) fn compare(arguments: &CompareArgs) -> Exit {
    match compare_all(arguments) {
        Ok(comparisons) => print_comparisons(&comparisons, arguments.format),
        Err(error) => stdio::reject(&error),
    }
}

fn print_comparisons(comparisons: &[ComparisonOutput], format: OutputFormat) -> Exit {
    match format {
        OutputFormat::Human => {
            for one in comparisons {
                let mut lines = comparison::lines(&one.scenario, &one.comparison);
                lines.extend(one.drawing.iter().map(|path| format!("  drawing: {}", path.display())));
                stdio::show(&(lines.join("\n") + "\n"));
            }
        }
        OutputFormat::Json => stdio::show_json(&comparisons),
    }
    if comparisons.is_empty() {
        stdio::error("there is nothing to compare");
        return Exit::NothingToRun;
    }
    Exit::of_verdict(Verdict::combine(comparisons.iter().map(|one| one.comparison.verdict)))
}

fn compare_all(arguments: &CompareArgs) -> Result<Vec<ComparisonOutput>, CompareError> {
    let subject = read_trials(&arguments.subject)?;
    let drawings = arguments
        .draw
        .clone()
        .or_else(|| is_run_folder(&arguments.subject).then(|| arguments.subject.join(DRAWINGS_FOLDER)));
    note_missing(arguments, &subject)?;
    let mut comparisons = Vec::new();
    for scenario in subject {
        let reference = find_reference(arguments, &scenario)?;
        let comparison = match &reference {
            Reference::SameTubes(golden) => compare_with_tubes(golden, &scenario)?,
            Reference::PerTrial(others) => compare_trial_by_trial(others, &scenario)?,
            Reference::Nothing => empty_comparison("no reference of this name"),
        };
        let drawing = match &drawings {
            Some(folder) => draw_worst(&reference, &scenario, &comparison, folder)?,
            None => None,
        };
        comparisons.push(ComparisonOutput { scenario: scenario.name, comparison, drawing });
    }
    Ok(comparisons)
}

/// Lists scenarios of the reference with fewer trials in the subject: a smaller comparison passes as easily.
fn note_missing(arguments: &CompareArgs, subject: &[ScenarioTrials]) -> Result<(), CompareError> {
    let against = Path::new(&arguments.against);
    if arguments.against == BASELINE_KEYWORD || !is_run_folder(&arguments.subject) || !is_run_folder(against) {
        return Ok(());
    }
    for other in &RunRecord::read(against)?.scenarios {
        let own = subject.iter().find(|own| own.name == other.file);
        let [trials, others] = [own.map_or(0, |own| own.trials.len() + own.excluded.len()), other.trials.len()];
        if trials < others {
            let (file, against) = (&other.file, against.display());
            stdio::note(&format!("{file}: {trials} of the {others} trials that {against} has"));
        }
    }
    Ok(())
}

/// What the trials of a scenario are compared with.
enum Reference {
    /// All trials with the same tubes.
    SameTubes(Box<GoldenTubes>),
    /// Each trial with the trial of the same index.
    PerTrial(Vec<StoredTrial>),
    Nothing,
}

impl Reference {
    /// The tubes for the trial `index`.
    fn tubes_for(&self, index: u32) -> Result<Option<GoldenTubes>, CompareError> {
        match self {
            Self::SameTubes(golden) => Ok(Some((**golden).clone())),
            Self::PerTrial(others) => tubes_of_trial(others, index),
            Self::Nothing => Ok(None),
        }
    }
}

/// The tubes of the trial `index` in `trials`.
fn tubes_of_trial(trials: &[StoredTrial], index: u32) -> Result<Option<GoldenTubes>, CompareError> {
    let trial = trials.iter().find(|trial| trial.index == index);
    Ok(trial.map(StoredTrial::rows).transpose()?.and_then(|rows| GoldenTubes::from_rows(&rows)))
}

fn empty_comparison(why: &str) -> TubeComparison {
    TubeComparison { verdict: Verdict::Inconclusive, trials: 0, outside: 0, worst: None, reason: Some(why.to_owned()) }
}

/// Compares each trial with the trial of the same index: with the same seed, plate and noise are the same.
fn compare_trial_by_trial(others: &[StoredTrial], scenario: &ScenarioTrials) -> Result<TubeComparison, CompareError> {
    let mut all = empty_comparison("no trial to compare");
    let mut verdicts = Vec::new();
    let mut reasons = scenario.excluded.clone();
    for trial in &scenario.trials {
        let Some(golden) = tubes_of_trial(others, trial.index)? else {
            reasons.push(format!("the reference has no trial {}", trial.index));
            continue;
        };
        let one = golden.compare([(trial.index, trial.rows()?)]);
        verdicts.push(one.verdict);
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
        Verdict::Fail => Some(format!("{outside} of {trials} trials lie outside")),
        Verdict::Inconclusive => reasons.into_iter().next().or(all.reason),
    };
    Ok(all)
}

/// Compares all trials with `golden`. A pass is inconclusive if a trial does not count.
pub(crate) fn compare_with_tubes(
    golden: &GoldenTubes,
    scenario: &ScenarioTrials,
) -> Result<TubeComparison, CompareError> {
    // One trace is in memory at a time.
    let mut failed = None;
    let readable = scenario.trials.iter().map_while(|trial| match trial.rows() {
        Ok(rows) => Some((trial.index, rows)),
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
        Some(what) if comparison.verdict == Verdict::Pass => {
            TubeComparison { verdict: Verdict::Inconclusive, reason: Some(what.clone()), ..comparison }
        }
        _ => comparison,
    })
}

fn draw_worst(
    reference: &Reference,
    scenario: &ScenarioTrials,
    comparison: &TubeComparison,
    folder: &Path,
) -> Result<Option<PathBuf>, CompareError> {
    let Some((trial, worst)) = &comparison.worst else { return Ok(None) };
    let golden = reference.tubes_for(*trial)?;
    let tube = golden.as_ref().and_then(|golden| golden.tubes.iter().find(|tube| tube.signal == worst.signal));
    let stored = scenario.trials.iter().find(|stored| stored.index == *trial);
    let rows = stored.map(StoredTrial::rows).transpose()?;
    let Some((tube, rows)) = tube.zip(rows) else { return Ok(None) };
    let svg = match platebench_report::chart::draw_exceedance(tube, &rows, *trial, worst) {
        Ok(svg) => svg,
        Err(error) => {
            stdio::error(&error.to_string());
            return Ok(None);
        }
    };
    // The path of a trace may lead out of the folder.
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

/// The reference of a scenario.
fn find_reference(arguments: &CompareArgs, scenario: &ScenarioTrials) -> Result<Reference, CompareError> {
    let one = |golden: Option<GoldenTubes>| {
        golden.map_or(Reference::Nothing, |golden| Reference::SameTubes(Box::new(golden)))
    };
    let against = Path::new(&arguments.against);
    if arguments.against == BASELINE_KEYWORD {
        let named = if is_run_folder(&arguments.subject) {
            Some(scenario.name.clone())
        } else {
            scenario_of(&arguments.subject)
        };
        let Some(name) = named else { return Err(CompareError::NoScenario(arguments.subject.clone())) };
        return Ok(one(Baseline::read(&arguments.baselines, &name)?.map(|accepted| accepted.golden)));
    }
    if against.extension().is_some_and(|extension| extension == "toml") {
        return Ok(one(Some(Baseline::read_files(against, &against.with_extension("csv"))?.golden)));
    }
    if !is_run_folder(against) {
        return Ok(one(GoldenTubes::from_rows(&read_trace(against)?)));
    }
    let mut others = read_trials(against)?;
    if is_run_folder(&arguments.subject) {
        let other = others.into_iter().find(|other| other.name == scenario.name);
        return Ok(other.map_or(Reference::Nothing, |other| Reference::PerTrial(other.trials)));
    }
    match (others.pop(), others.len()) {
        (Some(only), 0) => {
            let first = only.trials.first().map(StoredTrial::rows).transpose()?;
            Ok(one(first.and_then(|rows| GoldenTubes::from_rows(&rows))))
        }
        (_, further) => Err(CompareError::SeveralScenarios { path: against.to_owned(), count: further + 1 }),
    }
}

/// The scenario of a trace in a run folder, from its path below `traces`.
fn scenario_of(trace: &Path) -> Option<String> {
    let parts: Vec<_> = trace.parent()?.components().map(|part| part.as_os_str().to_string_lossy()).collect();
    let below = parts.iter().rposition(|part| part == "traces")? + 1;
    Some(format!("{}.toml", parts.get(below..).filter(|parts| !parts.is_empty())?.join("/")))
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
