//! Reads a scenario of a run for export: the traces of its trials, and metadata. Defines the errors of an export.

use platebench_model::record::{RECORD_FILE, RunRecord, ScenarioRecord};
use platebench_model::trace::{FileError, Row, TraceError, TraceReader};
use std::error::Error;
use std::path::{Component, Path, PathBuf};

/// After an error, files that were complete before it remain.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{}: {source}", path.display())]
    Format { path: PathBuf, source: Box<dyn Error + Send + Sync> },
    #[error("{} exists, expected a new file; name another folder with --out", .0.display())]
    FileExists(PathBuf),
    #[error("the run has no scenario `{requested}`, expected one of {known}")]
    NoSuchScenario { requested: String, known: String },
    #[error("{}: `{named}` is not a file below the run folder", record.display())]
    OutsideRunFolder { record: PathBuf, named: String },
    #[error("{}: `started` is {text}, expected a time like 2026-03-02T09:30:00Z: {source}", record.display())]
    InvalidStartTime { record: PathBuf, text: String, source: jiff::Error },
    #[error("{}: no complete trial, expected at least one", .0.display())]
    NoCompleteTrial(PathBuf),
}

impl ExportError {
    pub(crate) fn format<E: Error + Send + Sync + 'static>(path: &Path) -> impl Fn(E) -> Self {
        move |source| Self::Format { path: path.to_owned(), source: Box::new(source) }
    }
}

#[derive(Debug)]
pub(crate) struct ExportTrial {
    pub(crate) index: u32,
    pub(crate) seed: u64,
    trace: PathBuf,
}

impl ExportTrial {
    pub(crate) fn rows(&self) -> Result<impl Iterator<Item = Result<Row, ExportError>>, ExportError> {
        Ok(TraceReader::open(&self.trace)?.map(|row| row.map_err(ExportError::from)))
    }
}

#[derive(Debug)]
pub(crate) struct ExportScenario<'a> {
    pub(crate) run: &'a RunRecord,
    pub(crate) scenario: &'a ScenarioRecord,
    /// Scenario file without extension, such as `paper/fig13-closed-loop`.
    pub(crate) name: &'a str,
    /// Start of the run, ns since 1970 UTC.
    pub(crate) started_ns: u64,
    pub(crate) trials: Vec<ExportTrial>,
}

impl<'a> ExportScenario<'a> {
    /// Also returns the number of trials without a trace.
    pub(crate) fn of(
        run: &'a RunRecord,
        scenario: &'a ScenarioRecord,
        folder: &Path,
        started_ns: u64,
    ) -> Result<(Self, usize), ExportError> {
        let outside =
            |named: &str| ExportError::OutsideRunFolder { record: folder.join(RECORD_FILE), named: named.to_owned() };
        let name = scenario.file.strip_suffix(".toml").unwrap_or(&scenario.file);
        if !is_inside_folder(name) {
            return Err(outside(&scenario.file));
        }
        let mut trials = Vec::with_capacity(scenario.trials.len());
        let mut cut_off = 0;
        for trial in &scenario.trials {
            if !is_inside_folder(&trial.trace) {
                return Err(outside(&trial.trace));
            }
            let trace = folder.join(&trial.trace);
            // A trial without hash and file was cut off. If only the file is missing, the later
            // read of the trace fails.
            if trial.sha256.is_none() && !trace.exists() {
                cut_off += 1;
            } else {
                trials.push(ExportTrial { index: trial.index, seed: trial.seed, trace });
            }
        }
        Ok((Self { run, scenario, name, started_ns, trials }, cut_off))
    }

    pub(crate) fn metadata(&self) -> Vec<(&'static str, String)> {
        let (run, scenario) = (self.run, self.scenario);
        let firmware = run.rig.firmware.as_ref().map(|firmware| format!("{} {}", firmware.name, firmware.version));
        let inputs: Vec<_> =
            scenario.inputs.iter().map(|input| format!("{} sha256:{}", input.file, input.sha256)).collect();
        let facts = [
            ("scenario", Some(self.name.to_owned())),
            ("title", Some(scenario.title.clone())),
            ("source", scenario.source.clone()),
            ("law", Some(scenario.law.clone())),
            ("model", Some(scenario.model.clone())),
            ("verdict", Some(scenario.verdict.name().to_owned())),
            ("trials", Some(self.trials.len().to_string())),
            ("rig", Some(run.rig.name.clone())),
            ("firmware", firmware),
            ("clock", Some(run.clock.to_string())),
            ("started", Some(run.started.clone())),
            ("complete", Some(run.complete.to_string())),
            ("inputs", Some(inputs.join(", "))),
            ("tool", Some(format!("{} {}", run.tool.name, run.tool.version))),
        ];
        facts.into_iter().filter_map(|(name, value)| Some((name, value?))).collect()
    }
}

fn is_inside_folder(path: &str) -> bool {
    !path.is_empty() && Path::new(path).components().all(|part| matches!(part, Component::Normal(_)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejects_paths_outside_the_folder() {
        for inside in ["a", "paper/fig13", "a/b/c.csv"] {
            assert!(is_inside_folder(inside), "{inside}");
        }
        for outside in ["", "/etc/passwd", "../a", "a/../../b", "./a/.."] {
            assert!(!is_inside_folder(outside), "{outside}");
        }
    }
}
