//! `platebench baseline`: accepts, reviews, lists and compares golden traces.

use crate::compare::{self, DiffArgs, count_verdicts};
use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{BASELINES, OutputFormat, parse_number};
use crate::{prompt, stdio};
use clap::{Args, Subcommand};
use platebench_document::{Block, Document};
use platebench_engine::comparison::{
    BaselineAcceptError, CompareError, Reference, ScenarioTrials, build_baseline, check_acceptable,
    read_scenario_trials,
};
use platebench_engine::rejudge;
use platebench_model::record::{FileLock, RunRecord, ScenarioRecord, Verdict};
use platebench_model::trace::{create_folder, missing_folders, remove_empty_folders};
use platebench_report::comparison::{ScenarioComparison, tube_plot};
use platebench_report::format::exceedance;
use platebench_verdict::golden::{Baseline, JudgedResponse};
use std::fs;
use std::iter;
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench baseline diff runs/tonight
  platebench baseline review runs/tonight
  platebench baseline accept runs/tonight
  platebench baseline list")]
pub(crate) struct BaselineArgs {
    #[command(subcommand)]
    action: BaselineAction,
}

#[derive(Debug, Subcommand)]
enum BaselineAction {
    /// Make the traces of a run golden, if it passed, and list the changes
    Accept(ReviewArgs),
    /// List the golden traces of all scenarios, or of the scenarios of a run
    List {
        /// The run folder
        run: Option<PathBuf>,
        /// Folder of the baselines
        #[arg(long, value_name = "FOLDER", default_value = BASELINES)]
        baselines: PathBuf,
    },
    /// Show each difference with a drawing, and ask: accept, reject or skip
    Review(ReviewArgs),
    /// List what accepting a run would change: `compare RUN baseline`
    Diff(DiffArgs),
}

#[derive(Debug, Args)]
struct ReviewArgs {
    /// The run folder
    run: PathBuf,
    /// Folder of the baselines
    #[arg(long, value_name = "FOLDER", default_value = BASELINES)]
    baselines: PathBuf,
    /// If trials differ: the share of later unchanged trials that may leave the learned tube
    #[arg(long, value_name = "SHARE", default_value_t = 0.05, value_parser = parse_share)]
    false_alarm_rate: f64,
}

fn parse_share(text: &str) -> Result<f64, String> {
    parse_number(text, |share| (1e-4..=0.5).contains(&share), "a share from 0.0001 to 0.5")
}

pub(crate) fn baseline(arguments: &BaselineArgs) -> CommandResult {
    match &arguments.action {
        BaselineAction::List { run, baselines } => list_baselines(run.as_deref(), baselines),
        BaselineAction::Diff(arguments) => compare::diff(arguments),
        BaselineAction::Accept(arguments) => review(arguments, Action::Accept),
        BaselineAction::Review(arguments) => review(arguments, Action::Ask),
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Action {
    Accept,
    Ask,
}

const CHOICES: [(&str, &str); 4] = [
    ("accept", "the response becomes the golden trace"),
    ("reject", "the golden trace stays; the review ends with exit code 1"),
    ("skip", "no decision; the review ends with exit code 3"),
    ("quit", "no decision about this and the other scenarios"),
];

fn review(arguments: &ReviewArgs, action: Action) -> CommandResult {
    let ReviewArgs { run, baselines, false_alarm_rate: rate } = arguments;
    // Only verdicts from the traces count, because the verdicts in run.json may have been edited.
    let record = &rejudge(run, None)?;
    let rate = *rate;
    if record.scenarios.is_empty() {
        return Err(Failure::new(Exit::NothingToRun, &"the run contains no scenario, so there is nothing to review"));
    }
    // One process at a time writes the folder, so that its files are of one run.
    let _lock = lock_baselines(baselines)?;
    let (mut invalid, mut verdicts, mut has_quit) = (false, Vec::new(), false);
    for scenario in &record.scenarios {
        let old = Baseline::read(baselines, &scenario.file).map_err(CompareError::from);
        let reviewed = old.map_err(BaselineAcceptError::from).and_then(|old| {
            let candidate = Candidate { record, scenario, trials: read_scenario_trials(run, scenario), old };
            let accept = || candidate.accept(baselines, rate);
            match action {
                Action::Accept => accept(),
                Action::Ask => match candidate.show_difference()? {
                    Verdict::Pass => Ok(Verdict::Pass),
                    found => {
                        candidate.print_drawings()?;
                        // After `quit`, and at the end of the input, the others are not decided.
                        let answer = if has_quit { None } else { prompt::ask_choice(&CHOICES) };
                        has_quit = matches!(answer, None | Some("quit"));
                        match answer {
                            Some("accept") => accept(),
                            Some("reject") => Ok(Verdict::Fail),
                            _ => Ok(Verdict::combine([found, Verdict::Inconclusive])),
                        }
                    }
                },
            }
        });
        match reviewed {
            Ok(verdict) => verdicts.push(verdict),
            Err(error) => {
                stdio::error(&format!("{}: {error}", scenario.file));
                invalid = true;
            }
        }
    }
    let exit = if invalid { Exit::Invalid } else { Exit::of_verdict(Verdict::combine(verdicts.iter().copied())) };
    if exit != Exit::Passed {
        let words = ["agree with their golden traces", "differ or did not pass", "have no golden trace or no decision"];
        exit.show_verdict(&count_verdicts(&verdicts, words), OutputFormat::Human);
    }
    Ok(exit)
}

/// The lock of a folder of baselines. Its end removes the folder again if nothing was accepted.
struct BaselinesLock {
    created: Vec<PathBuf>,
    _lock: FileLock,
}

impl Drop for BaselinesLock {
    fn drop(&mut self) {
        remove_empty_folders(&self.created);
    }
}

fn lock_baselines(folder: &Path) -> Result<BaselinesLock, Failure> {
    let created = missing_folders(folder);
    create_folder(folder).or_invalid_at(folder)?;
    let in_use = || {
        let folder = folder.display();
        Failure::invalid(&format!("{folder} is in use by another `platebench baseline`; try again when it has ended"))
    };
    let lock = FileLock::exclusive(folder).or_invalid()?.ok_or_else(in_use)?;
    Ok(BaselinesLock { created, _lock: lock })
}

/// The responses of a scenario, and those that were accepted before.
struct Candidate<'a> {
    record: &'a RunRecord,
    scenario: &'a ScenarioRecord,
    trials: ScenarioTrials,
    old: Option<Baseline>,
}

impl Candidate<'_> {
    /// `None` if there is no baseline.
    fn compare(&self) -> Result<Option<ScenarioComparison>, CompareError> {
        let judged = Some((self.record, self.scenario));
        let old = self.old.clone().map(Reference::from);
        old.map(|old| compare::compare_scenario(&old, judged, &self.trials)).transpose()
    }

    fn show_difference(&self) -> Result<Verdict, CompareError> {
        let Some(compared) = self.compare()? else {
            stdio::show(&format!("? new  {}\n", self.scenario.file));
            return Ok(Verdict::Inconclusive);
        };
        stdio::document(&Document::new("Differences from the baseline", compared.blocks()));
        Ok(compared.comparison.verdict)
    }

    /// Draws the signals outside their tubes, for the first trial that has such a signal.
    fn print_drawings(&self) -> Result<(), CompareError> {
        let Some(old) = &self.old else { return Ok(()) };
        for trial in &self.trials.trials {
            let rows = trial.rows()?;
            let outside = old.golden.exceedances(&rows);
            for worst in &outside {
                let Some(tube) = old.golden.tubes.iter().find(|tube| tube.signal == worst.signal) else { continue };
                let place = format!("  {}", exceedance(trial.index, worst));
                let lines = std::iter::once(place).chain(tube_plot(tube, &rows, worst));
                stdio::document(&Document::new("Response outside its tolerance tube", vec![Block::lines(lines)]));
            }
            if !outside.is_empty() {
                break;
            }
        }
        Ok(())
    }

    fn accept(&self, baselines: &Path, rate: f64) -> Result<Verdict, BaselineAcceptError> {
        let Self { record, scenario, trials, old } = self;
        if scenario.verdict != Verdict::Pass {
            stdio::show(&format!("✗ not accepted  {}: it did not pass ({})\n", scenario.file, scenario.verdict));
            return Ok(scenario.verdict);
        }
        check_acceptable(record, trials)?;
        let new = build_baseline(record, scenario, trials, old.as_ref(), rate)?;
        let is_unchanged = old.as_ref().is_some_and(|old| old.to_texts() == new.to_texts());
        let lines = match self.compare()? {
            _ if is_unchanged => vec![format!("✓ unchanged  {}", scenario.file)],
            Some(ScenarioComparison { comparison, changes, .. }) => {
                let worst = comparison.worst.iter().map(|(trial, worst)| format!("  {}", exceedance(*trial, worst)));
                let accepted = format!("✓ accepted  {}", scenario.file);
                std::iter::once(accepted).chain(changes.lines()).chain(worst).collect()
            }
            None => vec![format!("✓ accepted  {}  ({})", scenario.file, with_values("new", &new.response))],
        };
        new.write(baselines).map_err(CompareError::from)?;
        stdio::show(&(lines.join("\n") + "\n"));
        Ok(Verdict::Pass)
    }
}

/// A list of `first` and the values.
fn with_values(first: &str, response: &JudgedResponse) -> String {
    let values = response.values.iter().flatten().map(|(name, value)| format!("{name} {value}"));
    iter::once(first.to_owned()).chain(values).collect::<Vec<_>>().join(", ")
}

fn list_baselines(run: Option<&Path>, baselines: &Path) -> CommandResult {
    let mut names = Vec::new();
    match run {
        Some(run) => {
            let record = RunRecord::read(run).or_invalid()?;
            names.extend(record.scenarios.into_iter().map(|scenario| scenario.file));
        }
        None => collect_names(baselines, "", &mut names)?,
    }
    for name in &names {
        let line = match Baseline::read(baselines, name).or_invalid()? {
            None => format!("– {name}: no baseline"),
            Some(baseline) => {
                let learned = baseline.learned.as_ref().map(|learned| {
                    format!(
                        ", learned from {} trials at {} % false alarms",
                        learned.trials,
                        learned.false_alarm_rate * 100.0
                    )
                });
                let learned = learned.unwrap_or_default();
                let JudgedResponse { law, build, .. } = &baseline.response;
                format!("✓ {name}: {} ({}){learned}", with_values(law, &baseline.response), build.firmware)
            }
        };
        stdio::show(&format!("{line}\n"));
    }
    if names.is_empty() {
        return Err(Failure::new(
            Exit::NothingToRun,
            &"there is no baseline; `platebench baseline accept RUN` makes baselines of a run",
        ));
    }
    Ok(Exit::Passed)
}

fn collect_names(folder: &Path, prefix: &str, names: &mut Vec<String>) -> Result<(), Failure> {
    let entries = fs::read_dir(folder).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let mut entries = entries.or_invalid_at(folder)?;
    entries.sort_by_key(fs::DirEntry::file_name);
    for entry in entries {
        let name = format!("{prefix}{}", entry.file_name().to_string_lossy());
        if entry.file_type().or_invalid_at(folder)?.is_dir() {
            collect_names(&entry.path(), &format!("{name}/"), names)?;
        } else if entry.path().extension().is_some_and(|extension| extension == "toml") {
            names.push(name);
        }
    }
    Ok(())
}
