//! Compares trials with accepted responses. A baseline is `<scenario>.csv` with curves and
//! `<scenario>.toml` with tolerances.

mod learn;
mod tubes;

use crate::tube::{TUBE_SIGNALS, Tolerance, Tube, TubePoint, TubeSignal};
use platebench_model::record::{RunRecord, ScenarioRecord, sha256};
use platebench_model::trace::{AtPath, FileError, OutputFolder, Row, read_text_file};
use schemars::JsonSchema;
use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use tubes::thin;

pub use learn::LearnError;
pub use tubes::{GoldenTubes, TubeComparison, TubeMatch, gap_between_rows, row_step_ms};

const WIDTH: &str = "_width";
const TIME: &str = "t_ms";
const MAX_BYTES: u64 = 64 << 20;

#[derive(Debug, thiserror::Error)]
pub enum BaselineError {
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{}:{line}: {message}", path.display())]
    Content { path: PathBuf, line: usize, message: String },
}

#[derive(Debug, Clone, PartialEq)]
pub struct Baseline {
    pub scenario: String,
    pub response: JudgedResponse,
    pub learned: Option<LearningParameters>,
    pub golden: GoldenTubes,
}

/// The controller of a response, and what its scenario judged.
#[derive(Debug, Clone, PartialEq)]
pub struct JudgedResponse {
    pub law: String,
    pub build: BaselineBuild,
    /// Rounded values by key of the expectation. `None` in a baseline of an earlier version.
    pub values: Option<BTreeMap<String, f64>>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BaselineBuild {
    pub rig: String,
    pub firmware: String,
    pub id: String,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LearningParameters {
    pub trials: u32,
    pub false_alarm_rate: f64,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct BaselineHeader {
    scenario: String,
    law: String,
    curves_sha256: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    step_ms: Option<f64>,
    build: BaselineBuild,
    #[serde(skip_serializing_if = "Option::is_none")]
    judged: Option<BTreeMap<String, f64>>,
    /// Numbers of the first trial in files of earlier versions.
    #[serde(default, rename = "features", skip_serializing)]
    _features: IgnoredAny,
    #[serde(skip_serializing_if = "Option::is_none")]
    learned: Option<LearningParameters>,
    tolerance: BTreeMap<String, Tolerance>,
}

impl JudgedResponse {
    pub fn of(record: &RunRecord, scenario: &ScenarioRecord) -> Self {
        let firmware = record.rig.firmware.as_ref();
        let build = BaselineBuild {
            rig: record.rig.name.clone(),
            firmware: firmware.map_or_else(String::new, |firmware| format!("{} {}", firmware.name, firmware.version)),
            id: firmware.map_or_else(String::new, |firmware| firmware.build.clone()),
        };
        Self { law: scenario.law.clone(), build, values: Some(judged_values(scenario)) }
    }
}

/// Rounded value of each expectation that has one, by its key.
pub fn judged_values(scenario: &ScenarioRecord) -> BTreeMap<String, f64> {
    let values = (0..).zip(&scenario.expectations).map(|(index, judged)| (scenario.metric_key(index), judged.value));
    values.filter_map(|(key, value)| Some((key, rounded(value?)))).collect()
}

/// Four significant digits and at most four decimals, so that another processor or compiler gives
/// the same text.
fn rounded(value: f64) -> f64 {
    let significant = format!("{value:.3e}").parse().unwrap_or(value);
    // A division gives the double nearest to the decimal number. The sum has no negative zero.
    (significant * 1e4).round() / 1e4 + 0.0
}

impl GoldenTubes {
    /// Removes unnecessary points from the curves, which are compared every `step_ms`.
    pub fn from_trial(rows: &[Row], step_ms: f64) -> Option<Self> {
        let mut golden = Self { step_ms: Some(step_ms), ..Self::from_rows(rows)? };
        thin(&mut golden.tubes);
        Some(golden)
    }
}

fn baseline_path(folder: &Path, scenario: &str, extension: &str) -> PathBuf {
    folder.join(format!("{}.{extension}", scenario.strip_suffix(".toml").unwrap_or(scenario)))
}

impl Baseline {
    pub fn to_texts(&self) -> [String; 2] {
        let tubes = &self.golden.tubes;
        let is_learned = self.learned.is_some();
        let names = tubes.iter().map(|tube| tube.signal.clone());
        let widths = tubes.iter().filter(|_| is_learned).map(|tube| format!("{}{WIDTH}", tube.signal));
        let mut table = std::iter::once(TIME.to_owned()).chain(names).chain(widths).collect::<Vec<_>>().join(",");
        table.push('\n');
        let count = tubes.first().map_or(0, |tube| tube.points.len());
        for index in 0..count {
            let points = || tubes.iter().filter_map(|tube| Some((tube, tube.points.get(index)?)));
            let decimals = |tube: &Tube| TubeSignal::from_name(&tube.signal).map_or(6, |signal| signal.decimals);
            let t_ms = points().next().map_or(0.0, |(_, point)| point.t_ms);
            table.push_str(&format_decimal(t_ms, 6));
            for (tube, point) in points() {
                let _ = write!(table, ",{}", format_decimal(point.value, decimals(tube)));
            }
            for (tube, point) in points().filter(|_| is_learned) {
                let _ = write!(table, ",{}", format_decimal(point.width, decimals(tube)));
            }
            table.push('\n');
        }
        let head = BaselineHeader {
            scenario: self.scenario.clone(),
            law: self.response.law.clone(),
            curves_sha256: sha256(table.as_bytes()),
            step_ms: self.golden.step_ms,
            build: self.response.build.clone(),
            judged: self.response.values.clone(),
            _features: IgnoredAny,
            learned: self.learned.clone(),
            tolerance: tubes.iter().map(|tube| (tube.signal.clone(), tube.tolerance)).collect(),
        };
        // Cannot fail, because the header contains only strings, numbers and tables with names.
        [toml::to_string(&head).unwrap_or_default(), table]
    }

    /// The TOML file has the hash of the CSV file, so a reader detects if only one was replaced.
    pub fn write(&self, folder: &Path) -> Result<(), BaselineError> {
        let folder = OutputFolder::create(folder)?;
        let [head, table] = self.to_texts();
        for (extension, text) in [("csv", table), ("toml", head)] {
            folder.write(baseline_path(Path::new(""), &self.scenario, extension), text)?;
        }
        Ok(())
    }

    /// `None` if there is no baseline. Fails if one of its two files is missing or invalid.
    pub fn read(folder: &Path, scenario: &str) -> Result<Option<Self>, BaselineError> {
        let (head, table) = (baseline_path(folder, scenario, "toml"), baseline_path(folder, scenario, "csv"));
        if !head.exists() && !table.exists() { Ok(None) } else { Self::read_files(&head, &table).map(Some) }
    }

    pub fn read_files(head_path: &Path, table_path: &Path) -> Result<Self, BaselineError> {
        let text = |path: &Path| read_text_file(path, MAX_BYTES).at(path);
        let (head, table) = (text(head_path)?, text(table_path)?);
        let content_error = |line, message| BaselineError::Content { path: head_path.to_owned(), line, message };
        let parsed: BaselineHeader = toml::from_str(&head).map_err(|error| {
            let before = error.span().and_then(|span| head.get(..span.start)).unwrap_or_default();
            content_error(before.matches('\n').count() + 1, error.message().to_owned())
        })?;
        let line_of = |key: &str| head.lines().position(|line| line.contains(key)).map_or(1, |index| index + 1);
        for (signal, tolerance) in &parsed.tolerance {
            let Tolerance { absolute, relative, time_ms } = *tolerance;
            let line = line_of(&format!("tolerance.{signal}"));
            if TubeSignal::from_name(signal).is_none() {
                let known = TUBE_SIGNALS.iter().map(TubeSignal::name).collect::<Vec<_>>().join(", ");
                return Err(content_error(line, format!("tolerance of `{signal}`, expected one of {known}")));
            }
            let fits = absolute > 0.0
                && absolute.is_finite()
                && (0.0..1.0).contains(&relative)
                && (0.0..1e6).contains(&time_ms);
            if !fits {
                let message = format!(
                    "tolerance of {signal}: absolute {absolute}, relative {relative}, time_ms {time_ms}; expected \
                     absolute above 0 (the tolerance near zero), relative from 0 to 1, and time_ms of 0 or more"
                );
                return Err(content_error(line, message));
            }
        }
        let rate = parsed.learned.as_ref().map(|learned| learned.false_alarm_rate);
        if rate.is_some_and(|rate| !(rate > 0.0 && rate < 1.0)) {
            return Err(content_error(
                line_of("false_alarm_rate"),
                "expected a false-alarm rate above 0 and below 1".to_owned(),
            ));
        }
        if parsed.step_ms.is_some_and(|step| !(1e-6..1e6).contains(&step)) {
            return Err(content_error(line_of("step_ms"), "expected a step from 1e-6 to 1e6 ms".to_owned()));
        }
        let tubes = parse_tubes(&parsed, table_path, &table)?;
        if parsed.curves_sha256 != sha256(table.as_bytes()) {
            let message = format!("the curves in {} changed; accept the baseline again", table_path.display());
            return Err(content_error(line_of("curves_sha256"), message));
        }
        Ok(Self {
            scenario: parsed.scenario,
            response: JudgedResponse { law: parsed.law, build: parsed.build, values: parsed.judged },
            learned: parsed.learned,
            golden: GoldenTubes { tubes, step_ms: parsed.step_ms, false_alarm_rate: rate },
        })
    }
}

fn parse_tubes(head: &BaselineHeader, path: &Path, table: &str) -> Result<Vec<Tube>, BaselineError> {
    let content_error = |line: usize, message: String| BaselineError::Content { path: path.to_owned(), line, message };
    let mut lines = (1..).zip(table.lines()).filter(|(_, line)| !line.trim().is_empty());
    let columns: Vec<&str> = lines.next().map(|(_, line)| line.split(',').collect()).unwrap_or_default();
    if columns.first() != Some(&TIME) {
        return Err(content_error(1, format!("the first column is not `{TIME}`")));
    }
    let column = |name: &str| columns.iter().position(|column| *column == name);
    if let Some((second, name)) = columns.iter().enumerate().find(|(place, name)| column(name) != Some(*place)) {
        let (first, second) = (column(name).map_or(1, |first| first + 1), second + 1);
        return Err(content_error(
            1,
            format!("columns {first} and {second} both have the title `{name}`, expected one"),
        ));
    }
    let known = |name: &str| {
        head.tolerance.contains_key(name)
            || name.strip_suffix(WIDTH).is_some_and(|name| head.tolerance.contains_key(name))
    };
    if let Some(strange) = columns.iter().skip(1).find(|name| !known(name)) {
        return Err(content_error(1, format!("column `{strange}` has no tolerance")));
    }
    let mut tubes = Vec::new();
    for signal in TUBE_SIGNALS.iter().filter(|signal| head.tolerance.contains_key(signal.name())) {
        let Some(value) = column(signal.name()) else {
            return Err(content_error(1, format!("no column `{}`, expected one for each tolerance", signal.name())));
        };
        let width = column(&format!("{}{WIDTH}", signal.name()));
        if width.is_some() != head.learned.is_some() {
            return Err(content_error(
                1,
                format!(
                    "the table [learned] needs a column `{}{WIDTH}`, and this column needs the table",
                    signal.name()
                ),
            ));
        }
        let tolerance = head.tolerance.get(signal.name()).copied().unwrap_or(signal.tolerance);
        tubes.push((Tube { signal: signal.name().to_owned(), tolerance, points: Vec::new() }, value, width));
    }
    let mut before = f64::NEG_INFINITY;
    for (line, text) in lines {
        let numbers = text.split(',').map(|field| field.trim().parse::<f64>().ok().filter(|number| number.is_finite()));
        let numbers: Option<Vec<f64>> = numbers.collect();
        let Some(numbers) = numbers.filter(|numbers| numbers.len() == columns.len()) else {
            return Err(content_error(line, format!("expected {} finite numbers", columns.len())));
        };
        let of = |index: usize| numbers.get(index).copied().unwrap_or_default();
        let t_ms = of(0);
        if t_ms < before {
            return Err(content_error(
                line,
                format!("`{TIME}` is {t_ms}, expected a time that is not before the row above"),
            ));
        }
        before = t_ms;
        for (tube, value, width) in &mut tubes {
            let width = width.map_or(0.0, of);
            if width < 0.0 {
                return Err(content_error(line, format!("a width of {width}, expected 0 or more")));
            }
            tube.points.push(TubePoint { t_ms, value: of(*value), width });
        }
    }
    if tubes.first().is_none_or(|(tube, ..)| tube.points.is_empty()) {
        return Err(content_error(2, "no rows or no signals, expected at least one of each".to_owned()));
    }
    Ok(tubes.into_iter().map(|(tube, ..)| tube).collect())
}

/// Formats with at most `decimals` decimals, without trailing zeros.
fn format_decimal(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

#[cfg(test)]
mod tests;
