//! `platebench judge`: judges the traces of a stored run again.

use crate::exit::Exit;
use crate::failure::CommandResult;
use crate::options::OutputFormat;
use crate::stdio;
use clap::Args;
use platebench_engine::{RejudgeError, rejudge};
use platebench_model::record::RunRecord;
use platebench_report::Detail;
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench judge runs/tonight
  platebench judge runs/tonight --scenario scenarios/paper/fig13-closed-loop.toml    expectations of this file")]
pub(crate) struct JudgeArgs {
    /// The run folder
    run: PathBuf,
    /// Take the expectations from this scenario file instead of the stored copy
    #[arg(long, value_name = "FILE")]
    scenario: Option<PathBuf>,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
}

pub(crate) fn judge(arguments: &JudgeArgs, detail: Detail) -> CommandResult {
    let record = rejudge(&arguments.run, arguments.scenario.as_deref())?;
    stdio::record(&record, arguments.format, detail);
    if arguments.scenario.is_none() {
        match RunRecord::read(&arguments.run) {
            Ok(stored) if !stored.complete => {
                stdio::note("the run was interrupted; only its complete trials were judged");
            }
            Ok(stored) => note_changed_verdicts(&stored, &record),
            Err(_) => {}
        }
    }
    stdio::warn_if_not_safe(&record);
    Ok(Exit::of_record(&record))
}

/// A stored run for a report or an export.
pub(crate) struct StoredRun {
    pub(crate) record: RunRecord,
    /// Why the verdicts are those of the record instead of those of the traces.
    pub(crate) not_judged: Option<RejudgeError>,
}

impl StoredRun {
    /// Judges the traces, because the verdicts in `run.json` may have been edited. Reports verdicts
    /// that differ.
    pub(crate) fn read(folder: &Path) -> Result<Self, RejudgeError> {
        let mut record = RunRecord::read(folder)?;
        if record.complete && record.discount_missing_traces(folder) {
            return Ok(Self { record, not_judged: None });
        }
        match rejudge(folder, None) {
            Ok(judged) => {
                if record.complete {
                    note_changed_verdicts(&record, &judged);
                }
                Ok(Self { record: judged, not_judged: None })
            }
            Err(error) => Ok(Self { record, not_judged: Some(error) }),
        }
    }
}

fn note_changed_verdicts(stored: &RunRecord, again: &RunRecord) {
    for (then, now) in stored.scenarios.iter().zip(&again.scenarios) {
        for (before, after) in then.expectations.iter().zip(&now.expectations) {
            if before.verdict != after.verdict {
                let (file, metric) = (&then.file, &before.metric);
                stdio::note(&format!("{file}: {metric}: {} in the record, {} now", before.verdict, after.verdict));
            }
        }
    }
}
