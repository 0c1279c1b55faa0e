//! `platebench chart`: measures speed against accuracy and writes one page of charts.

use crate::chart_page::write_page;
use crate::exit::Exit;
use crate::failure::{CommandResult, Failure, OrInvalid};
use crate::selection::note_skipped;
use crate::stdio;
use clap::Args;
use jiff::Timestamp;
use jiff::tz::TimeZone;
use platebench_model::scenario::{Scenario, find};
use platebench_report::Detail;
use platebench_rig::RigSpec;
use platebench_study::charts::{ChartError, ladder, laws, load_law_scenarios, precision, scenes};
use std::fs;
use std::path::{Path, PathBuf};

/// Number of measurements of a cost. The chart shows their median.
const COST_ROUNDS: u32 = 3;
/// For the methods chart: at resonance, detuned by 545 rad/s, detuned under 2 N, moving finger.
const DEFAULT_SCENARIOS: [&str; 4] = [
    "paper/fig13-closed-loop.toml",
    "paper/fig14-closed-loop.toml",
    "paper/fig16-closed-loop.toml",
    "paper/force-ramp.toml",
];

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench chart                                        all charts
  platebench chart scenarios/paper/setpoint-steps.toml --out /tmp/charts
  platebench chart --only laws                            control laws, and their table as laws.md

Exit codes: 0 drawn, 2 wrong usage or invalid input, 4 no scenario was found, 5 the controller was lost")]
pub(crate) struct ChartArgs {
    /// Scenario files or folders for methods and scenes; default: four scenarios of the paper for
    /// methods, all of a default run for scenes
    #[arg(value_name = "SCENARIO|FOLDER")]
    pub(crate) scenarios: Vec<PathBuf>,
    /// Folder for charts.html, drawings and numbers; default: a new folder below charts/
    #[arg(long, value_name = "FOLDER")]
    pub(crate) out: Option<PathBuf>,
    /// Fast and coarse: a quarter of the settings, measured once, over 5 ms; 4 trials with noise
    #[arg(long)]
    pub(crate) quick: bool,
    /// Only this chart; may be repeated
    #[arg(long, value_name = "CHART", value_enum)]
    pub(crate) only: Vec<ChartKind>,
    /// Rig to add to the ladder chart, in lockstep and in real time; may be repeated
    #[arg(long = "rig", value_name = "RIG")]
    pub(crate) rigs: Vec<RigSpec>,
    /// Folder of the default scenarios, with paper/ and laws/
    #[arg(long, value_name = "FOLDER", default_value = "scenarios")]
    pub(crate) scenes: PathBuf,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum ChartKind {
    /// Integration methods: error against cost
    Methods,
    /// Scenarios: what every model of the plate changes, and its cost
    Scenes,
    /// Control laws: response time against static error and repeatability
    Laws,
    /// Rungs from the linear plate to the emulated firmware: cost of a run against its difference
    Ladder,
}

impl From<ChartError> for Failure {
    fn from(error: ChartError) -> Self {
        match error {
            ChartError::Scenario(fault) => fault.into(),
            ChartError::Run(error) => error.into(),
            ChartError::Lost { .. } => Self::new(Exit::Unreachable, &error),
            error => Self::invalid(&error),
        }
    }
}

pub(crate) fn chart(arguments: &ChartArgs, detail: Detail) -> CommandResult {
    let is_selected = |kind| arguments.only.is_empty() || arguments.only.contains(&kind);
    let default = DEFAULT_SCENARIOS.map(|file| arguments.scenes.join(file));
    let methods = is_selected(ChartKind::Methods).then(|| find_scenarios(arguments, &default, detail)).transpose()?;
    let scenes = is_selected(ChartKind::Scenes)
        .then(|| find_scenarios(arguments, std::slice::from_ref(&arguments.scenes), detail))
        .transpose()?;
    let rungs = is_selected(ChartKind::Ladder)
        .then(|| find_scenarios(arguments, std::slice::from_ref(&arguments.scenes), detail))
        .transpose()?;
    let laws =
        is_selected(ChartKind::Laws).then(|| load_law_scenarios(&arguments.scenes, arguments.quick)).transpose()?;
    let now = || Timestamp::now().to_zoned(TimeZone::UTC).strftime("%Y%m%dT%H%M%SZ").to_string();
    let folder = arguments.out.clone().unwrap_or_else(|| Path::new("charts").join(now()));
    fs::create_dir_all(&folder).or_invalid_at(&folder)?;
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
    if let Some(scenarios) = laws {
        sections.push(laws::build_chart(&scenarios)?);
    }
    let (version, os, arch) = (env!("CARGO_PKG_VERSION"), std::env::consts::OS, std::env::consts::ARCH);
    let intro = format!("platebench {version} on {os} {arch}");
    let page = write_page(&folder, "charts.html", "Speed against accuracy", intro, &sections)?;
    for section in &sections {
        stdio::show(&format!("{}\n\n{}\n", section.title, section.summary));
    }
    stdio::note(&format!("page: {}", page.display()));
    Ok(Exit::Passed)
}

fn find_scenarios(arguments: &ChartArgs, default: &[PathBuf], detail: Detail) -> Result<Vec<Scenario>, Failure> {
    let named = if arguments.scenarios.is_empty() { default } else { &arguments.scenarios };
    let found = find(named)?;
    note_skipped(&found, detail);
    let scenarios = found.scenarios;
    if scenarios.is_empty() {
        return Err(Failure::new(
            Exit::NothingToRun,
            &"no scenario was found; name a scenario file or a folder with scenarios",
        ));
    }
    Ok(scenarios)
}

#[cfg(test)]
mod tests;
