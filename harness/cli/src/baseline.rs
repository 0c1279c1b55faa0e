//! `platebench baseline`: accepts, reviews, lists and compares golden traces.

use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{BASELINES, OutputFormat, parse_number};
use crate::{prompt, stdio};
use clap::{Args, Subcommand};
use platebench_document::Document;
use platebench_document::format::count;
use platebench_engine::comparison::{
    BaselineAcceptError, CompareError, ScenarioTrials, build_baseline, check_acceptable, compare_with_tubes,
    read_scenario_trials,
};
use platebench_engine::rejudge;
use platebench_model::quoted;
use platebench_model::record::{FileLock, RunRecord, ScenarioRecord, Verdict};
use platebench_model::trace::{create_folder, missing_folders, remove_empty_folders};
use platebench_report::comparison::{comparison_blocks, tube_plot_document};
use platebench_verdict::golden::{Baseline, BaselineBuild, ResponseFeatures};
use std::fs;
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
    /// List what accepting a run would change
    Diff(ReviewArgs),
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
        BaselineAction::Diff(arguments) => review(arguments, Action::Show),
        BaselineAction::Accept(arguments) => review(arguments, Action::Accept),
        BaselineAction::Review(arguments) => review(arguments, Action::Ask),
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Action {
    Show,
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
    let record = if action == Action::Show { RunRecord::read(run).or_invalid()? } else { rejudge(run, None)? };
    let (record, rate) = (&record, *rate);
    if record.scenarios.is_empty() {
        return Err(Failure::new(Exit::NothingToRun, &"the run contains no scenario, so there is nothing to review"));
    }
    // One process at a time writes the folder, so that its files are of one run.
    let _lock = (action != Action::Show).then(|| lock_baselines(baselines)).transpose()?;
    let (mut invalid, mut verdicts, mut compared, mut has_quit) = (false, Vec::new(), false, false);
    for scenario in &record.scenarios {
        let trials = read_scenario_trials(run, scenario);
        let old = Baseline::read(baselines, &scenario.file).map_err(CompareError::from);
        let reviewed = old.map_err(BaselineAcceptError::from).and_then(|old| {
            compared |= old.is_some();
            let show = || print_difference(record, scenario, &trials, old.as_ref(), rate);
            let accept = || accept_scenario(record, scenario, &trials, old.as_ref(), baselines, rate);
            match action {
                Action::Show => Ok(show()?),
                Action::Accept => accept(),
                Action::Ask => match show()? {
                    Verdict::Pass => Ok(Verdict::Pass),
                    found => {
                        print_drawings(&trials, old.as_ref())?;
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
    if !invalid && !compared && action == Action::Show {
        let message = format!(
            "nothing was compared: {} has no golden trace for this run. Name another folder with --baselines, or \
             create golden traces: `platebench baseline review {}`",
            baselines.display(),
            run.display()
        );
        return Err(Failure::new(Exit::NothingToRun, &message));
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

/// `words` follow the numbers of passed, failed and inconclusive scenarios.
pub(crate) fn count_verdicts(verdicts: &[Verdict], words: [&str; 3]) -> String {
    let parts = [Verdict::Pass, Verdict::Fail, Verdict::Inconclusive].into_iter().zip(words).map(|(wanted, words)| {
        let number = verdicts.iter().filter(|verdict| **verdict == wanted).count();
        format!("{number} {words}")
    });
    format!("of {}, {}", count(verdicts.len(), "scenario"), parts.collect::<Vec<_>>().join(", "))
}

fn print_difference(
    record: &RunRecord,
    scenario: &ScenarioRecord,
    trials: &ScenarioTrials,
    old: Option<&Baseline>,
    rate: f64,
) -> Result<Verdict, CompareError> {
    let Some(old) = old else {
        stdio::show(&format!("? new  {}\n", scenario.file));
        return Ok(Verdict::Inconclusive);
    };
    let compared = compare_with_tubes(&old.golden, trials)?;
    let new = build_baseline(record, scenario, trials, Some(old), rate);
    let changes = new.map(|new| describe_changes(old, &new)).unwrap_or_default();
    let blocks = comparison_blocks(&scenario.file, &compared, changes);
    stdio::document(&Document::new("Differences from the baseline", blocks));
    Ok(compared.verdict)
}

/// Draws the signals outside their tubes, for the first trial that has such a signal.
fn print_drawings(trials: &ScenarioTrials, old: Option<&Baseline>) -> Result<(), CompareError> {
    let Some(old) = old else { return Ok(()) };
    for trial in &trials.trials {
        let rows = trial.rows()?;
        let outside = old.golden.exceedances(&rows);
        for worst in &outside {
            let Some(tube) = old.golden.tubes.iter().find(|tube| tube.signal == worst.signal) else { continue };
            stdio::document(&tube_plot_document(tube, &rows, trial.index, worst));
        }
        if !outside.is_empty() {
            break;
        }
    }
    Ok(())
}

fn accept_scenario(
    record: &RunRecord,
    scenario: &ScenarioRecord,
    trials: &ScenarioTrials,
    old: Option<&Baseline>,
    baselines: &Path,
    rate: f64,
) -> Result<Verdict, BaselineAcceptError> {
    if scenario.verdict != Verdict::Pass {
        stdio::show(&format!("✗ not accepted  {}: it did not pass ({})\n", scenario.file, scenario.verdict));
        return Ok(scenario.verdict);
    }
    check_acceptable(record, trials)?;
    let new = build_baseline(record, scenario, trials, old, rate)?;
    let lines = match old {
        Some(old) if old.to_texts() == new.to_texts() => vec![format!("✓ unchanged  {}", scenario.file)],
        Some(old) => {
            let mut lines = vec![format!("✓ accepted  {}", scenario.file)];
            lines.extend(describe_changes(old, &new));
            let compared = compare_with_tubes(&old.golden, trials)?;
            lines.extend(
                compared
                    .worst
                    .map(|(trial, worst)| format!("  {}", platebench_report::format::exceedance(trial, &worst))),
            );
            lines
        }
        None => vec![format!("✓ accepted  {}  (new, {})", scenario.file, format_features(&new.features))],
    };
    new.write(baselines).map_err(CompareError::from)?;
    stdio::show(&(lines.join("\n") + "\n"));
    Ok(Verdict::Pass)
}

fn describe_changes(old: &Baseline, new: &Baseline) -> Vec<String> {
    let number = |value: Option<f64>| value.map_or_else(|| "none".to_owned(), |value| value.to_string());
    let mut lines = Vec::new();
    if old.law != new.law {
        lines.push(format!("  law: {} → {}", old.law, new.law));
    }
    if old.build != new.build {
        let describe = |build: &BaselineBuild| {
            format!("{} {} on {}", quoted(&build.firmware), quoted(&build.id), quoted(&build.rig))
        };
        lines.push(format!("  build: {} → {}", describe(&old.build), describe(&new.build)));
    }
    for ((name, before), (_, after)) in old.features.by_name().into_iter().zip(new.features.by_name()) {
        if before != after {
            lines.push(format!("  {name}: {} → {}", number(before), number(after)));
        }
    }
    lines
}

fn format_features(features: &ResponseFeatures) -> String {
    let known = features.by_name().into_iter().filter_map(|(name, value)| Some(format!("{name} {}", value?)));
    known.collect::<Vec<_>>().join(", ")
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
                format!(
                    "✓ {name}: {}, {} ({}){learned}",
                    baseline.law,
                    format_features(&baseline.features),
                    baseline.build.firmware
                )
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
