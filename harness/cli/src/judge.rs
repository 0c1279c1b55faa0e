//! `platebench judge`: judges the traces of a stored run again.

use crate::exit::Exit;
use crate::failure::CommandResult;
use crate::options::OutputFormat;
use crate::stdio;
use clap::Args;
use platebench_record::RunRecord;
use platebench_report::Detail;
use platebench_runner::rejudge;
use std::path::PathBuf;

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
        note_changed_verdicts(arguments, &record);
    }
    stdio::warn_if_not_safe(&record);
    Ok(Exit::of_record(&record))
}

fn note_changed_verdicts(arguments: &JudgeArgs, again: &RunRecord) {
    let Ok(stored) = RunRecord::read(&arguments.run) else { return };
    if !stored.complete {
        stdio::note("the run was interrupted; only its complete trials were judged");
        return;
    }
    for (then, now) in stored.scenarios.iter().zip(&again.scenarios) {
        for (before, after) in then.expectations.iter().zip(&now.expectations) {
            if before.verdict != after.verdict {
                let (file, metric) = (&then.file, &before.metric);
                stdio::note(&format!("{file}: {metric}: {} in the record, {} now", before.verdict, after.verdict));
            }
        }
    }
}
