//! `platebench export`: a stored run in the formats that other programs read.

use crate::exit::Exit;
use crate::output;
use clap::{Args, ValueEnum};
use platebench_export::ExportError;
use platebench_runner::rejudge::trace_unchanged;
use platebench_runner::{RejudgeError, rejudge};
use platebench_verdict::RunRecord;
use std::path::PathBuf;

/// `platebench export`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench export runs/tonight --format parquet                      every scenario, below runs/tonight/export
  platebench export runs/tonight --format mf4 paper/fig13-closed-loop --out /tmp/fig13

Exit codes: 0 written, 2 invalid input or a file is in the way, 4 no whole trial")]
pub(crate) struct Export {
    /// The run folder
    run: PathBuf,
    /// Scenarios of the run, by file; all where none is given
    #[arg(value_name = "SCENARIO")]
    scenarios: Vec<String>,
    /// What is written: docs/formats.md describes each
    #[arg(long, value_enum)]
    format: Format,
    /// The folder that it is written to; RUN/export where not given. No file is written over
    #[arg(long, value_name = "PATH")]
    out: Option<PathBuf>,
}

/// `--format`
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    /// Apache Parquet, a file for each scenario
    Parquet,
    /// ASAM MDF 4.10, a file for each scenario
    Mf4,
    /// One table of the whole run and a description of its columns
    Csv,
    /// MCAP with messages in JSON, a file for each scenario
    Mcap,
}

/// Writes the traces of a stored run.
pub(crate) fn export(arguments: &Export) -> Exit {
    let record = match RunRecord::read(&arguments.run) {
        Ok(record) if record.complete => Ok(record),
        // The record of a run that was cut off does not name all that is there.
        Ok(_) => rejudge(&arguments.run, None),
        Err(error) => Err(error.into()),
    };
    let record = match record {
        Ok(record) => record,
        Err(RejudgeError::Scenario(diagnostic)) => {
            output::diagnostic(&diagnostic);
            return Exit::Invalid;
        }
        Err(error) => {
            output::error(&error.to_string());
            return Exit::Invalid;
        }
    };
    if let Some(refused) = refused(&record, arguments) {
        output::error(&refused.to_string());
        return Exit::Invalid;
    }
    let format = match arguments.format {
        Format::Parquet => platebench_export::Format::Parquet,
        Format::Mf4 => platebench_export::Format::Mf4,
        Format::Csv => platebench_export::Format::Csv,
        Format::Mcap => platebench_export::Format::Mcap,
    };
    let out = arguments.out.clone().unwrap_or_else(|| arguments.run.join("export"));
    match platebench_export::export(&record, &arguments.run, &arguments.scenarios, format, &out) {
        Ok(exported) => {
            for file in exported.files {
                output::show(&format!("{}\n", file.display()));
            }
            if !record.complete || exported.cut_off > 0 {
                output::note("the run was cut off; exported is what was whole by then");
            }
            Exit::Passed
        }
        Err(error) => {
            output::error(&error.to_string());
            if matches!(error, ExportError::Nothing(_)) { Exit::Nothing } else { Exit::Invalid }
        }
    }
}

/// Why a trace of what was asked for is not the one that the run was made with. That a scenario or a trace is not there is told by the export.
fn refused(record: &RunRecord, arguments: &Export) -> Option<RejudgeError> {
    let chosen = platebench_export::chosen(record, &arguments.scenarios).ok()?;
    let trials = chosen.into_iter().flat_map(|scenario| &scenario.trials);
    let refusals = trials.filter_map(|trial| trace_unchanged(&arguments.run, trial).err());
    refusals.into_iter().find(|refusal| matches!(refusal, RejudgeError::Changed { .. }))
}
