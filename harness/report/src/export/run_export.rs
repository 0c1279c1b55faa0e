//! Exports a run to new files.

use crate::export::source::{ExportError, ExportScenario};
use crate::export::{mcap, mf4, parquet, table};
use crate::page::RowCache;
use platebench_model::record::{RECORD_FILE, RunRecord, ScenarioRecord};
use platebench_model::trace::OutputFolder;
use std::fs::File;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Folder of the exported files in the run folder.
const FOLDER: &str = "export";

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExportFormat {
    Parquet,
    Mf4,
    Csv,
    Mcap,
}

#[derive(Debug, Default, PartialEq, Eq)]
pub struct ExportResult {
    pub files: Vec<PathBuf>,
    /// Number of trials that were skipped, because they have no complete trace.
    pub incomplete_trials: usize,
}

/// Exports the named scenarios (with or without `.toml`) to the folder `out`, by default `export` in
/// the run folder, or all if `scenarios` is empty. `rows` need not be read again. Checks names,
/// existing files and complete trials before it writes a file.
pub fn export(
    run: &RunRecord,
    folder: &Path,
    rows: &RowCache,
    scenarios: &[String],
    format: ExportFormat,
    out: Option<&Path>,
) -> Result<ExportResult, ExportError> {
    let record = folder.join(RECORD_FILE);
    let started = run.started.parse::<jiff::Timestamp>().map_err(|source| ExportError::InvalidStartTime {
        record: record.clone(),
        text: run.started.clone(),
        source,
    })?;
    let started_ns = u64::try_from(started.as_nanosecond()).unwrap_or_default();
    let mut sources = Vec::new();
    let mut cut_off = 0;
    for scenario in select_scenarios(run, scenarios)? {
        let (source, without_trace) = ExportScenario::of(run, scenario, folder, rows, started_ns)?;
        cut_off += without_trace;
        if !source.trials.is_empty() {
            sources.push(source);
        }
    }
    if sources.is_empty() {
        return Err(ExportError::NoCompleteTrial(record));
    }
    let default = folder.join(FOLDER);
    let path_of = |file: &Path| out.unwrap_or(&default).join(file);
    let mut tasks: Vec<(PathBuf, Box<WriteFile<'_>>)> = Vec::new();
    match format {
        ExportFormat::Csv => {
            let path = PathBuf::from(table::FILE);
            tasks.push((path.clone(), Box::new(|file, path| table::write(&sources, file, path))));
            tasks.push((table::description_path(&path), Box::new(table::write_description)));
        }
        ExportFormat::Mf4 => {
            for source in &sources {
                for trial in &source.trials {
                    // If a scenario has only one trial, the file has the name of the scenario.
                    let name = match source.scenario.trials.len() {
                        1 => format!("{}.mf4", source.name),
                        _ => format!("{}/{:03}.mf4", source.name, trial.index),
                    };
                    tasks.push((name.into(), Box::new(move |file, path| mf4::write(source, trial, file, path))));
                }
            }
        }
        ExportFormat::Parquet | ExportFormat::Mcap => {
            let (write, extension): (WriteScenario, _) =
                if format == ExportFormat::Mcap { (mcap::write, "mcap") } else { (parquet::write, "parquet") };
            for source in &sources {
                let path = format!("{}.{extension}", source.name).into();
                tasks.push((path, Box::new(move |file, path| write(source, file, path))));
            }
        }
    }
    let mut files: Vec<PathBuf> = tasks.iter().map(|(file, _)| path_of(file)).collect();
    if let Some(index) = files.iter().position(|path| path.symlink_metadata().is_ok()) {
        return Err(ExportError::FileExists(files.swap_remove(index)));
    }
    let output = match out {
        Some(out) => OutputFolder::create(out),
        None => OutputFolder::open(folder).and_then(|run| run.create_folder(FOLDER)),
    }?;
    for ((file, write), path) in tasks.iter().zip(&files) {
        write_new_file(&output, file, path, &**write)?;
    }
    Ok(ExportResult { files, incomplete_trials: cut_off })
}

type WriteScenario = fn(&ExportScenario<'_>, &File, &Path) -> Result<(), ExportError>;

type WriteFile<'a> = dyn Fn(&File, &Path) -> Result<(), ExportError> + 'a;

fn write_new_file(
    output: &OutputFolder,
    relative: &Path,
    path: &Path,
    write: &WriteFile<'_>,
) -> Result<(), ExportError> {
    let file = output.create_file(relative)?;
    write(file.file(), path)?;
    // Another process may have written the file in the meantime.
    file.commit_new().map_err(|error| match error.source.kind() {
        ErrorKind::AlreadyExists => ExportError::FileExists(path.to_owned()),
        _ => error.into(),
    })
}

/// Returns the requested scenarios in the order of the run, or all if `requested` is empty.
pub fn select_scenarios<'a>(run: &'a RunRecord, requested: &[String]) -> Result<Vec<&'a ScenarioRecord>, ExportError> {
    let bare = |name: &str| name.strip_suffix(".toml").unwrap_or(name).to_owned();
    let known: Vec<String> = run.scenarios.iter().map(|scenario| bare(&scenario.file)).collect();
    if let Some(unknown) = requested.iter().find(|name| !known.contains(&bare(name))) {
        return Err(ExportError::NoSuchScenario { requested: unknown.clone(), known: known.join(", ") });
    }
    let wanted = |file: &str| requested.is_empty() || requested.iter().any(|name| bare(name) == bare(file));
    Ok(run.scenarios.iter().filter(|scenario| wanted(&scenario.file)).collect())
}
