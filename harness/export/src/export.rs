//! Which files are made of a run, and that none is written over or left half.

use crate::error::ExportError;
use crate::source::ExportScenario;
use crate::{mcap, mf4, parquet, table};
use platebench_record::RECORD_FILE;
use platebench_record::{RunRecord, ScenarioRecord};
use std::fs::{self, File};
use std::path::{Path, PathBuf};

/// A format that other programs read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExportFormat {
    /// Apache Parquet: a file for each scenario.
    Parquet,
    /// ASAM MDF 4.10: a file for each scenario, a data group for each trial.
    Mf4,
    /// One tidy table of the whole run, and a description of its columns.
    Csv,
    /// MCAP with messages in JSON: a file for each scenario, a topic for each trial.
    Mcap,
}

impl ExportFormat {
    /// The ending of its files.
    pub const fn extension(self) -> &'static str {
        match self {
            Self::Parquet => "parquet",
            Self::Mf4 => "mf4",
            Self::Csv => "csv",
            Self::Mcap => "mcap",
        }
    }
}

/// What was made.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct ExportResult {
    /// The files.
    pub files: Vec<PathBuf>,
    /// How many trials were left out because they were cut off before their trace was whole.
    pub incomplete_trials: usize,
}

/// Writes the traces of `run`, which lies in `folder`, as `format` below `out`; of the named scenarios only, where any
/// are named: by file, with or without `.toml`.
///
/// # Errors
/// [`ExportError`]; before anything is written where a name is unknown, a file is in the way or there is no whole trial.
pub fn export(
    run: &RunRecord,
    folder: &Path,
    scenarios: &[String],
    format: ExportFormat,
    out: &Path,
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
        let (source, without_trace) = ExportScenario::of(run, scenario, folder, started_ns)?;
        cut_off += without_trace;
        if !source.trials.is_empty() {
            sources.push(source);
        }
    }
    if sources.is_empty() {
        return Err(ExportError::NoCompleteTrial(record));
    }
    let mut tasks: Vec<(PathBuf, Box<WriteFile<'_>>)> = Vec::new();
    match format {
        ExportFormat::Csv => {
            let path = out.join(table::FILE);
            tasks.push((path.clone(), Box::new(|file, path| table::write(&sources, file, path))));
            tasks.push((table::description_path(&path), Box::new(table::write_description)));
        }
        ExportFormat::Parquet | ExportFormat::Mf4 | ExportFormat::Mcap => {
            let write = match format {
                ExportFormat::Mf4 => mf4::write,
                ExportFormat::Mcap => mcap::write,
                _ => parquet::write,
            };
            for source in &sources {
                let path = out.join(format!("{}.{}", source.name, format.extension()));
                tasks.push((path, Box::new(move |file, path| write(source, file, path))));
            }
        }
    }
    if let Some((taken, _)) = tasks.iter().find(|(path, _)| path.exists()) {
        return Err(ExportError::FileExists(taken.clone()));
    }
    let mut files = Vec::with_capacity(tasks.len());
    for (path, write) in tasks {
        write_atomically(&path, &*write)?;
        files.push(path);
    }
    Ok(ExportResult { files, incomplete_trials: cut_off })
}

/// Fills a file whose name, for messages, is given beside it.
type WriteFile<'a> = dyn Fn(File, &Path) -> Result<(), ExportError> + 'a;

/// Fills a file that gets its name once it is whole.
fn write_atomically(path: &Path, write: &WriteFile<'_>) -> Result<(), ExportError> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).map_err(ExportError::io(folder))?;
    }
    let mut provisional = path.as_os_str().to_owned();
    provisional.push(".part");
    let provisional = PathBuf::from(provisional);
    let file = File::create(&provisional).map_err(ExportError::io(&provisional))?;
    let written = write(file, path).and_then(|()| {
        // Somebody else may have been here meanwhile.
        if path.exists() {
            return Err(ExportError::FileExists(path.to_owned()));
        }
        fs::rename(&provisional, path).map_err(ExportError::io(path))
    });
    if written.is_err() {
        // What went wrong is told; half a file helps nobody.
        let _ = fs::remove_file(&provisional);
    }
    written
}

/// The scenarios that were asked for, in the order of the run; all where none was.
///
/// # Errors
/// [`ExportError::NoSuchScenario`].
pub fn select_scenarios<'a>(run: &'a RunRecord, asked: &[String]) -> Result<Vec<&'a ScenarioRecord>, ExportError> {
    let bare = |name: &str| name.strip_suffix(".toml").unwrap_or(name).to_owned();
    let known: Vec<String> = run.scenarios.iter().map(|scenario| bare(&scenario.file)).collect();
    if let Some(unknown) = asked.iter().find(|name| !known.contains(&bare(name))) {
        return Err(ExportError::NoSuchScenario { asked: unknown.clone(), known: known.join(", ") });
    }
    let wanted = |file: &str| asked.is_empty() || asked.iter().any(|name| bare(name) == bare(file));
    Ok(run.scenarios.iter().filter(|scenario| wanted(&scenario.file)).collect())
}
