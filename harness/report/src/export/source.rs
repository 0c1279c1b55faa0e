//! Reads a scenario of a run for export: the columns of its rows, the traces of its trials, and metadata.
//! Each flag is a column, so that programs can filter by it. Defines the errors of an export.

use crate::page::RowCache;
use platebench_model::record::{RECORD_FILE, RunRecord, ScenarioRecord};
use platebench_model::trace::{Column, FileError, Flags, OPTIONAL_COLUMNS, Row, TraceError, TraceReader};
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
pub(crate) struct ExportTrial<'a> {
    pub(crate) index: u32,
    pub(crate) seed: u64,
    trace: PathBuf,
    /// The rows, if they were read already.
    rows: Option<&'a [Row]>,
}

impl ExportTrial<'_> {
    pub(crate) fn rows(&self) -> Result<impl Iterator<Item = Result<Row, ExportError>>, ExportError> {
        let stored = self.rows.is_none().then(|| TraceReader::open(&self.trace)).transpose()?;
        let stored = stored.into_iter().flatten().map(|row| row.map_err(ExportError::from));
        Ok(self.rows.into_iter().flatten().copied().map(Ok).chain(stored))
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
    pub(crate) trials: Vec<ExportTrial<'a>>,
}

impl<'a> ExportScenario<'a> {
    /// Also returns the number of trials without a trace.
    pub(crate) fn of(
        run: &'a RunRecord,
        scenario: &'a ScenarioRecord,
        folder: &Path,
        rows: &'a RowCache,
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
                let rows = rows.get(&trial.trace);
                trials.push(ExportTrial { index: trial.index, seed: trial.seed, trace, rows });
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

#[derive(Debug, Clone, Copy)]
pub struct Number {
    pub column: Column,
    pub unit: &'static str,
    pub meaning: &'static str,
}

impl Number {
    pub const fn name(&self) -> &'static str {
        self.column.name()
    }

    /// True if the number is unknown for a real plate.
    pub fn can_be_unknown(&self) -> bool {
        OPTIONAL_COLUMNS.contains(&self.column)
    }

    /// True if the value holds until the next row.
    pub fn is_held(&self) -> bool {
        let held = [Column::Setpoint, Column::Drive, Column::Frequency, Column::SensedWd, Column::SensedWq];
        held.contains(&self.column)
    }

    pub fn known_value(&self, row: &Row) -> Option<f64> {
        Some(self.column.value(row)).filter(|value| !value.is_nan())
    }
}

#[derive(Debug, Clone, Copy)]
pub struct FlagColumn {
    /// Name of the flag in the trace, with `_` instead of `-`.
    pub name: &'static str,
    pub meaning: &'static str,
    pub flag: Flags,
}

const fn number(column: Column, unit: &'static str, meaning: &'static str) -> Number {
    Number { column, unit, meaning }
}

/// Time is the first column. Amplitudes and voltages are peak to peak.
pub const NUMBER_COLUMNS: [Number; 13] = [
    number(Column::Time, "s", "time since the start of the trial"),
    number(Column::Setpoint, "µm", "setpoint of the amplitude"),
    number(Column::Wd, "µm", "in-phase component Wd of the plate's vibration"),
    number(Column::Wq, "µm", "quadrature component Wq of the plate's vibration"),
    number(Column::Amplitude, "µm", "amplitude |W| of the plate's vibration"),
    number(Column::Drive, "V", "drive from this instant on, peak to peak"),
    number(Column::Frequency, "Hz", "excitation frequency from this instant on"),
    number(Column::Resonance, "Hz", "the plate's true resonance frequency"),
    number(Column::Temperature, "K", "temperature above the plate's reference"),
    number(Column::Force, "N", "normal force of the finger"),
    number(Column::SensedWd, "µm", "last in-phase component sent to the controller"),
    number(Column::SensedWq, "µm", "last quadrature component sent to the controller"),
    number(Column::Lateness, "µs", "lateness of the bench at this instant"),
];

pub const FLAG_COLUMNS: [FlagColumn; 6] = [
    FlagColumn {
        name: "control",
        meaning: "control instant: this state was sent to the controller",
        flag: Flags::CONTROL,
    },
    FlagColumn { name: "saturated", meaning: "the drive is at the amplifier's limit", flag: Flags::SATURATED },
    FlagColumn { name: "overrun", meaning: "the bench was too late for this instant", flag: Flags::OVERRUN },
    FlagColumn { name: "link_lost", meaning: "no answer, the last drive is held", flag: Flags::LINK_LOST },
    FlagColumn { name: "safe", meaning: "the controller is not running: 0 V", flag: Flags::SAFE },
    FlagColumn {
        name: "sensed",
        meaning: "reported by a controller with its own plate: motion from its sensor, unknown numbers missing",
        flag: Flags::SENSED,
    },
];

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_model::trace::COLUMNS;

    #[test]
    fn rejects_paths_outside_the_folder() {
        for inside in ["a", "paper/fig13", "a/b/c.csv"] {
            assert!(is_inside_folder(inside), "{inside}");
        }
        for outside in ["", "/etc/passwd", "../a", "a/../../b", "./a/.."] {
            assert!(!is_inside_folder(outside), "{outside}");
        }
    }

    #[test]
    fn contains_every_column_of_a_trace() {
        let names: Vec<_> = NUMBER_COLUMNS.iter().map(Number::name).chain(["flags"]).collect();
        assert_eq!(names, COLUMNS);
        let optional: Vec<_> =
            NUMBER_COLUMNS.iter().filter(|number| number.can_be_unknown()).map(Number::name).collect();
        assert_eq!(optional, ["resonance_hz", "temperature_offset_k", "finger_force_n"]);
        let all = FLAG_COLUMNS.iter().fold(Flags::empty(), |all, column| all | column.flag);
        assert_eq!((all, FLAG_COLUMNS.len()), (Flags::all(), Flags::all().iter().count()));
    }

    #[test]
    fn a_name_ends_in_its_unit() {
        for number in NUMBER_COLUMNS {
            let (name, unit) = (number.name(), number.unit);
            let expected = match name.rsplit_once('_').unwrap().1 {
                "um" => "µm",
                "us" => "µs",
                "vpp" => "V",
                "hz" => "Hz",
                other => &other.to_uppercase(),
            };
            assert!(unit == expected || unit.to_uppercase() == expected, "{name} in {unit}");
        }
    }
}
