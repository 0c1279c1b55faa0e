//! `platebench compare`: compares responses with other responses or with baselines.

use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{BASELINES, OutputFormat};
use crate::outputs::{Outputs, repository_path};
use crate::stdio;
use clap::Args;
use platebench_document::format::count;
use platebench_engine::comparison::{
    BASELINE_KEYWORD, CompareError, Reference, ScenarioTrials, StoredTrial, is_run_folder, read_trials, read_trials_of,
};
use platebench_model::quoted_path;
use platebench_model::record::{RunRecord, ScenarioRecord, Verdict};
use platebench_model::trace::{OutputFolder, Row};
use platebench_report::comparison::{ResponseChanges, ScenarioComparison, comparison_document, tube_plot};
use platebench_report::github::{ComparisonPage, SourceLocation};
use platebench_verdict::golden::TubeComparison;
use platebench_verdict::tube::{Exceedance, Tube};
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
    #[command(flatten)]
    options: ComparisonOptions,
}

#[derive(Debug, Args)]
struct ComparisonOptions {
    /// Folder of the baselines
    #[arg(long, value_name = "FOLDER", default_value = BASELINES)]
    baselines: PathBuf,
    /// Folder for a drawing of each scenario's largest deviation; default for a run: RUN/comparison
    #[arg(long, value_name = "FOLDER")]
    draw: Option<PathBuf>,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
    #[command(flatten)]
    outputs: Outputs,
}

/// Arguments of `baseline diff`, which is `compare RUN baseline`.
#[derive(Debug, Args)]
pub(crate) struct DiffArgs {
    /// The run folder
    run: PathBuf,
    #[command(flatten)]
    options: ComparisonOptions,
}

pub(crate) fn compare(arguments: &CompareArgs) -> CommandResult {
    let CompareArgs { subject, reference, options } = arguments;
    Subject { path: subject, reference, options }.compare()
}

pub(crate) fn diff(arguments: &DiffArgs) -> CommandResult {
    let DiffArgs { run, options } = arguments;
    // A run is required, because `compare` also takes a single trace.
    RunRecord::read(run).or_invalid()?;
    Subject { path: run, reference: BASELINE_KEYWORD, options }.compare()
}

struct Subject<'a> {
    path: &'a Path,
    reference: &'a str,
    options: &'a ComparisonOptions,
}

const DRAWINGS_FOLDER: &str = "comparison";

impl Subject<'_> {
    fn compare(&self) -> CommandResult {
        let ComparisonOptions { format, outputs, .. } = self.options;
        let reference = Some(Path::new(self.reference)).filter(|path| *path != Path::new(BASELINE_KEYWORD));
        for path in std::iter::once(self.path).chain(reference) {
            if !path.exists() {
                return Err(Failure::invalid(&format!("{}: no such file or folder", path.display())));
            }
        }
        outputs.check(*format).or_invalid()?;
        outputs.set_aside().or_invalid()?;
        let comparisons = self.compare_all().or_invalid()?;
        let document = comparison_document(&comparisons);
        if outputs.replaces_table() {
            stdio::show_beside(true, &stdio::console_text(&document));
        } else {
            stdio::show_result(*format, &comparisons, &document);
        }
        let (exit, reason) = if let Some(reason) = self.nothing_compared(&comparisons) {
            (Exit::NothingToRun, reason)
        } else {
            let verdicts: Vec<_> = comparisons.iter().map(|one| one.comparison.verdict).collect();
            let exit = Exit::of_verdict(Verdict::combine(verdicts.iter().copied()));
            (exit, count_verdicts(&verdicts, ["agree", "differ", "have no reference or no decision"]))
        };
        let heading = format!("{} platebench compare: {}", exit.sign(), exit.word());
        let accept = self.accept_command();
        let page = ComparisonPage { heading, reason: &reason, comparisons: &comparisons, accept };
        outputs
            .write(|| page.render(), || page.workflow_commands(&|scenario| self.baseline_location(scenario)))
            .or_invalid()?;
        if exit == Exit::NothingToRun {
            return Err(Failure::new(exit, &reason));
        }
        exit.show_verdict(&reason, if outputs.replaces_table() { OutputFormat::Json } else { *format });
        Ok(exit)
    }

    /// `None` unless the changes of a run can be accepted.
    fn accept_command(&self) -> Option<String> {
        let baselines = &self.options.baselines;
        let options = if baselines == Path::new(BASELINES) {
            String::new()
        } else {
            format!(" --baselines {}", quoted_path(baselines))
        };
        let is_baseline = self.reference == BASELINE_KEYWORD && is_run_folder(self.path);
        is_baseline.then(|| format!("platebench baseline accept {}{options}", quoted_path(self.path)))
    }

    /// The file of the baseline, which accepting would change.
    fn baseline_location(&self, scenario: &str) -> Option<SourceLocation> {
        let path = self.options.baselines.join(scenario);
        let is_baseline = self.reference == BASELINE_KEYWORD && path.is_file();
        is_baseline.then(|| SourceLocation { file: repository_path(&path), line: 1 })
    }

    /// Why nothing was compared. `None` if something was.
    fn nothing_compared(&self, comparisons: &[ScenarioComparison]) -> Option<String> {
        if comparisons.is_empty() {
            return Some("the run contains no scenario, so there is nothing to compare".to_owned());
        }
        if comparisons.iter().any(|one| one.comparison.trials > 0) {
            return None;
        }
        let (subject, baselines) = (self.path.display(), self.options.baselines.display());
        let hint = if self.reference != BASELINE_KEYWORD {
            comparisons.iter().find_map(|one| one.comparison.reason.clone()).unwrap_or_default()
        } else if self.options.baselines.is_dir() {
            format!(
                "{baselines} has no golden trace for {subject}. Name another folder with --baselines, or create \
                 golden traces: `platebench baseline review {subject}`"
            )
        } else {
            format!(
                "{baselines} is no folder. Name the folder with --baselines, or create golden traces there: \
                 `platebench baseline review {subject}`"
            )
        };
        Some(format!("nothing was compared: {hint}"))
    }

    fn compare_all(&self) -> Result<Vec<ScenarioComparison>, CompareError> {
        let Self { path: subject, reference: against, options } = *self;
        let record = is_run_folder(subject).then(|| RunRecord::read(subject)).transpose()?;
        let trials =
            record.as_ref().map_or_else(|| read_trials(subject), |record| Ok(read_trials_of(record, subject)))?;
        // The user names the first folder. A link in the place of the second is not followed.
        let drawings = match &options.draw {
            Some(folder) => Some((&**folder, "")),
            None => record.is_some().then_some((subject, DRAWINGS_FOLDER)),
        };
        self.note_missing(&trials)?;
        let mut comparisons = Vec::new();
        for (index, scenario) in trials.iter().enumerate() {
            let reference = Reference::find(subject, against, &options.baselines, scenario)?;
            let judged = record.as_ref().and_then(|record| Some((record, record.scenarios.get(index)?)));
            let mut compared = compare_scenario(&reference, judged, scenario)?;
            if let Some((folders, place)) = drawings.zip(WorstPlace::find(&reference, scenario, &compared.comparison)?)
            {
                compared.plot = place.plot();
                compared.drawing = Some(place.draw(scenario, folders)?);
            }
            comparisons.push(compared);
        }
        Ok(comparisons)
    }

    /// Reports trials that only the reference has. Without this, a run with fewer trials could pass.
    fn note_missing(&self, subject: &[ScenarioTrials]) -> Result<(), CompareError> {
        let against = Path::new(self.reference);
        if self.reference == BASELINE_KEYWORD || !is_run_folder(self.path) || !is_run_folder(against) {
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
}

/// `words` follow the numbers of passed, failed and inconclusive scenarios.
pub(crate) fn count_verdicts(verdicts: &[Verdict], words: [&str; 3]) -> String {
    let parts = [Verdict::Pass, Verdict::Fail, Verdict::Inconclusive].into_iter().zip(words).map(|(wanted, words)| {
        let number = verdicts.iter().filter(|verdict| **verdict == wanted).count();
        format!("{number} {words}")
    });
    format!("of {}, {}", count(verdicts.len(), "scenario"), parts.collect::<Vec<_>>().join(", "))
}

/// Compares curves, and the judged values if the trials are those of a record.
pub(crate) fn compare_scenario(
    reference: &Reference,
    judged: Option<(&RunRecord, &ScenarioRecord)>,
    trials: &ScenarioTrials,
) -> Result<ScenarioComparison, CompareError> {
    let (before, comparison) = (reference.response.as_ref(), reference.compare(trials)?);
    // A single trace has no judged values.
    let judged = judged.filter(|_| before.is_some() || comparison.trials == 0);
    let changes = judged.map(|(record, scenario)| ResponseChanges::between(before, record, scenario));
    Ok(ScenarioComparison {
        scenario: trials.name.clone(),
        comparison,
        changes: changes.unwrap_or_default(),
        drawing: None,
        plot: Vec::new(),
    })
}

/// Where a response is farthest outside its tube.
struct WorstPlace<'a> {
    trial: u32,
    worst: &'a Exceedance,
    tube: Tube,
    rows: Vec<Row>,
}

impl<'a> WorstPlace<'a> {
    fn find(
        reference: &Reference,
        scenario: &ScenarioTrials,
        comparison: &'a TubeComparison,
    ) -> Result<Option<Self>, CompareError> {
        let Some((trial, worst)) = &comparison.worst else { return Ok(None) };
        let golden = reference.tubes_for(*trial)?;
        let tube = golden.and_then(|golden| golden.tubes.into_iter().find(|tube| tube.signal == worst.signal));
        let stored = scenario.trials.iter().find(|stored| stored.index == *trial);
        let rows = stored.map(StoredTrial::rows).transpose()?;
        Ok(tube.zip(rows).map(|(tube, rows)| Self { trial: *trial, worst, tube, rows }))
    }

    fn plot(&self) -> Vec<String> {
        tube_plot(&self.tube, &self.rows, self.worst)
    }

    /// Returns the path of the drawing.
    fn draw(&self, scenario: &ScenarioTrials, (folder, below): (&Path, &str)) -> Result<PathBuf, CompareError> {
        let svg = platebench_report::draw_exceedance(&self.tube, &self.rows, self.trial, self.worst);
        // A trace has a path as its name, and this path could lead out of `folder`.
        let name = if Path::new(&scenario.name).is_absolute() || scenario.name.contains("..") {
            Path::new(&scenario.name).file_name().map(PathBuf::from).unwrap_or_default()
        } else {
            PathBuf::from(&scenario.name)
        };
        let name = Path::new(below).join(name).with_extension("svg");
        OutputFolder::create(folder)?.write(&name, svg)?;
        Ok(folder.join(name))
    }
}
