//! `platebench suite`: measures how well the scenarios find faults, and searches for new ones.

mod explore;
#[cfg(feature = "analysis")]
mod firmware;

use crate::exit::{CommandResult, Exit, OrInvalid};
use crate::options::{OutputFormat, SCENARIOS, job_count};
use crate::selection::{ScenarioFilter, find_scenarios};
use crate::stdio;
use clap::{Args, Subcommand};
use platebench_document::format::count;
use platebench_experiments::explore::Envelope;
use platebench_experiments::explore::kill_rate::{KillRateConfig, KillRateReport, kill_rate};
use platebench_experiments::trust::report::{document, matrix};
use platebench_experiments::trust::{TrustConfig, TrustReport, catalogue, clean_variants, measure, protocol_faults};
use platebench_model::record::Verdict;
use platebench_model::trace::{AtPath, FileError, OutputFolder};
use platebench_report::Detail;
use platebench_rig::CancelToken;
use serde::Serialize;
use std::io;
use std::path::PathBuf;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench suite trust
  platebench suite coverage scenarios/paper --lcov coverage.info
  platebench suite mutate --sample 200 --out runs/mutants
  platebench suite explore --for 10m")]
pub(crate) struct SuiteArgs {
    #[command(subcommand)]
    action: SuiteAction,
}

#[derive(Debug, Subcommand)]
enum SuiteAction {
    /// Measure how well the scenarios catch faulty controllers: kill rate, false-alarm rate
    Trust(TrustArgs),
    /// Show which lines of the firmware the scenarios execute (emulated rig)
    #[cfg(feature = "analysis")]
    Coverage(firmware::CoverageArgs),
    /// Change the firmware's machine code and check whether the scenarios notice (emulated rig)
    #[cfg(feature = "analysis")]
    Mutate(firmware::MutateArgs),
    /// Generate scenes from an operating envelope, check properties and reduce what fails to a
    /// minimal scenario
    Explore(explore::ExploreArgs),
}

pub(crate) fn suite(arguments: &SuiteArgs, detail: Detail) -> CommandResult {
    match &arguments.action {
        SuiteAction::Trust(arguments) => trust(arguments, detail),
        #[cfg(feature = "analysis")]
        SuiteAction::Coverage(arguments) => firmware::coverage(arguments, detail),
        #[cfg(feature = "analysis")]
        SuiteAction::Mutate(arguments) => firmware::mutate(arguments, detail),
        SuiteAction::Explore(arguments) => explore::explore(arguments, detail),
    }
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench suite trust                          every scenario below scenarios/ without `only_if_named`
  platebench suite trust --clean 30000 --seed 7 --out /tmp/trust
  platebench suite trust scenarios/faults --clean 0
  platebench suite trust --scenes 2000            the kill rate of platebench suite explore as well

Exit codes: 0 the scenarios killed every mutant for the right reason without a false alarm, and no generated
scene blamed a correct controller; 1 otherwise. Protocol faults do not change it.")]
struct TrustArgs {
    /// Scenario files, or folders with everything below them
    #[arg(value_name = "SCENARIO|FOLDER", default_value = SCENARIOS)]
    scenarios: Vec<PathBuf>,
    #[command(flatten)]
    tags: ScenarioFilter,
    /// Number of clean runs; each plays one scenario, in turn, with its own plate and noise
    #[arg(long, value_name = "N", default_value_t = 3_000)]
    clean: u32,
    /// Seed of the first clean run
    #[arg(long, value_name = "S", default_value_t = 31_415)]
    seed: u64,
    /// Also explore every mutant with this number of generated scenes, and every correct controller
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=10_000_000))]
    scenes: Option<u64>,
    /// The operating envelope of the generated scenes
    #[arg(long, value_name = "FILE", default_value = "scenarios/envelope.toml")]
    envelope: PathBuf,
    /// Scenarios that run at once; default: one per core
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
    /// Write trust.json, matrix.md and exploration.json to this folder
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
}

fn trust(arguments: &TrustArgs, detail: Detail) -> CommandResult {
    let config = TrustConfig {
        scenarios: find_scenarios(&arguments.scenarios, &arguments.tags, |_| true, detail)?,
        mutants: catalogue(),
        protocol_faults: protocol_faults(),
        variants: clean_variants(),
        clean_runs: arguments.clean,
        seed: arguments.seed,
        jobs: job_count(arguments.jobs),
    };
    let envelope = arguments.scenes.map(|_| Envelope::load(&arguments.envelope)).transpose()?;
    let report = measure(&config).or_invalid()?;
    let exploration = arguments.scenes.zip(envelope).map(|(scenes, envelope)| KillRateConfig {
        envelope,
        mutants: catalogue(),
        protocol_faults: protocol_faults(),
        variants: clean_variants(),
        scenes,
        seed: arguments.seed,
        jobs: job_count(arguments.jobs),
    });
    let exploration = exploration.map(|config| kill_rate(&config, &CancelToken::never())).transpose().or_invalid()?;
    if let Some(folder) = &arguments.out {
        let folder = OutputFolder::create(folder).or_invalid()?;
        write_report(&report, exploration.as_ref(), &folder).or_invalid()?;
    }
    let mut document = document(&report);
    document.blocks.extend(exploration.as_ref().map(|exploration| exploration.block(&report)));
    let blames = exploration.map_or(0, |exploration| exploration.alarms.len());
    let exit = Exit::of_verdict(if blames > 0 { Verdict::Fail } else { report.verdict });
    if exit.is_hidden(detail == Detail::Failures, arguments.format) {
        return Ok(exit);
    }
    stdio::show_result(arguments.format, &report, &document);
    let caught =
        format!("{} of {} mutants were caught for the right reason", report.kill_rate.seen, report.kill_rate.count);
    let protocol = report.protocol_faults.kill_rate;
    let alarms = format!("{}, {} in generated scenes", count(report.clean.alarms.len(), "false alarm"), blames);
    let protocol = format!("{} of {} protocol faults", protocol.seen, protocol.count);
    exit.show_verdict(&format!("{caught}, {protocol}; {alarms}"), arguments.format);
    Ok(exit)
}

fn write_report(
    report: &TrustReport,
    exploration: Option<&KillRateReport>,
    folder: &OutputFolder,
) -> Result<(), FileError> {
    if let Some(exploration) = exploration {
        folder.write("exploration.json", json(exploration, folder)?)?;
    }
    folder.write("trust.json", json(report, folder)?)?;
    folder.write("matrix.md", matrix(report))
}

fn json(report: &impl Serialize, folder: &OutputFolder) -> Result<String, FileError> {
    serde_json::to_string_pretty(report).map_err(io::Error::from).at(folder.path())
}
