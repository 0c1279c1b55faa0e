//! `platebench suite coverage` and `suite mutate`: show which lines of the firmware the scenarios
//! execute, and which mutants of its machine code they notice.

use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{OutputFormat, SCENARIOS, bench_law_names, job_count, parse_percent};
use crate::selection::{ScenarioFilter, find_scenarios};
use crate::shutdown::{EventSender, run_until_signal, unless_signalled};
use crate::stdio;
use clap::Args;
use platebench_document::Style;
use platebench_experiments::firmware_analysis::{
    CodeCoverage, CoverageConfig, FirmwareAnalysisError, FirmwareSuite, document as coverage_document, lcov_tracefile,
    measure_coverage,
};
use platebench_experiments::mutation::mutants::MutantFilter;
use platebench_experiments::mutation::{
    MutationConfig, MutationReport, document as mutation_document, measure_mutation, mutation_json,
};
use platebench_model::scenario::Scenario;
use platebench_model::trace::{AtPath, FileError, OutputFolder};
use platebench_report::Detail;
use platebench_rig::{CancelToken, RigSpec};
use std::io;
use std::path::{Path, PathBuf};

/// What both commands play.
#[derive(Debug, Args)]
struct FirmwareSuiteArgs {
    /// Scenario files, or folders with everything below them
    #[arg(value_name = "SCENARIO|FOLDER", default_value = SCENARIOS)]
    scenarios: Vec<PathBuf>,
    #[command(flatten)]
    tags: ScenarioFilter,
    /// Firmware image on the emulator: emulated | emulated:ELF
    #[arg(long, default_value = "emulated")]
    rig: RigSpec,
    /// Scenarios or mutants that run at once; default: one per core
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench suite coverage                                          every scenario below scenarios/
  platebench suite coverage scenarios/paper --lcov coverage.info
  platebench suite coverage --rig emulated:firmware.elf --only src/control --at-least 90

Exit codes: 0 measured, 1 fewer lines than --at-least were executed, 2 invalid input or a scenario
fails, 4 nothing to run, 5 the controller did not confirm 0 V")]
pub(super) struct CoverageArgs {
    #[command(flatten)]
    suite: FirmwareSuiteArgs,
    /// Only source files whose path contains this text; may be given again
    #[arg(long, value_name = "PATH")]
    only: Vec<String>,
    /// Write the coverage as LCOV tracefile, for genhtml; `-` is standard output
    #[arg(long, value_name = "FILE")]
    lcov: Option<PathBuf>,
    /// Fail if fewer lines were executed, %
    #[arg(long, value_name = "PERCENT", value_parser = parse_percent)]
    at_least: Option<f64>,
    /// Write coverage.txt and lcov.info to this folder
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
}

pub(super) fn coverage(arguments: &CoverageArgs, detail: Detail) -> CommandResult {
    let FirmwareSuiteArgs { scenarios, tags, rig, jobs } = &arguments.suite;
    let scenarios = find_scenarios(scenarios, tags, |_| true, detail)?;
    let (rig, only, jobs) = (rig.clone(), arguments.only.clone(), job_count(*jobs));
    let work = move |cancel: &CancelToken, _: &mut EventSender<()>| {
        let suite = FirmwareSuite::new(&rig, scenarios)?;
        let config = CoverageConfig { suite, jobs, only, cancel: cancel.clone() };
        measure_coverage(&config).map(|coverage| (coverage, config.suite.not_applicable))
    };
    let (coverage, not_applicable) = unless_signalled(run_until_signal(None, work, |()| {}))?;
    for reason in &not_applicable {
        stdio::note(&format!("not applicable: {reason}"));
    }
    let text = coverage_document(&coverage).to_console(None, Style::default());
    write_coverage(arguments, &coverage, &text)?;
    let uses_stdout = arguments.lcov.as_deref().is_some_and(stdio::is_stdout);
    stdio::show_beside(uses_stdout, &text);
    let Some(limit) = arguments.at_least else { return Ok(Exit::Passed) };
    let percent = coverage.line_ratio().percent();
    let exit = if percent >= limit { Exit::Passed } else { Exit::Failed };
    let format = if uses_stdout { OutputFormat::Json } else { OutputFormat::Human };
    exit.show_verdict(&format!("lines executed {percent:.2} %, expected at least {limit} %"), format);
    Ok(exit)
}

fn write_coverage(arguments: &CoverageArgs, coverage: &CodeCoverage, text: &str) -> Result<(), Failure> {
    let tracefile = lcov_tracefile(coverage);
    if let Some(path) = &arguments.lcov {
        stdio::write_output(path, &tracefile).or_invalid_at(path)?;
    }
    if let Some(folder) = &arguments.out {
        let folder = OutputFolder::create(folder).or_invalid()?;
        folder.write("lcov.info", &tracefile).or_invalid()?;
        folder.write("coverage.txt", text).or_invalid()?;
    }
    Ok(())
}

impl From<FirmwareAnalysisError> for Failure {
    fn from(error: FirmwareAnalysisError) -> Self {
        match error {
            FirmwareAnalysisError::NotSafe => Self::new(Exit::Unreachable, &error),
            error => Self::new(if error.is_invalid_input() { Exit::Invalid } else { Exit::Inconclusive }, &error),
        }
    }
}

/// Number of mutants between two lines of progress, which show in a log that the work continues.
const PROGRESS_INTERVAL: usize = 50;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench suite mutate --sample 200 --out runs/mutants
  platebench suite mutate --law dq-pi --until-width 5
  platebench suite mutate scenarios/paper --rig emulated:firmware.elf --function control_step --at-least 90

Exit codes: 0 measured, 1 the mutation score is below --at-least, 2 invalid input or a scenario
fails without mutants, 4 nothing to run, 5 the controller did not confirm 0 V")]
pub(super) struct MutateArgs {
    #[command(flatten)]
    suite: FirmwareSuiteArgs,
    /// Only scenarios with this control law
    #[arg(long, value_name = "NAME", value_parser = bench_law_names())]
    law: Option<String>,
    /// Functions whose name contains this text, also inlined ones; default: those that the control
    /// step executes
    #[arg(long, value_name = "NAME")]
    function: Vec<String>,
    /// Code of source files whose path contains this text
    #[arg(long, value_name = "PATH")]
    file: Vec<String>,
    /// Number of mutants, drawn at random; default: all
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    sample: Option<u32>,
    /// Stop once the 95 % interval of the score is so narrow, percentage points
    #[arg(long, value_name = "WIDTH", value_parser = parse_percent)]
    until_width: Option<f64>,
    /// Seed of the random order
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// Fail if the mutation score is lower, %
    #[arg(long, value_name = "PERCENT", value_parser = parse_percent)]
    at_least: Option<f64>,
    /// Write mutation.json and mutation.txt to this folder
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
}

pub(super) fn mutate(arguments: &MutateArgs, detail: Detail) -> CommandResult {
    let quiet = detail == Detail::Failures;
    let has_law = |scenario: &Scenario| arguments.law.as_ref().is_none_or(|law| scenario.controller.law == *law);
    let FirmwareSuiteArgs { scenarios, tags, rig, jobs } = &arguments.suite;
    let scenarios = find_scenarios(scenarios, tags, has_law, detail)?;
    let (rig, jobs) = (rig.clone(), job_count(*jobs));
    let filter = MutantFilter { functions: arguments.function.clone(), files: arguments.file.clone() };
    let (sample, until_width, seed) =
        (arguments.sample.map(|count| count as usize), arguments.until_width, arguments.seed);
    let work = move |cancel: &CancelToken, events: &mut EventSender<()>| {
        let suite = FirmwareSuite::new(&rig, scenarios)?;
        let config = MutationConfig { suite, filter, sample, until_width, seed, jobs, cancel: cancel.clone() };
        measure_mutation(&config, &mut |_| events.send(()))
    };
    let mut tested = 0;
    let ended = run_until_signal(None, work, |()| {
        tested += 1;
        if !quiet && tested % PROGRESS_INTERVAL == 0 {
            stdio::note(&format!("{tested} mutants tested"));
        }
    });
    let ((report, stop), signal) = match ended {
        (Ok(Ok(found)), signal) => (found, signal),
        ended => (unless_signalled(ended)?, None),
    };
    let text = mutation_document(&report).to_console(None, Style::default());
    if let Some(folder) = &arguments.out {
        write_mutation(&report, &text, folder).or_invalid_at(folder)?;
    }
    stdio::show(&text);
    if signal.is_some() || stop.is_some() {
        stdio::note(&format!("ended early, after {} mutants", report.results.len()));
    }
    match (signal, stop) {
        (Some(signal), _) => return Ok(Exit::Signal(signal)),
        (None, Some(error)) => return Err(error.into()),
        (None, None) => {}
    }
    let Some(limit) = arguments.at_least else { return Ok(Exit::Passed) };
    let percent = report.score().percent();
    let exit = if percent >= limit { Exit::Passed } else { Exit::Failed };
    exit.show_verdict(&format!("mutation score {percent:.2} %, expected at least {limit} %"), OutputFormat::Human);
    Ok(exit)
}

fn write_mutation(report: &MutationReport, text: &str, folder: &Path) -> Result<(), FileError> {
    let folder = OutputFolder::create(folder)?;
    let json = serde_json::to_string_pretty(&mutation_json(report)).map_err(io::Error::from).at(folder.path())?;
    folder.write("mutation.json", json)?;
    folder.write("mutation.txt", text)
}
