//! Keeps the identifications of one plate as lines of JSON, and tests them for drift.
//!
//! The identifications have means with different, estimated errors. They are equal within these errors
//! unless Welch's test rejects this (B. L. Welch, *Biometrika* 38, 1951, pp. 330-336): with the weights
//! `w = 1/u²` of k estimates, the weighted mean m and the degrees of freedom ν of each error u,
//! `F = Σ w (x − m)² / (k − 1) / (1 + 2 (k − 2) Λ / (k² − 1))` with `Λ = Σ (1 − w/Σw)² / ν` has
//! k − 1 and `(k² − 1) / (3 Λ)` degrees of freedom. The quantities share the level (Bonferroni).

use crate::identify::{Estimate, Identification};
use jiff::civil::Date;
use platebench_document::chart::marks::{Axis, AxisValue, Mark, Point, Role, Scale, Shape, Ticks, extent};
use platebench_document::chart::panels::{LegendEntry, Panel, PanelAxis, PanelChart, Symbol};
use platebench_document::format::{NOTHING, count};
use platebench_document::{Block, Table};
use platebench_model::quoted;
use platebench_model::record::FileLock;
use platebench_model::trace::{AtPath, FileError, OutputFolder, read_text_file};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, FisherSnedecor};
use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// Probability that an unchanged plate gives an alarm.
const LEVEL: f64 = 0.05;
const VERSION: u32 = 1;
const MAX_BYTES: u64 = 64 << 20;
const TREND_DAYS: f64 = 30.0;
const PANEL: Point = (560.0, 220.0);

#[derive(Debug, thiserror::Error)]
pub enum HistoryError {
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{}:{line}: {message}", path.display())]
    Line { path: PathBuf, line: usize, message: String },
    #[error("{} is in use by another `platebench identify`; run the command again", .0.display())]
    InUse(PathBuf),
}

/// The model of the plate that explains the recordings. Its parameters have different meanings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, strum::IntoStaticStr)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum PlateModel {
    OneMode,
    SecondMode,
    SelfHeating,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct StoredEstimate {
    value: f64,
    error: f64,
    freedom: f64,
    /// Interval of 95 %, for readers of the file.
    low: f64,
    high: f64,
}

/// A line of a history. The keys of the estimates contain their units.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HistoryEntry {
    plate_history: u32,
    plate: String,
    date: String,
    model: PlateModel,
    reference_temperature_c: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    gain_um_per_vpp: Option<StoredEstimate>,
    #[serde(skip_serializing_if = "Option::is_none")]
    time_constant_s: Option<StoredEstimate>,
    #[serde(skip_serializing_if = "Option::is_none")]
    resonance_hz: Option<StoredEstimate>,
    #[serde(skip_serializing_if = "Option::is_none")]
    slope_hz_per_k: Option<StoredEstimate>,
    /// SHA-256 of each recording, by its name.
    recordings: BTreeMap<String, String>,
}

/// Name and unit on a page, factor from the unit of the file, decimals.
struct Quantity {
    key: &'static str,
    label: &'static str,
    factor: f64,
    decimals: usize,
    of: fn(&HistoryEntry) -> Option<StoredEstimate>,
}

const QUANTITIES: [Quantity; 4] = [
    Quantity { key: "gain_um_per_vpp", label: "K1, pm/V", factor: 1e6, decimals: 1, of: |entry| entry.gain_um_per_vpp },
    Quantity { key: "time_constant_s", label: "τ, ms", factor: 1e3, decimals: 4, of: |entry| entry.time_constant_s },
    Quantity { key: "resonance_hz", label: "resonance, Hz", factor: 1.0, decimals: 2, of: |entry| entry.resonance_hz },
    Quantity {
        key: "slope_hz_per_k",
        label: "resonance per kelvin, Hz/K",
        factor: 1.0,
        decimals: 3,
        of: |entry| entry.slope_hz_per_k,
    },
];

impl From<Estimate> for StoredEstimate {
    fn from(Estimate { value, error, low, high, freedom }: Estimate) -> Self {
        Self { value, error, freedom, low, high }
    }
}

impl StoredEstimate {
    fn estimate(self) -> Estimate {
        let Self { value, error, freedom, low, high } = self;
        Estimate { value, error, low, high, freedom }
    }

    fn is_valid(self) -> bool {
        let Self { value, error, freedom, low, high } = self;
        value.is_finite() && error.is_finite() && error > 0.0 && freedom >= 1.0 && low <= value && value <= high
    }
}

impl HistoryEntry {
    /// `recordings` are names with the SHA-256 of their files.
    pub fn new(
        plate: &str,
        date: Date,
        reference_temperature_c: f64,
        found: &Identification,
        recordings: BTreeMap<String, String>,
    ) -> Self {
        let model = match (&found.second_mode, &found.heating) {
            (Some(_), _) => PlateModel::SecondMode,
            (None, Some(_)) => PlateModel::SelfHeating,
            (None, None) => PlateModel::OneMode,
        };
        // An estimate without error has no weight.
        let stored = |estimate: Option<Estimate>| estimate.map(StoredEstimate::from).filter(|each| each.is_valid());
        Self {
            plate_history: VERSION,
            plate: plate.to_owned(),
            date: date.to_string(),
            model,
            reference_temperature_c,
            gain_um_per_vpp: stored(found.gain_um_per_vpp),
            time_constant_s: stored(found.time_constant_s),
            resonance_hz: stored(found.resonance_hz),
            slope_hz_per_k: stored(found.slope_hz_per_k),
            recordings,
        }
    }

    fn parse(line: &str) -> Result<Self, String> {
        let entry: Self = serde_json::from_str(line)
            .map_err(|error| format!("{error}; expected a line that `platebench identify --history` wrote"))?;
        if entry.plate_history != VERSION {
            return Err(format!("`plate_history` is {}, expected {VERSION}", entry.plate_history));
        }
        if entry.date.parse::<Date>().is_err() {
            return Err(format!("`date` is {}, expected a date like 2026-03-02", quoted(&entry.date)));
        }
        let is_invalid = |quantity: &&Quantity| (quantity.of)(&entry).is_some_and(|estimate| !estimate.is_valid());
        if let Some(Quantity { key, .. }) = QUANTITIES.iter().find(is_invalid) {
            return Err(format!("`{key}`: expected a finite value inside its interval, and an error above 0"));
        }
        Ok(entry)
    }

    /// Checks that `self`, an earlier line, can be in one history with `new`.
    fn check_next(&self, new: &Self) -> Result<(), String> {
        let different = |what: &str, before: String, now: String| Err(format!("{what} {before}, expected {now}"));
        if self.plate != new.plate {
            return different("the plate is", quoted(&self.plate).into_owned(), quoted(&new.plate).into_owned());
        }
        if self.model != new.model {
            let name = |model: PlateModel| <&str>::from(model).to_owned();
            return different("the model of the plate is", name(self.model), name(new.model));
        }
        let temperature = |entry: &Self| format!("{} °C", entry.reference_temperature_c);
        if temperature(self) != temperature(new) {
            return different("the reference temperature is", temperature(self), temperature(new));
        }
        let known: Vec<_> = self.recordings.values().collect();
        match new.recordings.iter().find(|(_, digest)| known.contains(digest)) {
            Some((name, _)) => Err(format!("contains the recording {} already, expected a new one", quoted(name))),
            None => Ok(()),
        }
    }
}

/// The lines of a file, the oldest first, and the position of the file.
#[derive(Debug, Clone, PartialEq)]
pub struct PlateHistory {
    path: PathBuf,
    entries: Vec<HistoryEntry>,
    /// False if the last line has no end.
    is_terminated: bool,
}

impl PlateHistory {
    /// A file that does not exist is an empty history.
    pub fn read(path: &Path) -> Result<Self, HistoryError> {
        let text = match read_text_file(path, MAX_BYTES) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => String::new(),
            text => text.at(path)?,
        };
        let parse = |(line, text): (usize, &str)| {
            let invalid = |message| HistoryError::Line { path: path.to_owned(), line, message };
            HistoryEntry::parse(text).map_err(invalid)
        };
        let entries = (1..).zip(text.lines()).map(parse).collect::<Result<_, _>>()?;
        Ok(Self { path: path.to_owned(), entries, is_terminated: text.is_empty() || text.ends_with('\n') })
    }

    /// Fails if the line belongs to another plate, or counts a recording twice.
    pub fn with(mut self, entry: HistoryEntry) -> Result<Self, HistoryError> {
        for (line, earlier) in (1..).zip(&self.entries) {
            let refuse = |message| HistoryError::Line { path: self.path.clone(), line, message };
            earlier.check_next(&entry).map_err(refuse)?;
        }
        self.entries.push(entry);
        Ok(self)
    }

    /// Adds a line to the file in one write, and waits until it is on the disk. After an error the file
    /// is as before.
    pub fn append(path: &Path, entry: HistoryEntry) -> Result<(), HistoryError> {
        let folder = OutputFolder::open(path.parent().unwrap_or(Path::new("")))?;
        let mut file = folder.append(path.file_name().unwrap_or_default())?;
        let _lock = FileLock::exclusive(path)?.ok_or_else(|| HistoryError::InUse(path.to_owned()))?;
        let earlier = Self::read(path)?;
        let start = if earlier.is_terminated { "" } else { "\n" };
        let line = serde_json::to_string(&entry).map_err(std::io::Error::from).at(path)?;
        earlier.with(entry)?;
        let length = file.metadata().at(path)?.len();
        let written = file.write_all(format!("{start}{line}\n").as_bytes()).and_then(|()| file.sync_all());
        if written.is_err() {
            let _ = file.set_len(length);
        }
        Ok(written.at(path)?)
    }

    pub fn analysis(&self) -> HistoryAnalysis {
        let mut quantities: Vec<_> = QUANTITIES.iter().filter_map(|quantity| self.quantity(quantity)).collect();
        let tests = quantities.iter().filter(|quantity| quantity.drift.is_some()).count();
        for drift in quantities.iter_mut().filter_map(|quantity| quantity.drift.as_mut()) {
            drift.level = LEVEL / tests as f64;
            drift.is_drift = drift.p_value < drift.level;
        }
        HistoryAnalysis { identifications: self.entries.len(), quantities }
    }

    /// `None` without an estimate.
    fn quantity(&self, quantity: &Quantity) -> Option<QuantityHistory> {
        let points = self.points(quantity);
        let estimates: Vec<Estimate> = points.iter().map(|(_, estimate)| *estimate).collect();
        let mean = Estimate::combine_independent(&estimates)?;
        Some(QuantityHistory {
            quantity: quantity.key.to_owned(),
            identifications: points.len(),
            mean,
            drift: welch_test(&estimates),
            change_in_30_days: trend(&points).map(|slope| slope.scaled(TREND_DAYS)),
        })
    }

    /// Days since the first identification, and the estimates.
    fn points(&self, quantity: &Quantity) -> Vec<(f64, Estimate)> {
        let dates: Vec<_> = self.entries.iter().filter_map(|entry| entry.date.parse::<Date>().ok()).collect();
        let Some(first) = dates.iter().min().copied() else { return Vec::new() };
        let days = dates.iter().map(|date| f64::from((*date - first).get_days()));
        let estimates = days.zip(&self.entries);
        estimates.filter_map(|(day, entry)| Some((day, (quantity.of)(entry)?.estimate()))).collect()
    }

    /// The table, and a figure that the console omits.
    pub fn blocks(&self, analysis: &HistoryAnalysis) -> Vec<Block> {
        let dates: Vec<_> = self.entries.iter().map(|entry| entry.date.as_str()).collect();
        let plate = self.entries.last().map_or("", |entry| &entry.plate);
        let [first, last] = [dates.iter().min(), dates.iter().max()].map(|date| date.copied().unwrap_or_default());
        let identifications = count(analysis.identifications, "identification");
        let heading = format!("History of {}: {identifications}, {first} to {last}", quoted(plate));
        let columns = ["quantity", "identifications", "weighted mean", "change in 30 days", "F", "p", "drift"];
        let mut table = Table::new(columns);
        table.extend(analysis.quantities.iter().filter_map(QuantityHistory::row));
        let rule = format!(
            "Drift: Welch's test of equal means (Biometrika 38, 1951), at a level of {} % for all quantities together. \
             The change is that of a weighted line, with its interval of 95 %.",
            LEVEL * 100.0
        );
        let figure = Block::figure(self.chart().svg(), "Estimates with intervals of 95 %, and their weighted mean");
        vec![Block::Heading(heading), Block::Table(table), Block::Paragraph(rule), figure]
    }

    fn chart(&self) -> PanelChart {
        PanelChart {
            title: "History of the plate".to_owned(),
            has_heading: false,
            panel_size: PANEL,
            columns: 1,
            panels: QUANTITIES.iter().filter_map(|quantity| self.panel(quantity)).collect(),
            legend: vec![
                LegendEntry::new(Symbol::Point(Role::First, Shape::Disc), "estimate, 95 %"),
                LegendEntry::new(Symbol::Line(Role::Golden), "weighted mean"),
            ],
        }
    }

    fn panel(&self, quantity: &Quantity) -> Option<Panel> {
        let scaled = |(day, estimate): (f64, Estimate)| (day, estimate.scaled(quantity.factor));
        let points: Vec<_> = self.points(quantity).into_iter().map(scaled).collect();
        let mean = Estimate::combine_independent(&points.iter().map(|(_, estimate)| *estimate).collect::<Vec<_>>())?;
        let (low, high) = extent(points.iter().flat_map(|(_, estimate)| [estimate.low, estimate.high]))?;
        let margin = ((high - low) * 0.08).max(f64::EPSILON * high.abs()).max(f64::MIN_POSITIVE);
        let last = points.iter().map(|(day, _)| *day).fold(1.0, f64::max);
        let axis = |label: &str, values: std::ops::Range<f64>, decimals: usize| {
            let ticks = |axis: &Axis| Ticks::new(axis.ticks(6), true, |value| format!("{value:.decimals$}"));
            PanelAxis::new(label, Scale::Linear, values, ticks)
        };
        let marks = points.iter().flat_map(|(day, estimate)| {
            let interval = Mark::Line(Role::First, vec![(*day, estimate.low), (*day, estimate.high)]);
            [interval, Mark::point(Role::First, (*day, estimate.value), Shape::Disc, 4.0)]
        });
        let mean = Mark::Limit { role: Role::Golden, at: AxisValue::Y(mean.value), text: None };
        Some(Panel {
            title: quantity.label.to_owned(),
            x: axis("days since the first identification", -0.03 * last..1.03 * last, 0),
            y: axis("", low - margin..high + margin, quantity.decimals),
            cells: vec![mean],
            marks: marks.collect(),
        })
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct HistoryAnalysis {
    pub identifications: usize,
    pub quantities: Vec<QuantityHistory>,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct QuantityHistory {
    pub quantity: String,
    pub identifications: usize,
    /// Weighted with the inverse variances.
    pub mean: Estimate,
    /// Absent for one identification.
    pub drift: Option<DriftTest>,
    /// By a weighted line. Absent for fewer than three identifications, or on one day.
    pub change_in_30_days: Option<Estimate>,
}

/// Welch's test of equal means.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct DriftTest {
    pub statistic: f64,
    pub freedom: [f64; 2],
    /// Probability of a statistic at least this large if the plate did not change.
    pub p_value: f64,
    /// Probability below which the plate has changed.
    pub level: f64,
    pub is_drift: bool,
}

impl HistoryAnalysis {
    /// A line per quantity that changed more than its intervals explain.
    pub fn drifts(&self) -> impl Iterator<Item = String> {
        self.quantities.iter().filter_map(|quantity| {
            let DriftTest { statistic, p_value, level, .. } = quantity.drift.filter(|drift| drift.is_drift)?;
            Some(format!(
                "drift of {}: its {} identifications differ more than their intervals explain (F = {statistic:.3}, \
                 p = {p_value:.2e}, level {level:.3})",
                quantity.quantity, quantity.identifications
            ))
        })
    }
}

impl QuantityHistory {
    fn row(&self) -> Option<[String; 7]> {
        let Quantity { label, factor, decimals, .. } = QUANTITIES.iter().find(|named| named.key == self.quantity)?;
        let estimate = |estimate: Estimate, decimals: usize| {
            let Estimate { value, low, high, .. } = estimate.scaled(*factor);
            format!("{value:.decimals$} ± {:.decimals$}", (high - low) / 2.0)
        };
        let nothing = || NOTHING.to_owned();
        Some([
            (*label).to_owned(),
            self.identifications.to_string(),
            estimate(self.mean, *decimals),
            self.change_in_30_days.map_or_else(nothing, |change| estimate(change, decimals + 1)),
            self.drift.map_or_else(nothing, |drift| format!("{:.2}", drift.statistic)),
            self.drift.map_or_else(nothing, |drift| format!("{:.2e}", drift.p_value)),
            self.drift.map_or_else(nothing, |drift| if drift.is_drift { "yes" } else { "no" }.to_owned()),
        ])
    }
}

/// `None` for fewer than two estimates.
pub fn welch_test(estimates: &[Estimate]) -> Option<DriftTest> {
    let k = estimates.len() as f64;
    if estimates.len() < 2 {
        return None;
    }
    let weight = |estimate: &Estimate| estimate.error.powi(-2);
    let sum: f64 = estimates.iter().map(weight).sum();
    let mean = Estimate::combine_independent(estimates)?.value;
    let between = estimates.iter().map(|each| weight(each) * (each.value - mean).powi(2)).sum::<f64>() / (k - 1.0);
    let lambda: f64 = estimates.iter().map(|each| (1.0 - weight(each) / sum).powi(2) / each.freedom).sum();
    let squares = k * k - 1.0;
    let statistic = between / (1.0 + 2.0 * (k - 2.0) * lambda / squares);
    let freedom = [k - 1.0, squares / (3.0 * lambda)];
    let p_value = FisherSnedecor::new(freedom[0], freedom[1]).ok()?.sf(statistic);
    Some(DriftTest { statistic, freedom, p_value, level: LEVEL, is_drift: p_value < LEVEL })
}

/// Slope of a weighted line, per day. Its error grows if the estimates scatter more than their errors.
fn trend(points: &[(f64, Estimate)]) -> Option<Estimate> {
    let freedom = points.len().checked_sub(2).filter(|freedom| *freedom > 0)? as f64;
    let weighted = |of: &dyn Fn(&(f64, Estimate)) -> f64| -> f64 {
        points.iter().map(|point| of(point) * point.1.error.powi(-2)).sum()
    };
    let sum = weighted(&|_| 1.0);
    let [day, value] = [weighted(&|point| point.0) / sum, weighted(&|point| point.1.value) / sum];
    let squares = weighted(&|point| (point.0 - day).powi(2));
    let slope = weighted(&|point| (point.0 - day) * (point.1.value - value)) / squares;
    let misfit = weighted(&|point| (point.1.value - value - slope * (point.0 - day)).powi(2));
    let error = (1.0 / squares).sqrt() * (misfit / freedom).sqrt().max(1.0);
    error.is_finite().then(|| Estimate::new(slope, error, freedom))
}

#[cfg(test)]
mod tests;
