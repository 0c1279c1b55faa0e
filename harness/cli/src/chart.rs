//! `platebench chart`: speed against accuracy, measured here and now and put onto one page.
//!
//! Each chart is a module of its own that returns blocks of the page and writes its files; [`Folder`] is where they go.
//!
//! * `precision`: integration methods, error against cost.
//! * `scenes`: scenarios, every model of the plate against the exact one.
//! * `laws`: control laws, response time against static error and repeatability.

mod laws;
mod model_tiers;
mod precision;

use crate::exit::Exit;
use crate::stdio;
use clap::Args;
use jiff::Timestamp;
use jiff::tz::TimeZone;
use platebench_report::ReportError;
use platebench_report::page::{BlockPage, PageBlock};
use platebench_scenario::{Diagnostic, Scenario, find};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Below the folder of scenes; played where no scenario is named: a step at resonance, one detuned by 545 rad/s, that under 2 N, and a finger that comes down.
const DEFAULT_SCENARIOS: [&str; 4] = [
    "paper/fig13-closed-loop.toml",
    "paper/fig14-closed-loop.toml",
    "paper/fig16-closed-loop.toml",
    "paper/force-ramp.toml",
];

/// `platebench chart`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench chart                                        methods on four of the paper's scenarios, plates for all, laws
  platebench chart scenarios/paper/setpoint-steps.toml --out /tmp/charts
  platebench chart --only laws                            control laws side by side, and their table as laws.md

Exit codes: 0 drawn, 2 wrong usage or invalid input, 4 there was nothing to run, 5 a scenario could not be played")]
pub(crate) struct ChartArgs {
    /// Scenario files, or folders with everything below them, for methods and scenes; where not given four of the paper's for methods, all of a default run for scenes
    #[arg(value_name = "SCENARIO|FOLDER")]
    pub(crate) scenarios: Vec<PathBuf>,
    /// Where charts.html, the drawings and the figures go; a new folder below charts/ where not given
    #[arg(long, value_name = "FOLDER")]
    pub(crate) out: Option<PathBuf>,
    /// A quarter of the settings, measured once, over 5 ms, and 4 trials behind noise: for a first look
    #[arg(long)]
    pub(crate) quick: bool,
    /// This chart alone; may be repeated
    #[arg(long, value_name = "CHART", value_enum)]
    pub(crate) only: Vec<ChartKind>,
    /// The folder with paper/ and laws/, from which scenes come that are not named
    #[arg(long, value_name = "FOLDER", default_value = "scenarios")]
    pub(crate) scenes: PathBuf,
}

/// The charts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum ChartKind {
    /// Integration methods: error against cost
    Methods,
    /// Scenarios: every model of the plate against the exact one
    Scenes,
    /// Control laws: response time against static error and repeatability
    Laws,
}

/// Why there is no chart.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ChartError {
    #[error("{file}: {why}")]
    NotPlayed { file: String, why: String },
    #[error("scenarios cannot be meant")]
    Scenarios(Vec<Diagnostic>),
    #[error("there is nothing to run")]
    Nothing,
    #[error(transparent)]
    Report(#[from] ReportError),
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: io::Error },
}

/// Where the files of all charts go.
#[derive(Debug)]
pub(crate) struct ChartFolder(PathBuf);

impl ChartFolder {
    fn create(path: Option<&Path>) -> Result<Self, ChartError> {
        let now = Timestamp::now().to_zoned(TimeZone::UTC).strftime("%Y%m%dT%H%M%SZ").to_string();
        let path = path.map_or_else(|| Path::new("charts").join(now), Path::to_owned);
        fs::create_dir_all(&path).map_err(|source| ChartError::Io { path: path.clone(), source })?;
        Ok(Self(path))
    }

    /// Writes a file of this name.
    pub(crate) fn write(&self, name: &str, text: &str) -> Result<(), ChartError> {
        let path = self.0.join(name);
        fs::write(&path, text).map_err(|source| ChartError::Io { path, source })
    }
}

/// The page of all charts.
const PAGE: &str = "charts.html";

/// What a chart adds to the page, and to the console.
pub(crate) struct ChartSection {
    pub(crate) blocks: Vec<PageBlock>,
    pub(crate) summary: String,
}

/// Measures, draws and says what came of it.
pub(crate) fn chart(arguments: &ChartArgs) -> Exit {
    match write_charts(arguments) {
        Ok((summary, page)) => {
            stdio::show(&summary);
            stdio::note(&format!("page: {}", page.display()));
            Exit::Passed
        }
        Err(error) => {
            match &error {
                ChartError::Scenarios(faults) => faults.iter().for_each(stdio::diagnostic),
                other => stdio::error(&other.to_string()),
            }
            match error {
                ChartError::NotPlayed { .. } => Exit::Unreachable,
                ChartError::Nothing => Exit::NothingToRun,
                ChartError::Scenarios(_) | ChartError::Report(_) | ChartError::Io { .. } => Exit::Invalid,
            }
        }
    }
}

/// The charts that were asked for, on the console and on a page.
fn write_charts(arguments: &ChartArgs) -> Result<(String, PathBuf), ChartError> {
    let asked = |which| arguments.only.is_empty() || arguments.only.contains(&which);
    // Everything is read before anything is written or played.
    let of_methods = DEFAULT_SCENARIOS.map(|file| arguments.scenes.join(file));
    let of_methods = asked(ChartKind::Methods).then(|| find_scenarios(arguments, &of_methods)).transpose()?;
    let of_scenes = asked(ChartKind::Scenes)
        .then(|| find_scenarios(arguments, std::slice::from_ref(&arguments.scenes)))
        .transpose()?;
    let of_laws =
        asked(ChartKind::Laws).then(|| laws::load_law_scenarios(&arguments.scenes, arguments.quick)).transpose()?;
    let folder = ChartFolder::create(arguments.out.as_deref())?;
    let mut charts = Vec::new();
    if let Some(scenarios) = of_methods {
        charts.push(("Methods: error against cost", precision::build_chart(&scenarios, arguments.quick, &folder)?));
    }
    if let Some(scenarios) = of_scenes {
        charts.push((
            "Scenarios: models of the plate against the exact one",
            model_tiers::build_chart(&scenarios, &folder)?,
        ));
    }
    if let Some(scenes) = of_laws {
        charts.push(("Control laws: speed and accuracy of what is under test", laws::build_chart(&scenes, &folder)?));
    }
    let (mut summary, mut blocks) = (String::new(), Vec::new());
    for (title, chart) in charts {
        summary.extend([title, "\n\n", &chart.summary, "\n"]);
        blocks.push(PageBlock::Heading(title.to_owned()));
        blocks.extend(chart.blocks);
    }
    let page = BlockPage {
        title: "Speed against accuracy".to_owned(),
        intro: format!(
            "platebench {} on {} {}",
            env!("CARGO_PKG_VERSION"),
            std::env::consts::OS,
            std::env::consts::ARCH
        ),
        blocks,
    };
    let path = folder.0.join(PAGE);
    page.write(&path)?;
    Ok((summary, path))
}

/// The scenarios that the command line names; those of `default` where it names none.
fn find_scenarios(arguments: &ChartArgs, default: &[PathBuf]) -> Result<Vec<Scenario>, ChartError> {
    let named = if arguments.scenarios.is_empty() { default } else { &arguments.scenarios };
    let found = find(named).map_err(ChartError::Scenarios)?;
    if found.scenarios.is_empty() { Err(ChartError::Nothing) } else { Ok(found.scenarios) }
}

/// A field of CSV that may hold commas.
fn quote_csv_field(text: &str) -> String {
    format!("\"{}\"", text.replace('"', "\"\""))
}

/// `1 scenario`, `2 scenarios`.
fn format_count(count: usize, thing: &str) -> String {
    format!("{count} {thing}{}", if count == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests;
