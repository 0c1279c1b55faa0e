//! Reads each trace of a scenario once and samples it. Lists unreadable traces instead of failing.

use super::curves;
use super::golden::GoldenDifference;
use super::grid::TimeGrid;
use super::kept_rows::RowCache;
use super::limit_marks::LimitMark;
use super::markers::{self, Settling, TimeMarker};
use super::resolution::PlotResolution;
use crate::chart::marks::Point;
use crate::chart::time::TimeWindow;
use crate::record_queries;
use platebench_model::metrics::Levels;
use platebench_model::record::{Metric, ScenarioRecord, TrialRecord, Verdict};
use platebench_model::trace::{Column, Flags, Row, TraceError};
use platebench_verdict::golden::{Baseline, ResponseFeatures};
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The page shows this many trials, and those that decided a verdict.
pub const MAX_TRIALS: usize = 30;
pub(crate) const TRACE_CHANGED: &str = "changed after the run";
/// Largest number of missed expectations whose limits the figures contain.
const MAX_LIMITS: usize = 6;
const MAX_OVERRUN_MARKS: usize = 200;

#[derive(Debug, Clone, Default)]
pub(crate) struct TraceData {
    /// Missed limits, differences from the baseline, the response, and last the whole trial. Empty
    /// if there is no trace.
    pub(crate) views: Vec<View>,
    /// Limits of the expectations that did not pass, or else of the one with the smallest margin.
    pub(crate) limits: Vec<LimitMark>,
    /// Index of the trial that is drawn as a line.
    pub(crate) first_trial: u32,
    pub(crate) golden: GoldenDifference,
    /// Other trials that decided missed expectations, with the metrics of these expectations.
    pub(crate) deciding_trials: Vec<(u32, String)>,
    pub(crate) trial_count: usize,
    pub(crate) markers: Vec<TimeMarker>,
    /// Traces without a plot, each with the reason.
    pub(crate) unreadable: Vec<String>,
    pub(crate) band: Option<Band>,
    /// Overshoot of the first trial before the finger or the next setpoint changes it.
    pub(crate) overshoot_percent: Option<f64>,
    pub(crate) grid: TimeGrid,
    pub(crate) sampled_trials: Vec<SampledTrial>,
    pub(crate) saturated: Vec<TimeWindow>,
    pub(crate) link_lost: Vec<TimeWindow>,
    /// Instants of overruns in all trials, ms.
    pub(crate) overruns: Vec<f64>,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct View {
    pub(crate) name: String,
    pub(crate) window: TimeWindow,
}

#[derive(Debug, Clone)]
pub(crate) struct SampledTrial {
    pub(crate) index: u32,
    /// Values of each signal, with every peak.
    pub(crate) peak_lines: BTreeMap<Column, Vec<Option<f64>>>,
    /// Values of each signal exactly at the instants of the grid.
    pub(crate) values: BTreeMap<Column, Vec<Option<f64>>>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Band {
    /// Half width in percent of the setpoint.
    pub(crate) percent: f64,
    /// True if the band is for Wd or Wq instead of |W|.
    pub(crate) is_for_components: bool,
}

impl Band {
    /// `side` is 1 above and -1 below the setpoint.
    pub(crate) fn edge(self, setpoint: f64, side: f64) -> f64 {
        setpoint + side * setpoint.abs() * self.percent / 100.0
    }
}

impl TraceData {
    pub(crate) fn read(
        scenario: &ScenarioRecord,
        folder: &Path,
        rows: &RowCache,
        resolution: PlotResolution,
        changed: &BTreeSet<String>,
        golden: Option<&Baseline>,
    ) -> Self {
        let mut data = Self::default();
        let read = |trial: &TrialRecord| {
            let read = |()| platebench_model::trace::read_trace(&folder.join(&trial.trace)).map(Cow::Owned);
            rows.get(&trial.trace).map(Cow::Borrowed).ok_or(()).or_else(read)
        };
        let shown = marked_expectations(scenario);
        for (index, trial) in &shown {
            let Some(expectation) = scenario.expectations.get(*index) else { continue };
            if !changed.contains(&trial.trace)
                && let Ok(rows) = read(trial)
            {
                let is_missed = expectation.verdict != Verdict::Pass;
                // The figures draw band and deadline of a passed settling or recovery time anyway.
                let has_band = expectation.metric.spec().mark.is_some_and(|mark| mark.levels == Levels::Band);
                if is_missed || !has_band {
                    data.limits.extend(LimitMark::new(expectation, is_missed, &rows));
                }
            }
        }
        let deciding = deciding_trials(scenario, &shown);
        for (position, trial) in scenario.trials.iter().enumerate() {
            if position >= MAX_TRIALS && !deciding.iter().any(|(index, _)| *index == trial.index) {
                continue;
            }
            if changed.contains(&trial.trace) {
                data.unreadable.push(format!("{}: {TRACE_CHANGED}", trial.trace));
                continue;
            }
            match read(trial) {
                Ok(rows) => {
                    if let Some(golden) = golden.filter(|_| data.views.is_empty()) {
                        data.golden = GoldenDifference::find(golden, &rows);
                    }
                    data.add_trial(scenario, trial, &rows, resolution);
                }
                Err(error) => data.unreadable.push(format!("{}: {}", trial.trace, trace_error_reason(&error))),
            }
        }
        data.deciding_trials = deciding;
        data.deciding_trials.retain(|(index, _)| {
            *index != data.first_trial && data.sampled_trials.iter().any(|trial| trial.index == *index)
        });
        data
    }

    pub(crate) fn first_trial_on(&self, grid: &TimeGrid) -> Option<SampledTrial> {
        let first = self.sampled_trials.first()?;
        let resample = |signal: Column, line: &Vec<Option<f64>>| {
            let known = self.grid.t_ms.iter().zip(line).filter_map(|(t_ms, value)| Some((*t_ms, (*value)?)));
            let known: Vec<Point> = known.collect();
            grid.t_ms.iter().map(|t_ms| curves::interpolate(&known, signal, *t_ms)).collect()
        };
        let lines = first.peak_lines.iter().map(|(signal, line)| (*signal, resample(*signal, line))).collect();
        Some(SampledTrial { index: first.index, peak_lines: lines, values: BTreeMap::new() })
    }

    fn add_trial(&mut self, scenario: &ScenarioRecord, trial: &TrialRecord, rows: &[Row], resolution: PlotResolution) {
        if self.views.is_empty() {
            self.add_first_trial(scenario, trial, rows, resolution);
        }
        for (windows, flag) in [(&mut self.saturated, Flags::SATURATED), (&mut self.link_lost, Flags::LINK_LOST)] {
            let found = curves::flagged_windows(rows, flag);
            *windows = curves::merge_windows(std::mem::take(windows).into_iter().chain(found).collect());
        }
        let room = MAX_OVERRUN_MARKS.saturating_sub(self.overruns.len());
        self.overruns.extend(curves::overrun_instants(rows).take(room));
        let rows = self.grid.align(rows);
        let signals = curves::PLOTTED_COLUMNS.into_iter();
        self.sampled_trials.push(SampledTrial {
            index: trial.index,
            peak_lines: signals.clone().map(|signal| (signal, rows.sample_peaks(signal))).collect(),
            values: signals.map(|signal| (signal, rows.sample(signal))).collect(),
        });
        self.trial_count += 1;
    }

    fn add_first_trial(
        &mut self,
        scenario: &ScenarioRecord,
        trial: &TrialRecord,
        rows: &[Row],
        resolution: PlotResolution,
    ) {
        self.first_trial = trial.index;
        self.overshoot_percent = ResponseFeatures::of(rows_before_touch(rows)).overshoot_percent;
        let steps = curves::setpoint_steps_ms(rows);
        let expected = markers::settling_expectation(scenario);
        let definition = expected.and_then(|index| Some(&scenario.expectations.get(index)?.definition));
        self.band = definition.and_then(|definition| {
            let is_for_components = definition.signal.as_ref().is_some_and(|signal| signal != "amplitude_um");
            Some(Band { percent: definition.band_percent?, is_for_components })
        });
        let settling = expected.map_or(Settling::Unknown, |index| markers::settling(scenario, trial, index, &steps));
        self.markers = markers::time_markers(scenario, trial, settling, expected, &steps);
        let whole = whole_window(rows);
        let response = response_window(scenario, settling, whole);
        let view = |name: &str, window: TimeWindow| View { name: name.to_owned(), window };
        let missed = self.limits.iter().filter(|limit| limit.is_missed);
        let missed = missed.filter_map(|limit| Some(view(&limit.name, limit.view(whole)?)));
        let different = self.golden.exceedances.iter().map(|worst| {
            let half_ms = (0.05 * whole.span_ms()).max(5.0);
            let (from_ms, to_ms) = ((worst.t_ms - half_ms).max(whole.from_ms), (worst.t_ms + half_ms).min(whole.to_ms));
            view(&format!("golden {}", worst.signal), TimeWindow { from_ms, to_ms })
        });
        self.views = missed.chain(different).chain(response.map(|window| view("Response", window))).collect();
        let fine = self.views.first().map(|first| first.window);
        self.views.push(view("Whole trial", whole));
        self.grid = TimeGrid::new(rows, whole, fine, resolution.instants);
    }
}

/// Expectations whose limits are drawn, with the trial that decided.
fn marked_expectations(scenario: &ScenarioRecord) -> Vec<(usize, &TrialRecord)> {
    let mut shown: Vec<usize> = record_queries::indices_not_passed(scenario).take(MAX_LIMITS).collect();
    if shown.is_empty() {
        shown.extend(record_queries::closest_expectation(scenario));
    }
    let decided = |index| Some((index, record_queries::deciding_trial(scenario, index)?));
    shown.into_iter().filter_map(decided).collect()
}

/// Each trial occurs once, with its missed metrics.
fn deciding_trials(scenario: &ScenarioRecord, shown: &[(usize, &TrialRecord)]) -> Vec<(u32, String)> {
    let mut found: Vec<(u32, String)> = Vec::new();
    for (index, trial) in shown {
        if scenario.expectations.get(*index).is_none_or(|expectation| expectation.verdict == Verdict::Pass) {
            continue;
        }
        let key = scenario.metric_key(*index);
        match found.iter_mut().find(|(number, _)| *number == trial.index) {
            Some((_, keys)) => *keys = format!("{keys}, {key}"),
            None => found.push((trial.index, key)),
        }
    }
    found
}

/// Rows up to the first change of the finger force after the first setpoint step.
fn rows_before_touch(rows: &[Row]) -> &[Row] {
    let is_step = |[a, b]: &[Row; 2]| a.setpoint_um != b.setpoint_um;
    let is_touch = |[a, b]: &[Row; 2]| (a.finger_force_n - b.finger_force_n).abs() > 0.0;
    let step = rows.array_windows().position(is_step).map_or(0, |before| before + 1);
    let after = rows.get(step..).unwrap_or_default();
    let count = after.array_windows().position(is_touch).map_or(after.len(), |before| before + 1);
    rows.get(..step + count).unwrap_or(rows)
}

fn whole_window(rows: &[Row]) -> TimeWindow {
    let ms = |row: Option<&Row>| row.map_or(0.0, |row| row.t_s * 1e3);
    let (from_ms, to_ms) = (ms(rows.first()), ms(rows.last()));
    TimeWindow { from_ms, to_ms: if to_ms > from_ms { to_ms } else { from_ms + 1.0 } }
}

/// Window of four settling times; `None` unless the trial is more than three times as long.
fn response_window(scenario: &ScenarioRecord, settling: Settling, whole: TimeWindow) -> Option<TimeWindow> {
    let Settling::At { instant_ms, after_ms } = settling else { return None };
    let step_ms = instant_ms - after_ms;
    let times = scenario.trials.iter().filter_map(|trial| trial.metrics.number(Metric::SettlingTime.name()));
    let longest_ms = times.fold(after_ms, f64::max);
    let span_ms = (4.0 * longest_ms).max(5.0);
    let from_ms = (step_ms - 0.1 * span_ms).max(whole.from_ms);
    let window = TimeWindow { from_ms, to_ms: (step_ms + span_ms).min(whole.to_ms) };
    (after_ms > 0.0 && window.span_ms() * 3.0 < whole.span_ms()).then_some(window)
}

fn trace_error_reason(error: &TraceError) -> String {
    match error {
        TraceError::Io { source, .. } => source.to_string(),
        TraceError::Content { line, message, .. } => format!("line {line}: {message}"),
    }
}
