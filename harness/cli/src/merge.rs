//! `platebench merge`: joins the runs of shards and of boards into one run folder.

use crate::exit::Exit;
use crate::failure::{CommandResult, Failure, OrInvalid};
use crate::options::{BASELINES, OutputFormat};
use crate::stdio;
use clap::Args;
use platebench_lab::boards::{MergeError, merge_runs};
use platebench_model::record::{RunFolder, RunRecord};
use platebench_report::page::{self, ReportPage};
use platebench_report::text::board_matrix::{difference_table, missing_shards, verdict_matrix};
use platebench_report::{Detail, junit, traceability};
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench merge runs/left runs/right --out runs/both      boards against scenarios, differences between boards
  platebench merge runs/shard-1 runs/shard-2 --out runs/all  shards of one board

Exit codes: as for run; 2 the same trial is in two runs, or a file was changed, 3 a shard is missing")]
pub(crate) struct MergeArgs {
    /// The run folders
    #[arg(value_name = "RUN", required = true)]
    runs: Vec<PathBuf>,
    /// New run folder
    #[arg(long, value_name = "RUN")]
    out: PathBuf,
    /// Format of standard output; json: the record
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
}

pub(crate) fn merge(arguments: &MergeArgs, detail: Detail) -> CommandResult {
    let folder = RunFolder::create(Some(&arguments.out)).or_invalid()?;
    let record = merge_runs(&arguments.runs, &folder).map_err(|error| {
        folder.remove_if_empty();
        match error {
            MergeError::Stored(error) => error.into(),
            error => Failure::invalid(&error),
        }
    })?;
    stdio::record(&record, arguments.format, detail);
    if arguments.format == OutputFormat::Human {
        show_boards(&record);
    }
    let page = folder.path().join(page::FILE);
    let written = junit::write(&record, &folder.path().join(junit::FILE))
        .and_then(|()| ReportPage::new(&record, folder.path()).with_baselines(Path::new(BASELINES)).write(&page))
        .and_then(|()| traceability::write(&record, folder.path()));
    stdio::note(&format!("report: {}", page.display()));
    written.or_invalid()?;
    stdio::warn_if_not_safe(&record);
    Ok(Exit::of_record(&record))
}

fn show_boards(record: &RunRecord) {
    let Some(merge) = &record.merge else { return };
    let tables = verdict_matrix(record).into_iter().chain(difference_table(merge));
    tables.for_each(|table| stdio::show(&format!("\n{}\n", table.lines().join("\n"))));
    for line in missing_shards(merge) {
        stdio::note(&line);
    }
}
