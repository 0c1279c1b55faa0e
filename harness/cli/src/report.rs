//! `platebench report`: renders the report of a stored run, judges the run again, exports its
//! traces, or joins several runs.

use crate::board::write_soak_page;
use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{BASELINES, OutputFormat};
use crate::stdio;
use clap::Args;
#[cfg(feature = "export")]
use clap::ValueEnum;
use platebench_engine::rejudge::{check_trace, rejudge_with_rows};
use platebench_engine::{RejudgeError, rejudge};
use platebench_lab::boards::{MergeError, SOAK_FILE, SoakRecord, merge_runs};
use platebench_model::quoted_path;
use platebench_model::record::{RECORD_FILE, RunFolder, RunRecord};
#[cfg(feature = "export")]
use platebench_report::export::{ExportError, ExportFormat, select_scenarios};
use platebench_report::page::{ReportPage, RowCache};
use platebench_report::{Detail, junit, page, traceability};
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench report runs/tonight                     runs/tonight/report.html
  platebench report runs/tonight --against runs/old  runs/tonight/comparison.html, both side by side
  platebench report runs/tonight --rejudge           the verdicts, from the stored traces
  platebench report runs/tonight --rejudge --scenario scenarios/paper/fig13-closed-loop.toml
  platebench report runs/tonight --export parquet    every scenario, below runs/tonight/export
  platebench report runs/tonight --export mf4 paper/fig13-closed-loop --out /tmp/fig13
  platebench report --merge runs/left runs/right --out runs/both    boards against scenarios
  platebench report --merge runs/part-1 runs/part-2 --out runs/all  shards of one board

Exit codes: 0 written, 2 invalid input or a file exists already. With --rejudge and --merge as for
run; with --merge 2 if a trial is in two runs or a file was changed, 3 if a shard is missing. With
--export 4 if no trial is complete.")]
pub(crate) struct ReportArgs {
    /// The run folder
    #[arg(required_unless_present = "merge", conflicts_with = "merge")]
    run: Option<PathBuf>,
    /// Scenarios of the run to export, by file; default: all
    #[cfg(feature = "export")]
    #[arg(value_name = "SCENARIO")]
    scenarios: Vec<String>,
    /// Show another run side by side, in comparison.html
    #[arg(long, value_name = "RUN", conflicts_with = "action")]
    against: Option<PathBuf>,
    /// Folder of the baselines
    #[arg(long, value_name = "FOLDER", default_value = BASELINES)]
    baselines: PathBuf,
    /// Judge the traces again, without a rig, and print the verdicts instead of writing a report
    #[arg(long, group = "action")]
    rejudge: bool,
    /// With --rejudge: take the expectations from this scenario file instead of the stored copy
    #[arg(long, value_name = "FILE", requires = "rejudge")]
    scenario: Option<PathBuf>,
    /// Export the traces in this format, see docs/formats.md
    #[cfg(feature = "export")]
    #[arg(long, value_enum, value_name = "FORMAT", groups = ["action", "writer"])]
    export: Option<ExportFormatArg>,
    /// Join the runs of shards and boards into one run folder
    #[arg(long, value_name = "RUN", num_args = 1.., groups = ["action", "writer"], requires = "out")]
    merge: Vec<PathBuf>,
    /// Folder of the exported files, by default RUN/export, or of the joined run. No file is
    /// overwritten
    #[arg(long, value_name = "FOLDER", requires = "writer")]
    out: Option<PathBuf>,
    /// Format of standard output with --rejudge and --merge; json: the record
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
}

#[cfg(feature = "export")]
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

pub(crate) fn report(arguments: &ReportArgs, detail: Detail) -> CommandResult {
    let mut runs = arguments.run.iter().chain(&arguments.against).chain(&arguments.merge);
    if let Some(run) = runs.find(|run| !run.join(RECORD_FILE).exists() && !run.join(SOAK_FILE).exists()) {
        let found = if run.exists() { "contains no run" } else { "no such folder" };
        return Err(Failure::invalid(&format!("{}: {found}, expected a run folder", quoted_path(run))));
    }
    let Some(run) = &arguments.run else { return merge(arguments, detail) };
    #[cfg(feature = "export")]
    if let (Some(other), None) = (arguments.scenarios.first(), arguments.export) {
        let message = format!(
            "`{other}`: expected one run; --against RUN compares two runs, --merge RUN... --out FOLDER joins several, \
             and names of scenarios need --export FORMAT"
        );
        return Err(Failure::invalid(&message));
    }
    if arguments.rejudge {
        return judge(run, arguments, detail);
    }
    #[cfg(feature = "export")]
    if let Some(format) = arguments.export {
        return export(run, arguments, format);
    }
    render(run, arguments)
}

fn render(run: &Path, arguments: &ReportArgs) -> CommandResult {
    let soak_file = run.join(SOAK_FILE);
    if arguments.against.is_none() && soak_file.exists() {
        return write_soak_page(&SoakRecord::read(run).or_invalid_at(&soak_file)?, run);
    }
    let (record, rows) = read_record(run)?;
    let other = arguments.against.as_deref().map(|folder| read_record(folder).map(|(other, _)| (folder, other)));
    let other = other.transpose()?;
    let page = ReportPage::new(&record, run).with_baselines(&arguments.baselines).with_earlier_runs().with_rows(rows);
    let page = page.without_changed_traces(|folder, trial| {
        matches!(check_trace(folder, trial), Err(RejudgeError::Modified { .. }))
    });
    let (page, name) = match &other {
        Some((folder, other)) => (page.with_other_run(other, folder), page::COMPARISON_FILE),
        None => (page, page::FILE),
    };
    let path = run.join(name);
    page.write(&path).and_then(|()| traceability::write(&record, run)).or_invalid()?;
    stdio::show(&format!("{}\n", quoted_path(&path)));
    Ok(Exit::Passed)
}

/// Judges the traces. Shows the verdicts of the record if a trace was changed or was not kept, or
/// if the run is complete and cannot be judged for another reason.
fn read_record(folder: &Path) -> Result<(RunRecord, RowCache), RejudgeError> {
    let StoredRun { record, not_judged, rows } = StoredRun::read(folder)?;
    match not_judged {
        Some(error) if record.complete || matches!(error, RejudgeError::Modified { .. } | RejudgeError::NotKept(_)) => {
            stdio::note(&format!("{error}; the report shows the verdicts of run.json, which were not checked"));
            Ok((record, rows))
        }
        Some(error) => Err(error),
        None => Ok((record, rows)),
    }
}

/// A stored run for a report or an export.
struct StoredRun {
    record: RunRecord,
    /// Why the verdicts are those of the record instead of those of the traces.
    not_judged: Option<RejudgeError>,
    /// The judged traces.
    rows: RowCache,
}

impl StoredRun {
    /// Judges the traces, because the verdicts in `run.json` may have been edited. Reports verdicts
    /// that differ.
    fn read(folder: &Path) -> Result<Self, RejudgeError> {
        let mut record = RunRecord::read(folder)?;
        if record.complete && record.discount_missing_traces(folder) {
            return Ok(Self { record, not_judged: None, rows: RowCache::default() });
        }
        let mut rows = RowCache::default();
        match rejudge_with_rows(folder, None, &mut |trace, read| rows.add(trace, read)) {
            Ok(judged) => {
                if record.complete {
                    note_changed_verdicts(&record, &judged);
                }
                Ok(Self { record: judged, not_judged: None, rows })
            }
            Err(error) => Ok(Self { record, not_judged: Some(error), rows: RowCache::default() }),
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

fn judge(run: &Path, arguments: &ReportArgs, detail: Detail) -> CommandResult {
    let record = rejudge(run, arguments.scenario.as_deref())?;
    stdio::record(&record, run, arguments.format, detail);
    if arguments.scenario.is_none() {
        match RunRecord::read(run) {
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

#[cfg(feature = "export")]
fn export(run: &Path, arguments: &ReportArgs, format: ExportFormatArg) -> CommandResult {
    let StoredRun { record, not_judged, rows } = StoredRun::read(run)?;
    if record.complete {
        check_traces(&record, run, &arguments.scenarios)?;
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
    let format = match format {
        ExportFormatArg::Parquet => ExportFormat::Parquet,
        ExportFormatArg::Mf4 => ExportFormat::Mf4,
        ExportFormatArg::Csv => ExportFormat::Csv,
        ExportFormatArg::Mcap => ExportFormat::Mcap,
    };
    let out = arguments.out.as_deref();
    let exported = platebench_report::export::export(&record, run, &rows, &arguments.scenarios, format, out)?;
    for file in exported.files {
        stdio::show(&format!("{}\n", quoted_path(&file)));
    }
    if !record.complete || exported.incomplete_trials > 0 {
        stdio::note("the run was interrupted; only its complete trials were exported");
    }
    Ok(Exit::Passed)
}

#[cfg(feature = "export")]
impl From<ExportError> for Failure {
    fn from(error: ExportError) -> Self {
        let is_empty = matches!(error, ExportError::NoCompleteTrial(_));
        Self::new(if is_empty { Exit::NothingToRun } else { Exit::Invalid }, &error)
    }
}

/// Fails if a trace was modified after the run. `platebench_report::export::export` reports missing
/// traces.
#[cfg(feature = "export")]
fn check_traces(record: &RunRecord, run: &Path, scenarios: &[String]) -> Result<(), Failure> {
    for scenario in select_scenarios(record, scenarios)? {
        for trial in &scenario.trials {
            if let Err(error @ RejudgeError::Modified { .. }) = check_trace(run, trial) {
                return Err(error.into());
            }
        }
    }
    Ok(())
}

fn merge(arguments: &ReportArgs, detail: Detail) -> CommandResult {
    let folder = RunFolder::create(arguments.out.as_deref()).or_invalid()?;
    let record = merge_runs(&arguments.merge, &folder).map_err(|error| {
        folder.remove_if_empty();
        match error {
            MergeError::Stored(error) => error.into(),
            error => Failure::invalid(&error),
        }
    })?;
    stdio::record(&record, folder.path(), arguments.format, detail);
    if let (OutputFormat::Human, Some(boards)) = (arguments.format, traceability::board_document(&record)) {
        stdio::show("\n");
        stdio::document(&boards);
    }
    let page = folder.path().join(page::FILE);
    let written = junit::write(&record, &folder.path().join(junit::FILE))
        .and_then(|()| ReportPage::new(&record, folder.path()).with_baselines(&arguments.baselines).write(&page))
        .and_then(|()| traceability::write(&record, folder.path()));
    stdio::note(&format!("report: {}", quoted_path(&page)));
    written.or_invalid()?;
    stdio::warn_if_not_safe(&record);
    Ok(Exit::of_record(&record))
}
