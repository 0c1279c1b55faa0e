//! `platebench suite coverage`: shows which lines of the firmware the scenarios execute.

use crate::exit::Exit;
use crate::failure::{CommandResult, Failure, OrInvalid};
use crate::options::{OutputFormat, SCENARIOS, job_count, parse_percent};
use crate::selection::{TagFilter, find_scenarios};
use crate::shutdown::{EventSender, run_until_signal, unless_signalled};
use crate::stdio;
use clap::Args;
use platebench_experiments::firmware_analysis::{
    AnalysisError, Coverage, CoverageConfig, Suite, document, lcov_tracefile, measure_coverage,
};
use platebench_model::trace::write_atomically;
use platebench_report::{Detail, Style};
use platebench_rig::{CancelToken, RigSpec};
use std::fs;
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench suite coverage                                          every scenario below scenarios/
  platebench suite coverage scenarios/paper --lcov coverage.info
  platebench suite coverage --rig emulated:firmware.elf --only src/control --at-least 90

Exit codes: 0 measured, 1 fewer lines than --at-least were executed, 2 invalid input or a scenario fails")]
pub(super) struct CoverageArgs {
    /// Scenario files, or folders with everything below them
    #[arg(value_name = "SCENARIO|FOLDER", default_value = SCENARIOS)]
    scenarios: Vec<PathBuf>,
    #[command(flatten)]
    tags: TagFilter,
    /// Firmware image on the emulator: emulated | emulated:ELF
    #[arg(long, default_value = "emulated")]
    rig: RigSpec,
    /// Only source files whose path contains this text; may be given again
    #[arg(long, value_name = "PATH")]
    only: Vec<String>,
    /// Write the coverage as LCOV tracefile, for genhtml
    #[arg(long, value_name = "FILE")]
    lcov: Option<PathBuf>,
    /// Fail if fewer lines were executed, %
    #[arg(long, value_name = "PERCENT", value_parser = parse_percent)]
    at_least: Option<f64>,
    /// Scenarios that run at once; default: one per core
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
    /// Write coverage.txt and lcov.info to this folder
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
}

pub(super) fn coverage(arguments: &CoverageArgs, detail: Detail) -> CommandResult {
    let scenarios = find_scenarios(&arguments.scenarios, &arguments.tags, |_| true, detail)?;
    let (rig, only, jobs) = (arguments.rig.clone(), arguments.only.clone(), job_count(arguments.jobs));
    let work = move |cancel: &CancelToken, _: &mut EventSender<()>| {
        let suite = Suite::new(&rig, scenarios)?;
        let config = CoverageConfig { suite, jobs, only, cancel: cancel.clone() };
        measure_coverage(&config).map(|coverage| (coverage, config.suite.not_applicable))
    };
    let (coverage, not_applicable) = unless_signalled(run_until_signal(None, work, |()| {}))?;
    for reason in &not_applicable {
        stdio::note(&format!("not applicable: {reason}"));
    }
    let text = document(&coverage).to_console(None, Style::default());
    write_files(arguments, &coverage, &text)?;
    stdio::show(&text);
    let Some(limit) = arguments.at_least else { return Ok(Exit::Passed) };
    let percent = coverage.line_ratio().percent();
    let exit = if percent >= limit { Exit::Passed } else { Exit::Failed };
    stdio::verdict(exit, &format!("lines executed {percent:.2} %, expected at least {limit} %"), OutputFormat::Human);
    Ok(exit)
}

fn write_files(arguments: &CoverageArgs, coverage: &Coverage, text: &str) -> Result<(), Failure> {
    let tracefile = lcov_tracefile(coverage);
    let write = |path: &Path, text: &str| write_atomically(path, text.as_bytes()).or_invalid_at(path);
    if let Some(path) = &arguments.lcov {
        write(path, &tracefile)?;
    }
    if let Some(folder) = &arguments.out {
        fs::create_dir_all(folder).or_invalid_at(folder)?;
        write(&folder.join("lcov.info"), &tracefile)?;
        write(&folder.join("coverage.txt"), text)?;
    }
    Ok(())
}

impl From<AnalysisError> for Failure {
    fn from(error: AnalysisError) -> Self {
        match error {
            AnalysisError::NotSafe => Self::new(Exit::Unreachable, &error),
            error => Self::new(if error.is_invalid_input() { Exit::Invalid } else { Exit::Inconclusive }, &error),
        }
    }
}
