//! `platebench check`: checks scenarios, plates, plans and settings without playing them.

use crate::config::Config;
use crate::exit::{CommandResult, Exit, Failure};
use crate::options::{OutputFormat, SCENARIOS};
use crate::selection::ScenarioFilter;
use crate::stdio;
use clap::{Args, Command};
use platebench_document::format::count;
use platebench_engine::law;
#[cfg(feature = "export")]
use platebench_experiments::campaign::Campaign;
use platebench_experiments::explore::Envelope;
use platebench_lab::acceptance::AcceptancePlan;
use platebench_lab::boards::Inventory;
use platebench_model::scenario::{
    Diagnostic, FileKind, list_files, load, load_with_all_errors, read_requirements, repeated_names, scenario_warnings,
};
use platebench_model::trace::FileError;
use platebench_verdict::golden::{Baseline, BaselineError};
use platebench_verdict::uncertainty::{Budget, known_quantities};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench check                          every scenario, plate and plan below scenarios/
  platebench check scenarios/paper my.toml
  platebench check platebench.toml
  platebench check --tag paper              scenarios with this tag only
  platebench check --format json            problems and warnings for programs

Exit codes: 0 no problem, 2 at least one problem, 4 there was nothing to check")]
pub(crate) struct CheckArgs {
    /// Scenario, plate, plan and settings files, or folders with everything below them
    #[arg(value_name = "FILE|FOLDER", default_value = SCENARIOS)]
    scenarios: Vec<PathBuf>,
    /// Format of standard output; json: every problem and warning, with file, line and column
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
    #[command(flatten)]
    tags: ScenarioFilter,
}

#[derive(Serialize)]
struct CheckResult<'a> {
    files: usize,
    #[serde(rename = "faults")]
    problems: Vec<ProblemLocation<'a>>,
    warnings: Vec<ProblemLocation<'a>>,
}

/// `line` and `column` count from 1. `None` if the file could not be read.
#[derive(Serialize)]
struct ProblemLocation<'a> {
    file: &'a Path,
    line: Option<usize>,
    column: Option<usize>,
    message: &'a str,
}

impl<'a> From<&'a Diagnostic> for ProblemLocation<'a> {
    fn from(problem: &'a Diagnostic) -> Self {
        let (line, column) = problem.location().unzip();
        Self { file: &problem.path, line, column, message: &problem.message }
    }
}

fn diagnostics(kind: FileKind, path: &Path, name: &str, definition: &Command) -> Vec<Diagnostic> {
    match kind {
        FileKind::Scenario => match load_with_all_errors(path, name) {
            Ok(scenario) => law(&scenario).err().into_iter().collect(),
            Err(problems) => problems,
        },
        FileKind::Plate => load::load_plate(path).err().unwrap_or_default(),
        FileKind::Plan => AcceptancePlan::load(path).err().unwrap_or_default(),
        FileKind::Envelope => Envelope::load(path).err().unwrap_or_default(),
        #[cfg(not(feature = "export"))]
        FileKind::Campaign => vec![Diagnostic::for_file(path, "this bench was built without the feature `export`")],
        #[cfg(feature = "export")]
        FileKind::Campaign => Campaign::load(path).err().unwrap_or_default(),
        FileKind::Boards => Inventory::read(path).err().unwrap_or_default(),
        FileKind::Requirements => read_requirements(path).err().unwrap_or_default(),
        FileKind::Config => Config::read(path, definition).err().unwrap_or_default(),
        FileKind::Budget => Budget::load(path, &known_quantities()).err().unwrap_or_default(),
        FileKind::Baseline => match Baseline::read_files(path, &path.with_extension("csv")) {
            Ok(_) => Vec::new(),
            Err(BaselineError::Content { path, line, message }) => {
                vec![Diagnostic::for_file(&path, format!("line {line}: {message}"))]
            }
            Err(BaselineError::File(FileError { path, source })) => {
                vec![Diagnostic::for_file(&path, format!("cannot be read: {source}"))]
            }
        },
    }
}

/// Selects a scenario by its tags. A file that cannot be loaded or recognised is selected, because
/// its tags are unknown.
fn is_selected(tags: &ScenarioFilter, path: &Path, name: &str) -> bool {
    match FileKind::detect(path) {
        Ok(FileKind::Scenario) => load_with_all_errors(path, name).map_or(true, |scenario| tags.selects(&scenario)),
        Ok(_) => false,
        Err(_) => true,
    }
}

/// `definition` is the command line. It checks the values of settings.
pub(crate) fn check(arguments: &CheckArgs, definition: &Command) -> CommandResult {
    let (mut files, mut problems) = list_files(&arguments.scenarios);
    if !arguments.tags.is_empty() {
        files.retain(|(path, name)| is_selected(&arguments.tags, path, name));
    }
    let kinds: Vec<_> = files.iter().map(|(path, _)| FileKind::detect(path)).collect();
    for ((path, name), kind) in files.iter().zip(&kinds) {
        let found = match kind {
            Ok(kind) => diagnostics(*kind, path, name, definition),
            Err(problems) => problems.clone(),
        };
        for problem in found {
            // A faulty plate reports its problem once for each scenario that uses it.
            if !problems.contains(&problem) {
                problems.push(problem);
            }
        }
    }
    let of_kind = |wanted| files.iter().zip(&kinds).filter(move |(_, kind)| **kind == Ok(wanted)).map(|(file, _)| file);
    problems.extend(repeated_names(of_kind(FileKind::Scenario)));
    let mut warnings = Vec::new();
    if problems.is_empty() {
        let scenarios = of_kind(FileKind::Scenario).filter_map(|(path, name)| load(path, name).ok());
        warnings.extend(scenario_warnings(&scenarios.collect::<Vec<_>>()));
        for (path, _) in of_kind(FileKind::Plate) {
            let found = load::load_plate(path).ok().and_then(|plate| load::implausible_values(path, &plate).ok());
            warnings.extend(found.unwrap_or_default());
        }
    }
    if arguments.format == OutputFormat::Json {
        let problems = problems.iter().map(ProblemLocation::from).collect();
        let warnings = warnings.iter().map(ProblemLocation::from).collect();
        stdio::show_json(&CheckResult { files: files.len(), problems, warnings });
    }
    problems.iter().for_each(stdio::diagnostic);
    if !problems.is_empty() {
        stdio::note(&format!("{} in {}", count(problems.len(), "problem"), count(files.len(), "file")));
        return Ok(Exit::Invalid);
    }
    if files.is_empty() {
        return Err(Failure::new(
            Exit::NothingToRun,
            &"no file was found, so there is nothing to check; name a scenario, plate, plan or configuration file, or \
              a folder with such files",
        ));
    }
    for warning in &warnings {
        stdio::note(&format!("warning: {warning}"));
    }
    let mut counts = BTreeMap::new();
    for kind in kinds.into_iter().flatten() {
        *counts.entry(kind).or_insert(0) += 1;
    }
    let counts: Vec<_> = counts.into_iter().map(|(kind, files)| count(files, kind.name())).collect();
    if arguments.format == OutputFormat::Human {
        stdio::show(&format!("no problems in {}\n", counts.join(", ")));
    }
    Ok(Exit::Passed)
}
