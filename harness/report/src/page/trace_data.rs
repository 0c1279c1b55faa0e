//! Reads each trace of a scenario once and samples it. Lists unreadable traces instead of failing.

use super::curves::{self, TimeGrid};
use super::markers::{self, LimitMark, Settling, TimeMarker};
use crate::comparison::{ValueChange, value_changes};
use crate::record_queries;
use crate::time_chart::TimeWindow;
use platebench_document::chart::marks::Point;
use platebench_model::metrics::Levels;
use platebench_model::record::{Metric, ScenarioRecord, Telemetry, TrialRecord, Verdict};
use platebench_model::scenario::{Expectation, Window};
use platebench_model::trace::{Column, Flags, Row, TraceError};
use platebench_plate::Time;
use platebench_verdict::golden::{Baseline, BaselineError};
use platebench_verdict::metrics::{Measure, measure};
use platebench_verdict::tube::Exceedance;
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
    /// Window that contains the setpoint step and the first missed limit, for the card.
    pub(crate) failure_window: Option<TimeWindow>,
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
                        data.golden = GoldenDifference::find(golden, scenario, &rows);
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
        self.overshoot_percent = overshoot_percent(rows_before_touch(rows));
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
        let first_missed = self.limits.iter().find(|limit| limit.is_missed);
        self.failure_window = Some(first_missed.map_or(whole, |limit| limit.failure_window(&steps, whole)));
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

/// Rounded to 0.1 %.
fn overshoot_percent(rows: &[Row]) -> Option<f64> {
    let to = rows.last().and_then(|row| Time::from_seconds(row.t_s))?;
    let expectation = Expectation::for_window(Metric::Overshoot, Window { from: Time::ZERO, to });
    match measure(&expectation, rows, &Telemetry::default()) {
        Measure::Value(value) => Some((value * 10.0).round() / 10.0),
        _ => None,
    }
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

#[derive(Debug, Clone)]
pub(crate) struct GoldenCurves {
    pub(crate) text: String,
    tubes: BTreeMap<Column, SampledTube>,
}

#[derive(Debug, Clone)]
pub(crate) struct SampledTube {
    pub(crate) line: Vec<Option<f64>>,
    pub(crate) edges: [Vec<Option<f64>>; 2],
}

/// Differences from the baseline. Empty if there is none, or if the response is inside its tubes.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct GoldenDifference {
    /// The worst exceedance of each signal that leaves its tube.
    pub(crate) exceedances: Vec<Exceedance>,
    pub(crate) values: Vec<ValueChange>,
}

impl GoldenDifference {
    fn find(baseline: &Baseline, scenario: &ScenarioRecord, rows: &[Row]) -> Self {
        let exceedances = baseline.golden.exceedances(rows);
        if exceedances.is_empty() {
            return Self::default();
        }
        let values = baseline.response.values.as_ref().map(|values| value_changes(values, scenario));
        Self { exceedances, values: values.unwrap_or_default() }
    }
}

impl GoldenCurves {
    pub(crate) fn read(folder: &Path, file: &str, grid: &TimeGrid) -> Result<Option<Self>, BaselineError> {
        Ok(Baseline::read(folder, file)?.map(|accepted| Self::from_baseline(&accepted, grid)))
    }

    fn from_baseline(accepted: &Baseline, grid: &TimeGrid) -> Self {
        let tubes = accepted.golden.tubes.iter().filter_map(|tube| {
            let signal = Column::from_name(&tube.signal)?;
            let (from_ms, to_ms) = tube.span_ms();
            let inside = |t_ms: &f64| (from_ms..=to_ms).contains(t_ms).then_some(*t_ms);
            let sampled = |value: &dyn Fn(f64) -> f64| grid.t_ms.iter().map(|t_ms| inside(t_ms).map(value)).collect();
            let [lower, upper]: [fn([f64; 2]) -> f64; 2] = [|[low, _]| low, |[_, high]| high];
            let edges = [sampled(&|t_ms| lower(tube.edges(t_ms))), sampled(&|t_ms| upper(tube.edges(t_ms)))];
            Some((signal, SampledTube { line: sampled(&|t_ms| tube.point_at(t_ms).value), edges }))
        });
        Self { text: format!("golden trace ({})", accepted.response.law), tubes: tubes.collect() }
    }

    pub(crate) fn tube_of(&self, signal: Column) -> Option<&SampledTube> {
        self.tubes.get(&signal)
    }
}

/// Largest number of kept rows, about 56 MB. The report reads the other traces from their files.
const MAX_ROWS: usize = 500_000;

#[derive(Debug, Clone, Default)]
pub struct RowCache {
    by_trace: BTreeMap<String, Vec<Row>>,
    count: usize,
}

impl RowCache {
    /// `trace` is relative to the run folder. Drops rows beyond `MAX_ROWS`.
    pub fn add(&mut self, trace: &str, rows: Vec<Row>) {
        if !rows.is_empty() && self.count + rows.len() <= MAX_ROWS {
            self.count += rows.len();
            self.by_trace.insert(trace.to_owned(), rows);
        }
    }

    pub(crate) fn get(&self, trace: &str) -> Option<&[Row]> {
        self.by_trace.get(trace).map(Vec::as_slice)
    }
}

const MAX_CURVE_CHARS: usize = 2_000_000;
const MAX_DRAWN_POINTS: usize = 100_000;
/// Largest number of scenarios with drawings. Scenarios that did not pass have them first.
const MAX_DRAWN_SCENARIOS: usize = 30;
/// Lines of a scenario besides overlaid trials, such as percentiles, tubes and profiles.
const OTHER_LINES: usize = 34;
const CHARS_PER_POINT: usize = 2;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PlotResolution {
    pub(crate) instants: usize,
    pub(crate) overlaid_trials: usize,
    /// Scenarios with drawings for readers without scripts.
    pub(crate) drawn_scenarios: usize,
    pub(crate) line_points: usize,
}

impl PlotResolution {
    /// `trials` is the largest number of trials of a scenario.
    pub(crate) fn of(scenarios: usize, trials: usize) -> Self {
        let scenarios = scenarios.max(1);
        let curves = MAX_CURVE_CHARS / scenarios / CHARS_PER_POINT;
        // Two figures contain the lines of overlaid trials.
        let overlaid = trials.min((curves / 100).saturating_sub(OTHER_LINES) / 2).max(1);
        Self {
            instants: (curves / (OTHER_LINES + 2 * overlaid)).clamp(60, 1_200),
            overlaid_trials: overlaid,
            drawn_scenarios: if scenarios > 100 { MAX_DRAWN_SCENARIOS / 3 } else { MAX_DRAWN_SCENARIOS },
            line_points: (MAX_DRAWN_POINTS / scenarios.min(MAX_DRAWN_SCENARIOS) / 8).clamp(100, 400),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fewer_scenarios_have_finer_figures() {
        let one = PlotResolution::of(1, 30);
        assert_eq!(one, PlotResolution { instants: 1_200, overlaid_trials: 30, drawn_scenarios: 30, line_points: 400 });
        let forty = PlotResolution::of(40, 30);
        assert!(forty.instants >= 180 && forty.overlaid_trials == 30, "{forty:?}");
        let hundred = PlotResolution::of(100, 30);
        assert!(hundred.instants >= 80 && hundred.overlaid_trials >= 20, "{hundred:?}");
        for (scenarios, trials) in [(0, 0), (1, 0), (1_000_000, 30)] {
            let coarse = PlotResolution::of(scenarios, trials);
            assert!(coarse.instants >= 60 && coarse.overlaid_trials >= 1 && coarse.line_points >= 100, "{coarse:?}");
        }
    }
}
