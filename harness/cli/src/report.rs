//! `platebench report`: renders the report of a stored run, or of two runs side by side.

use crate::exit::Exit;
use crate::failure::{CommandResult, OrInvalid};
use crate::judge::StoredRun;
use crate::options::BASELINES;
use crate::{soak, stdio};
use clap::Args;
use platebench_engine::RejudgeError;
use platebench_engine::rejudge::check_trace;
use platebench_lab::boards::{SOAK_FILE, SoakRecord};
use platebench_model::record::RunRecord;
use platebench_report::page::{self, ReportPage};
use platebench_report::traceability;
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench report runs/tonight                            runs/tonight/report.html
  platebench report runs/tonight --against runs/yesterday   runs/tonight/comparison.html, both runs side by side")]
pub(crate) struct ReportArgs {
    /// The run folder
    run: PathBuf,
    /// Show another run side by side, in comparison.html
    #[arg(long, value_name = "RUN")]
    against: Option<PathBuf>,
    /// Folder of the baselines
    #[arg(long, value_name = "FOLDER", default_value = BASELINES)]
    baselines: PathBuf,
}

pub(crate) fn report(arguments: &ReportArgs) -> CommandResult {
    let soak_file = arguments.run.join(SOAK_FILE);
    if arguments.against.is_none() && soak_file.exists() {
        return soak::write_page(&SoakRecord::read(&arguments.run).or_invalid_at(&soak_file)?, &arguments.run);
    }
    let record = read_record(&arguments.run)?;
    let other = arguments.against.as_deref().map(|folder| read_record(folder).map(|other| (folder, other)));
    let other = other.transpose()?;
    let page = ReportPage::new(&record, &arguments.run).with_baselines(&arguments.baselines).with_earlier_runs();
    let page = page.without_changed_traces(|folder, trial| {
        matches!(check_trace(folder, trial), Err(RejudgeError::Modified { .. }))
    });
    let (page, name) = match &other {
        Some((folder, other)) => (page.with_other_run(other, folder), page::COMPARISON_FILE),
        None => (page, page::FILE),
    };
    let path = arguments.run.join(name);
    page.write(&path).and_then(|()| traceability::write(&record, &arguments.run)).or_invalid()?;
    stdio::show(&format!("{}\n", path.display()));
    Ok(Exit::Passed)
}

/// Judges the traces. Shows the verdicts of the record if a trace was changed or was not kept, or
/// if the run is complete and cannot be judged for another reason.
fn read_record(folder: &Path) -> Result<RunRecord, RejudgeError> {
    let StoredRun { record, not_judged } = StoredRun::read(folder)?;
    match not_judged {
        Some(error) if record.complete || matches!(error, RejudgeError::Modified { .. } | RejudgeError::NotKept(_)) => {
            stdio::note(&format!("{error}; the report shows the verdicts of run.json, which were not checked"));
            Ok(record)
        }
        Some(error) => Err(error),
        None => Ok(record),
    }
}
