//! `platebench export`: exports the traces of a stored run to other programs.

use crate::exit::Exit;
use crate::stdio;
use clap::{Args, ValueEnum};
use platebench_export::ExportError;
use platebench_record::RunRecord;
use platebench_runner::rejudge::check_trace;
use platebench_runner::{RejudgeError, rejudge};
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

pub(crate) fn export(arguments: &ExportArgs) -> Exit {
    let record = match RunRecord::read(&arguments.run) {
        Ok(record) if record.complete => Ok(record),
        // The record of an interrupted run lacks its last trials.
        Ok(_) => rejudge(&arguments.run, None),
        Err(error) => Err(error.into()),
    };
    let record = match record {
        Ok(record) => record,
        Err(error) => return stdio::reject_stored_run(&error),
    };
    if let Some(refused) = changed_trace(&record, arguments) {
        return stdio::reject(&refused);
    }
    let format = match arguments.format {
        ExportFormatArg::Parquet => platebench_export::ExportFormat::Parquet,
        ExportFormatArg::Mf4 => platebench_export::ExportFormat::Mf4,
        ExportFormatArg::Csv => platebench_export::ExportFormat::Csv,
        ExportFormatArg::Mcap => platebench_export::ExportFormat::Mcap,
    };
    let out = arguments.out.clone().unwrap_or_else(|| arguments.run.join("export"));
    match platebench_export::export(&record, &arguments.run, &arguments.scenarios, format, &out) {
        Ok(exported) => {
            for file in exported.files {
                stdio::show(&format!("{}\n", file.display()));
            }
            if !record.complete || exported.incomplete_trials > 0 {
                stdio::note("the run was interrupted; exported are its complete trials");
            }
            Exit::Passed
        }
        Err(error) => {
            stdio::error(&error.to_string());
            if matches!(error, ExportError::NoCompleteTrial(_)) { Exit::NothingToRun } else { Exit::Invalid }
        }
    }
}

/// The first one that was modified after the run. `export` reports missing ones.
fn changed_trace(record: &RunRecord, arguments: &ExportArgs) -> Option<RejudgeError> {
    let chosen = platebench_export::select_scenarios(record, &arguments.scenarios).ok()?;
    let trials = chosen.into_iter().flat_map(|scenario| &scenario.trials);
    let refusals = trials.filter_map(|trial| check_trace(&arguments.run, trial).err());
    refusals.into_iter().find(|refusal| matches!(refusal, RejudgeError::Modified { .. }))
}
