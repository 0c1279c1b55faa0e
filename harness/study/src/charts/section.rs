//! Defines what a chart returns, and why there is none.

use crate::loops::AnalysisError;
use platebench_record::FolderError;
use platebench_report::ReportError;
use platebench_report::page::PageBlock;
use platebench_rig::RigError;
use platebench_runner::RunError;
use platebench_runner::trial::{self, TrialResult};
use platebench_scenario::{Diagnostic, Scenario};
use platebench_wire::LawId;
use std::io;

/// A chart: a part of a page, and files.
#[derive(Debug, Clone, PartialEq)]
pub struct ChartSection {
    /// Its heading.
    pub title: &'static str,
    /// Text for a terminal.
    pub summary: String,
    /// Blocks of the page.
    pub blocks: Vec<PageBlock>,
    /// Name and content of each file.
    pub files: Vec<(String, String)>,
}

/// Why there is no chart.
#[derive(Debug, thiserror::Error)]
pub enum ChartError {
    /// A scenario file cannot be read, or has an unknown law.
    #[error("invalid scenario")]
    Scenario(Box<Diagnostic>),
    /// Errors relative to the setpoint are not defined.
    #[error("{0}: the setpoint is never above 0, so relative errors are undefined; expected a setpoint above 0")]
    NoSetpoint(String),
    /// The controller was lost.
    #[error("{what}: {source}")]
    Lost {
        /// What was played.
        what: String,
        /// The reason.
        source: RigError,
    },
    /// A run has no record.
    #[error(transparent)]
    Run(#[from] RunError),
    /// A temporary folder cannot be created.
    #[error("temporary folder: {0}")]
    Temporary(#[from] io::Error),
    /// A run folder cannot be created.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// A loop cannot be analysed.
    #[error(transparent)]
    Analysis(#[from] AnalysisError),
    /// A drawing cannot be made.
    #[error(transparent)]
    Report(#[from] ReportError),
}

impl From<Diagnostic> for ChartError {
    fn from(diagnostic: Diagnostic) -> Self {
        Self::Scenario(Box::new(diagnostic))
    }
}

/// Plays a trial on the hosted rig to its end; `what` names it in an error.
pub(crate) fn play_hosted(what: &str, scenario: &Scenario, law: LawId, index: u32) -> Result<TrialResult, ChartError> {
    let lost = |source| ChartError::Lost { what: what.to_owned(), source };
    let mut played = trial::play_hosted(scenario, law, index).map_err(lost)?;
    played.link_error.take().map_or(Ok(played), |error| Err(lost(error)))
}
