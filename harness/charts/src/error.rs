//! Defines the errors of charts.

use platebench_engine::RunError;
use platebench_model::record::FolderError;
use platebench_model::scenario::Diagnostic;
use platebench_rig::RigError;
use std::io;

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
}

impl From<Diagnostic> for ChartError {
    fn from(diagnostic: Diagnostic) -> Self {
        Self::Scenario(Box::new(diagnostic))
    }
}
