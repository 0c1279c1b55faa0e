//! Defines why a recording cannot be replayed.

use crate::plan::RunError;
use crate::rejudge::RejudgeError;
use platebench_model::external_csv::ExternalCsvError;
use platebench_model::record::RecordError;
use platebench_model::scenario::Diagnostic;
use platebench_model::trace::{FileError, TraceError};
use std::path::PathBuf;

#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    #[error("{0}")]
    Scenario(Box<Diagnostic>),
    #[error(transparent)]
    Record(#[from] RecordError),
    #[error(transparent)]
    Stored(#[from] RejudgeError),
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error(transparent)]
    Telemetry(#[from] ExternalCsvError),
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{}: expected a trace, such as RUN/traces/SCENARIO/000.csv; this is a folder", .0.display())]
    Folder(PathBuf),
    #[error(
        "{}: no run folder contains this trace, expected --scenario FILE with its law and configuration",
        .0.display()
    )]
    NoRun(PathBuf),
    #[error("{}: no row is a sample that the controller answered, expected at least one", .0.display())]
    NoSample(PathBuf),
    #[error(
        "{}: the first two samples are {found_ms:.3} ms apart, expected the period of the scenario, {expected_ms:.3} \
         ms",
        path.display()
    )]
    OtherPeriod { path: PathBuf, found_ms: f64, expected_ms: f64 },
    #[error(
        "{}: no setpoint at {at_s} s, because the scenario ends at {duration_s} s; expected a column setpoint",
        path.display()
    )]
    NoSetpoint { path: PathBuf, duration_s: f64, at_s: f64 },
    #[error("this controller cannot play the recording: {0}")]
    NotApplicable(String),
    #[error(transparent)]
    Run(#[from] RunError),
}

impl From<Diagnostic> for ReplayError {
    fn from(diagnostic: Diagnostic) -> Self {
        Self::Scenario(Box::new(diagnostic))
    }
}
