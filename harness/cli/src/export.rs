//! `platebench export`: exports the traces of a stored run to other programs.

use crate::exit::Exit;
use crate::failure::{CommandResult, Failure};
use crate::judge::StoredRun;
use crate::stdio;
use clap::{Args, ValueEnum};
use platebench_engine::RejudgeError;
use platebench_engine::rejudge::check_trace;
use platebench_model::record::RunRecord;
use platebench_report::export::ExportError;
use std::path::PathBuf;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench export runs/tonight --format parquet                      every scenario, below runs/tonight/export
  platebench export runs/tonight --format mf4 paper/fig13-closed-loop --out /tmp/fig13

Exit codes: 0 written, 2 invalid input or a file exists already, 4 no complete trial")]
pub(crate) struct ExportArgs {
    /// The run folder
    run: PathBuf,
    /// Scenarios of the run, by file; default: all
    #[arg(value_name = "SCENARIO")]
    scenarios: Vec<String>,
    /// Format of the files, see docs/formats.md
    #[arg(long, value_enum)]
    format: ExportFormatArg,
    /// Folder of the files; default: RUN/export. No file is overwritten
    #[arg(long, value_name = "PATH")]
    out: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ExportFormatArg {
    /// Apache Parquet, one file per scenario
    Parquet,
    /// ASAM MDF 4.10, one file per trial
    Mf4,
    /// One table of the run and a description of its columns
    Csv,
    /// MCAP with messages in JSON, compressed, one file per scenario
    Mcap,
}

pub(crate) fn export(arguments: &ExportArgs) -> CommandResult {
    let StoredRun { record, not_judged } = StoredRun::read(&arguments.run)?;
    if record.complete {
        check_traces(&record, arguments)?;
    }
    match not_judged {
        // The record of an interrupted run lacks its last trials.
        Some(error) if !record.complete => return Err(error.into()),
        Some(RejudgeError::Modified { .. }) => {
            stdio::note("a file of the run was changed, so the verdicts are those of run.json and were not checked");
        }
        Some(error) => stdio::note(&format!("{error}; the verdicts are those of run.json, which were not checked")),
        None => {}
    }
    let format = match arguments.format {
        ExportFormatArg::Parquet => platebench_report::export::ExportFormat::Parquet,
        ExportFormatArg::Mf4 => platebench_report::export::ExportFormat::Mf4,
        ExportFormatArg::Csv => platebench_report::export::ExportFormat::Csv,
        ExportFormatArg::Mcap => platebench_report::export::ExportFormat::Mcap,
    };
    let out = arguments.out.clone().unwrap_or_else(|| arguments.run.join("export"));
    let exported = platebench_report::export::export(&record, &arguments.run, &arguments.scenarios, format, &out)?;
    for file in exported.files {
        stdio::show(&format!("{}\n", file.display()));
    }
    if !record.complete || exported.incomplete_trials > 0 {
        stdio::note("the run was interrupted; only its complete trials were exported");
    }
    Ok(Exit::Passed)
}

impl From<ExportError> for Failure {
    fn from(error: ExportError) -> Self {
        let is_empty = matches!(error, ExportError::NoCompleteTrial(_));
        Self::new(if is_empty { Exit::NothingToRun } else { Exit::Invalid }, &error)
    }
}

/// Fails if a trace was modified after the run. `platebench_report::export::export` reports missing
/// traces.
fn check_traces(record: &RunRecord, arguments: &ExportArgs) -> Result<(), Failure> {
    for scenario in platebench_report::export::select_scenarios(record, &arguments.scenarios)? {
        for trial in &scenario.trials {
            if let Err(error @ RejudgeError::Modified { .. }) = check_trace(&arguments.run, trial) {
                return Err(error.into());
            }
        }
    }
    Ok(())
}
