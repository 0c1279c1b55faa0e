//! `platebench chart`: speed against accuracy, measured here and now and put onto one page.
//!
//! Each chart is a module of its own that returns blocks of the page and writes its files; [`Folder`] is where they go.

mod precision;

use crate::exit::Exit;
use crate::output;
use clap::Args;
use jiff::Timestamp;
use jiff::tz::TimeZone;
use platebench_report::ReportError;
use platebench_report::chart::Page;
use platebench_scenario::find;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Played where no scenario is named: a step at resonance, one detuned by 545 rad/s, that under 2 N, and a finger that comes down.
const DEFAULT: [&str; 4] = [
    "scenarios/paper/fig13-closed-loop.toml",
    "scenarios/paper/fig14-closed-loop.toml",
    "scenarios/paper/fig16-closed-loop.toml",
    "scenarios/paper/force-ramp.toml",
];

/// `platebench chart`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench chart                                        four of the paper's scenarios
  platebench chart scenarios/paper/setpoint-steps.toml --out /tmp/charts

Exit codes: 0 drawn, 2 wrong usage or invalid input, 5 a scenario could not be played")]
pub(crate) struct Chart {
    /// Scenario files, or folders with everything below them
    #[arg(value_name = "SCENARIO|FOLDER", default_values = DEFAULT)]
    pub(crate) scenarios: Vec<PathBuf>,
    /// Where charts.html, the drawings and the figures go; a new folder below charts/ where not given
    #[arg(long, value_name = "FOLDER")]
    pub(crate) out: Option<PathBuf>,
    /// A quarter of the settings, measured once, over 5 ms: for a first look
    #[arg(long)]
    pub(crate) quick: bool,
}

/// Why there is no chart.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ChartError {
    #[error("{file}: {why}")]
    NotPlayed { file: String, why: String },
    #[error(transparent)]
    Report(#[from] ReportError),
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: io::Error },
}

/// Where the files of all charts go.
#[derive(Debug)]
pub(crate) struct Folder(PathBuf);

impl Folder {
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

/// Measures, draws and says what came of it.
pub(crate) fn chart(arguments: &Chart) -> Exit {
    let found = match find(&arguments.scenarios) {
        Ok(found) => found,
        Err(faults) => {
            faults.iter().for_each(output::diagnostic);
            return Exit::Invalid;
        }
    };
    if found.scenarios.is_empty() {
        output::error("there is nothing to run");
        return Exit::Nothing;
    }
    let drawn = Folder::create(arguments.out.as_deref()).and_then(|folder| {
        let precision = precision::chart(&found.scenarios, arguments.quick, &folder)?;
        let page = Page {
            title: "Speed against accuracy".to_owned(),
            lead: format!(
                "platebench {} on {} {}",
                env!("CARGO_PKG_VERSION"),
                std::env::consts::OS,
                std::env::consts::ARCH
            ),
            blocks: precision.blocks,
        };
        page.write(&folder.0)?;
        Ok((precision.summary, folder.0.join(Page::FILE)))
    });
    match drawn {
        Ok((summary, page)) => {
            output::show(&summary);
            output::note(&format!("page: {}", page.display()));
            Exit::Passed
        }
        Err(error) => {
            output::error(&error.to_string());
            match error {
                ChartError::NotPlayed { .. } => Exit::Unreachable,
                ChartError::Report(_) | ChartError::Io { .. } => Exit::Invalid,
            }
        }
    }
}

#[cfg(test)]
mod tests;
