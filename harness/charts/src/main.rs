//! `cargo charts`: measures speed against accuracy and writes one page of charts.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

use clap::Parser;
use jiff::Timestamp;
use jiff::tz::TimeZone;
use platebench_charts::bench::BenchConfig;
use platebench_charts::{ChartError, bench, ladder, laws, load_law_scenarios, precision, scenes};
use platebench_document::Style;
use platebench_document::write_chart_page;
use platebench_engine::RunError;
use platebench_model::printable::printable_lines;
use platebench_model::scenario::{Diagnostic, Scenario, find};
use platebench_model::trace::create_folder;
use platebench_rig::RigSpec;
use std::fmt::Display;
use std::io::{IsTerminal, Write, stderr, stdout};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Number of measurements of a cost. The chart shows their median.
const COST_ROUNDS: u32 = 3;
/// For the methods chart: at resonance, detuned by 545 rad/s, detuned under 2 N, moving finger.
const DEFAULT_SCENARIOS: [&str; 4] = [
    "paper/fig13-closed-loop.toml",
    "paper/fig14-closed-loop.toml",
    "paper/fig16-closed-loop.toml",
    "paper/force-ramp.toml",
];

/// Chart speed against accuracy of plant methods, models and laws
#[derive(Debug, Parser)]
#[command(name = "platebench-charts", bin_name = "cargo charts", version)]
#[command(after_help = "\
Examples:
  cargo charts                                        all charts
  cargo charts scenarios/paper/setpoint-steps.toml --out /tmp/charts
  cargo charts --only laws                            control laws, and their table as laws.md

Exit codes: 0 drawn, 2 wrong usage or invalid input, 4 no scenario was found, 5 the controller was lost")]
struct Arguments {
    /// Scenario files or folders for methods and scenes; default: four scenarios of the paper for
    /// methods, all of a default run for scenes
    #[arg(value_name = "SCENARIO|FOLDER")]
    scenarios: Vec<PathBuf>,
    /// Folder for charts.html, drawings and numbers; default: a new folder below charts/
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Fast and coarse: a quarter of the settings, measured once, over 5 ms; 4 trials with noise
    #[arg(long)]
    quick: bool,
    /// Only this chart; may be repeated
    #[arg(long, value_name = "CHART", value_enum)]
    only: Vec<ChartKind>,
    /// Rig to add to the ladder chart, in lockstep and in real time; may be repeated
    #[arg(long = "rig", value_name = "RIG")]
    rigs: Vec<RigSpec>,
    /// Python with numpy, for the chart of the bench
    #[arg(long, value_name = "PROGRAM", default_value = "python3")]
    python: PathBuf,
    /// Folder of the default scenarios, with paper/ and laws/
    #[arg(long, value_name = "FOLDER", default_value = "scenarios")]
    scenes: PathBuf,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum ChartKind {
    /// Integration methods: error against cost
    Methods,
    /// Scenarios: what every model of the plate changes, and its cost
    Scenes,
    /// Control laws: response time against static error and repeatability
    Laws,
    /// Rungs from the linear plate to the emulated firmware: cost of a run against its difference
    Ladder,
    /// Rigs, plate models, general integrators and numpy: error of a settling time against cost
    Bench,
}

const CONSOLE_WIDTH: usize = 100;

/// What the program reports and its exit code, as those of `platebench`.
#[derive(Debug)]
struct Failure {
    exit: u8,
    report: String,
}

impl Failure {
    const INVALID: u8 = 2;
    const NOTHING_TO_DRAW: u8 = 4;
    const UNREACHABLE: u8 = 5;

    fn new(exit: u8, message: &impl Display) -> Self {
        Self { exit, report: format!("error: {}", printable_lines(&message.to_string())) }
    }
}

impl From<Vec<Diagnostic>> for Failure {
    fn from(problems: Vec<Diagnostic>) -> Self {
        let is_terminal = stderr().is_terminal();
        let reports: Vec<String> = problems.iter().map(|problem| problem.render(is_terminal)).collect();
        Self { exit: Self::INVALID, report: reports.join("\n\n") }
    }
}

impl From<ChartError> for Failure {
    fn from(error: ChartError) -> Self {
        let exit = match error {
            ChartError::Scenario(problem) | ChartError::Run(RunError::Scenario(problem)) => {
                return vec![*problem].into();
            }
            ChartError::Run(RunError::Connect(ref problem)) if problem.is_invalid_input() => Self::INVALID,
            ChartError::Lost { .. } | ChartError::Run(RunError::Connect(_) | RunError::Rig(_)) => Self::UNREACHABLE,
            _ => Self::INVALID,
        };
        Self::new(exit, &error)
    }
}

fn main() -> ExitCode {
    let Err(failure) = draw(&Arguments::parse()) else { return ExitCode::SUCCESS };
    let _ = writeln!(stderr(), "{}", failure.report);
    failure.exit.into()
}

fn draw(arguments: &Arguments) -> Result<(), Failure> {
    let is_selected = |kind| arguments.only.is_empty() || arguments.only.contains(&kind);
    let default = DEFAULT_SCENARIOS.map(|file| arguments.scenes.join(file));
    let methods = is_selected(ChartKind::Methods).then(|| find_scenarios(arguments, &default)).transpose()?;
    let scenes = is_selected(ChartKind::Scenes)
        .then(|| find_scenarios(arguments, std::slice::from_ref(&arguments.scenes)))
        .transpose()?;
    let rungs = is_selected(ChartKind::Ladder)
        .then(|| find_scenarios(arguments, std::slice::from_ref(&arguments.scenes)))
        .transpose()?;
    let settling = is_selected(ChartKind::Bench)
        .then(|| find_scenarios_in(&[arguments.scenes.join(bench::SCENARIO)]))
        .transpose()?;
    let laws =
        is_selected(ChartKind::Laws).then(|| load_law_scenarios(&arguments.scenes, arguments.quick)).transpose()?;
    let now = || Timestamp::now().to_zoned(TimeZone::UTC).strftime("%Y%m%dT%H%M%SZ").to_string();
    let folder = arguments.out.clone().unwrap_or_else(|| Path::new("charts").join(now()));
    create_folder(&folder)
        .map_err(|error| Failure::new(Failure::INVALID, &format!("{}: {error}", folder.display())))?;
    let rounds = if arguments.quick { 1 } else { COST_ROUNDS };
    let mut sections = Vec::new();
    if let Some(scenarios) = methods {
        sections.push(precision::build_chart(&scenarios, arguments.quick)?);
    }
    if let Some(scenarios) = scenes {
        sections.push(scenes::build_chart(&scenarios, rounds)?);
    }
    if let Some(scenarios) = rungs {
        sections.push(ladder::build_chart(&scenarios, rounds, &arguments.rigs)?);
    }
    for scenario in settling.iter().flatten() {
        let python = &arguments.python;
        let config = if arguments.quick { BenchConfig::quick(python) } else { BenchConfig::new(rounds, python) };
        sections.push(bench::build_chart(scenario, &config)?);
    }
    if let Some(scenarios) = laws {
        sections.push(laws::build_chart(&scenarios)?);
    }
    let (version, os, arch) = (env!("CARGO_PKG_VERSION"), std::env::consts::OS, std::env::consts::ARCH);
    let intro = format!("platebench {version} on {os} {arch}");
    let page = write_chart_page(&folder, "charts.html", "Speed against accuracy", intro, &sections)
        .map_err(|error| Failure::new(Failure::INVALID, &error))?;
    for section in &sections {
        let _ = writeln!(
            stdout(),
            "{}\n\n{}",
            section.document.title,
            section.document.to_console(Some(CONSOLE_WIDTH), Style::default())
        );
    }
    let _ = writeln!(stderr(), "page: {}", page.display());
    Ok(())
}

fn find_scenarios(arguments: &Arguments, default: &[PathBuf]) -> Result<Vec<Scenario>, Failure> {
    find_scenarios_in(if arguments.scenarios.is_empty() { default } else { &arguments.scenarios })
}

fn find_scenarios_in(named: &[PathBuf]) -> Result<Vec<Scenario>, Failure> {
    let scenarios = find(named)?.scenarios;
    if scenarios.is_empty() {
        let message = "no scenario was found; name a scenario file or a folder with scenarios";
        return Err(Failure::new(Failure::NOTHING_TO_DRAW, &message));
    }
    Ok(scenarios)
}

#[cfg(test)]
mod tests;
