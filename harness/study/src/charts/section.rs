//! Defines the content of a chart and the errors of charts.

use crate::loops::AnalysisError;
use platebench_engine::RunError;
use platebench_engine::trial::{self, TrialResult};
use platebench_model::record::FolderError;
use platebench_model::scenario::{Diagnostic, Scenario};
use platebench_report::ReportError;
use platebench_report::page::PageBlock;
use platebench_report::text::Table;
use platebench_rig::RigError;
use platebench_wire::LawId;
use std::io;

#[derive(Debug, Clone, PartialEq)]
pub struct ChartSection {
    pub title: &'static str,
    pub summary: String,
    pub blocks: Vec<PageBlock>,
    /// Name and content of each file.
    pub files: Vec<(String, String)>,
}

impl ChartSection {
    pub(crate) fn paragraphs(texts: &[&str]) -> Vec<PageBlock> {
        texts.iter().map(|text| PageBlock::Text((*text).to_owned())).collect()
    }

    pub(crate) fn indented(table: &Table) -> String {
        table.lines().iter().flat_map(|line| ["  ", line, "\n"]).collect()
    }
}

#[derive(Debug, thiserror::Error)]
pub enum ChartError {
    #[error("invalid scenario")]
    Scenario(Box<Diagnostic>),
    #[error("{0}: the setpoint is never above 0, so relative errors are undefined; expected a setpoint above 0")]
    NoSetpoint(String),
    #[error("{what}: {source}")]
    Lost {
        /// Scenario and law.
        what: String,
        source: RigError,
    },
    #[error(transparent)]
    Run(#[from] RunError),
    #[error("temporary folder of the charts: {0}")]
    Temporary(#[from] io::Error),
    #[error(transparent)]
    Folder(#[from] FolderError),
    #[error(transparent)]
    Analysis(#[from] AnalysisError),
    #[error(transparent)]
    Report(#[from] ReportError),
}

impl From<Diagnostic> for ChartError {
    fn from(diagnostic: Diagnostic) -> Self {
        Self::Scenario(Box::new(diagnostic))
    }
}

pub(crate) fn play_hosted(what: &str, scenario: &Scenario, law: LawId, index: u32) -> Result<TrialResult, ChartError> {
    let lost = |source| ChartError::Lost { what: what.to_owned(), source };
    let mut played = trial::play_hosted(scenario, law, index).map_err(lost)?;
    played.link_error.take().map_or(Ok(played), |error| Err(lost(error)))
}
