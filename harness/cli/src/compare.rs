//! `platebench compare`: compares responses with other responses or with baselines.

use crate::baseline::count_verdicts;
use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{BASELINES, OutputFormat};
use crate::stdio;
use clap::Args;
use platebench_engine::comparison::{
    BASELINE_KEYWORD, CompareError, Reference, ScenarioTrials, StoredTrial, is_run_folder, read_trials,
};
use platebench_model::record::{RunRecord, Verdict};
use platebench_model::trace::OutputFolder;
use platebench_report::comparison::{ScenarioComparison, comparison_document};
use platebench_verdict::golden::TubeComparison;
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench compare runs/tonight baseline
  platebench compare runs/tonight runs/yesterday
  platebench compare board.csv scenarios/baselines/paper/fig13-closed-loop.toml

Exit codes: 0 all inside, 1 something outside, 3 a reference is missing or another time range,
4 nothing was compared")]
pub(crate) struct CompareArgs {
    /// A trace or a run folder
    #[arg(value_name = "TRACE|RUN")]
    subject: PathBuf,
    /// The reference: a trace, a run folder, the .toml file of a baseline, or `baseline` for the
    /// baseline of each scenario
    #[arg(value_name = "TRACE|RUN|baseline")]
    reference: String,
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

const DRAWINGS_FOLDER: &str = "comparison";

pub(crate) fn compare(arguments: &CompareArgs) -> CommandResult {
    let reference = Some(Path::new(&arguments.reference)).filter(|path| *path != Path::new(BASELINE_KEYWORD));
    for path in std::iter::once(arguments.subject.as_path()).chain(reference) {
        if !path.exists() {
            return Err(Failure::invalid(&format!("{}: no such file or folder", path.display())));
        }
    }
    let comparisons = compare_all(arguments).or_invalid()?;
    stdio::show_result(arguments.format, &comparisons, &comparison_document(&comparisons));
    if comparisons.is_empty() {
        return Err(Failure::new(Exit::NothingToRun, &"the run contains no scenario, so there is nothing to compare"));
    }
    if comparisons.iter().all(|one| one.comparison.trials == 0) {
        let reason = comparisons.iter().find_map(|one| one.comparison.reason.as_deref());
        return Err(nothing_compared(arguments, reason.unwrap_or_default()));
    }
    let verdicts: Vec<_> = comparisons.iter().map(|one| one.comparison.verdict).collect();
    let exit = Exit::of_verdict(Verdict::combine(verdicts.iter().copied()));
    exit.show_verdict(
        &count_verdicts(&verdicts, ["agree", "differ", "have no reference or no decision"]),
        arguments.format,
    );
    Ok(exit)
}

fn nothing_compared(arguments: &CompareArgs, reason: &str) -> Failure {
    let (subject, baselines) = (arguments.subject.display(), arguments.baselines.display());
    let hint = if arguments.reference != BASELINE_KEYWORD {
        reason.to_owned()
    } else if arguments.baselines.is_dir() {
        format!(
            "{baselines} has no golden trace for {subject}. Name another folder with --baselines, or create golden \
             traces: `platebench baseline review {subject}`"
        )
    } else {
        format!(
            "{baselines} is no folder. Name the folder with --baselines, or create golden traces there: `platebench \
             baseline review {subject}`"
        )
    };
    Failure::new(Exit::NothingToRun, &format!("nothing was compared: {hint}"))
}

fn compare_all(arguments: &CompareArgs) -> Result<Vec<ScenarioComparison>, CompareError> {
    let subject = read_trials(&arguments.subject)?;
    // The user names the first folder. A link in the place of the second is not followed.
    let drawings = match &arguments.draw {
        Some(folder) => Some((&**folder, "")),
        None => is_run_folder(&arguments.subject).then_some((&*arguments.subject, DRAWINGS_FOLDER)),
    };
    note_missing(arguments, &subject)?;
    let mut comparisons = Vec::new();
    for scenario in subject {
        let reference = Reference::find(&arguments.subject, &arguments.reference, &arguments.baselines, &scenario)?;
        let comparison = reference.compare(&scenario)?;
        let drawing = match drawings {
            Some(folders) => draw_worst(&reference, &scenario, &comparison, folders)?,
            None => None,
        };
        comparisons.push(ScenarioComparison { scenario: scenario.name, comparison, drawing });
    }
    Ok(comparisons)
}

/// Reports trials that only the reference has. Without this, a run with fewer trials could pass.
fn note_missing(arguments: &CompareArgs, subject: &[ScenarioTrials]) -> Result<(), CompareError> {
    let against = Path::new(&arguments.reference);
    if arguments.reference == BASELINE_KEYWORD || !is_run_folder(&arguments.subject) || !is_run_folder(against) {
        return Ok(());
    }
    for other in &RunRecord::read(against)?.scenarios {
        let own = subject.iter().find(|own| own.name == other.file);
        let [trials, others] = [own.map_or(0, |own| own.trials.len() + own.excluded.len()), other.trials.len()];
        if trials < others {
            let (file, against) = (&other.file, against.display());
            stdio::note(&format!("{file}: the run has only {trials} of the {others} trials of {against}"));
        }
    }
    Ok(())
}

fn draw_worst(
    reference: &Reference,
    scenario: &ScenarioTrials,
    comparison: &TubeComparison,
    (folder, below): (&Path, &str),
) -> Result<Option<PathBuf>, CompareError> {
    let Some((trial, worst)) = &comparison.worst else { return Ok(None) };
    let golden = reference.tubes_for(*trial)?;
    let tube = golden.as_ref().and_then(|golden| golden.tubes.iter().find(|tube| tube.signal == worst.signal));
    let stored = scenario.trials.iter().find(|stored| stored.index == *trial);
    let rows = stored.map(StoredTrial::rows).transpose()?;
    let Some((tube, rows)) = tube.zip(rows) else { return Ok(None) };
    let svg = platebench_report::draw_exceedance(tube, &rows, *trial, worst);
    // A trace has a path as its name, and this path could lead out of `folder`.
    let name = if Path::new(&scenario.name).is_absolute() || scenario.name.contains("..") {
        Path::new(&scenario.name).file_name().map(PathBuf::from).unwrap_or_default()
    } else {
        PathBuf::from(&scenario.name)
    };
    let name = Path::new(below).join(name).with_extension("svg");
    OutputFolder::create(folder)?.write(&name, svg)?;
    Ok(Some(folder.join(name)))
}
