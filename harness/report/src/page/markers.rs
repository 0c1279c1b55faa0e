//! Finds what a figure marks: start, end and deadline of the times that expectations measure, and the
//! limit, the judged window and the worst instants of an expectation.

use super::curves;
use crate::format;
use crate::time_chart::TimeWindow;
use platebench_model::metrics::{ElapsedLabels, Levels, LimitMarkSpec, SignalPoint};
use platebench_model::record::{
    ExpectationRecord, Limit, Metric, MetricDefinition, ScenarioRecord, TrialRecord, Verdict,
};
use platebench_model::trace::{Column, Row};

/// All instants are in ms since the start of the trial.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TimeMarker {
    pub(crate) text: String,
    pub(crate) from_ms: Option<f64>,
    pub(crate) instant_ms: Option<f64>,
    /// Latest allowed end in ms, and text of the expectation.
    pub(crate) deadline: Option<(f64, String)>,
    pub(crate) is_on_drive: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Settling {
    Unknown,
    Never,
    At {
        /// Time since the start of the trial.
        instant_ms: f64,
        /// Time since the setpoint step.
        after_ms: f64,
    },
}

/// Index of the first settling time that did not pass. If there is none, of the first settling
/// time, then of the first metric with a band.
pub(crate) fn settling_expectation(scenario: &ScenarioRecord) -> Option<usize> {
    let all = || scenario.expectations.iter().enumerate();
    let settling = || all().filter(|(_, found)| found.metric == Metric::SettlingTime);
    let not_passed = settling().find(|(_, found)| found.verdict != Verdict::Pass);
    let banded = all().find(|(_, found)| found.definition.band_percent.is_some());
    not_passed.or_else(|| settling().next()).or(banded).map(|(index, _)| index)
}

pub(crate) fn settling(scenario: &ScenarioRecord, trial: &TrialRecord, index: usize, steps_ms: &[f64]) -> Settling {
    let Some(expectation) = scenario.expectations.get(index).filter(|found| found.metric == Metric::SettlingTime)
    else {
        return Settling::Unknown;
    };
    match trial.metrics.get(&scenario.metric_key(index)) {
        None => Settling::Unknown,
        Some(None) => Settling::Never,
        Some(Some(after_ms)) => settling_start_ms(&expectation.definition, steps_ms)
            .map_or(Settling::Unknown, |step_ms| Settling::At { instant_ms: step_ms + after_ms, after_ms }),
    }
}

/// Instant of the last setpoint step up to `from_ms`, or of the first step.
fn settling_start_ms(definition: &MetricDefinition, steps_ms: &[f64]) -> Option<f64> {
    let passed = definition.from_ms.map_or(1, |from_ms| steps_ms.partition_point(|step_ms| *step_ms <= from_ms));
    steps_ms.get(passed.saturating_sub(1)).copied()
}

/// Marker of settling, and for recovery and shutdown markers of the expectations that did not pass
/// or, if all passed, of the first one.
pub(crate) fn time_markers(
    scenario: &ScenarioRecord,
    trial: &TrialRecord,
    settling: Settling,
    expected: Option<usize>,
    steps_ms: &[f64],
) -> Vec<TimeMarker> {
    let mut found = Vec::new();
    let settling_text = match settling {
        Settling::Unknown => None,
        Settling::Never => Some(("does not settle".to_owned(), None)),
        Settling::At { instant_ms, after_ms } => {
            Some((format!("settled after {} ms", format::number(after_ms)), Some(instant_ms)))
        }
    };
    if let (Some((text, instant_ms)), Some(index)) = (settling_text, expected) {
        let definition = scenario.expectations.get(index).map(|expectation| &expectation.definition);
        let from_ms = definition.and_then(|definition| settling_start_ms(definition, steps_ms));
        let deadline = from_ms.and_then(|from_ms| deadline(scenario, index, from_ms));
        found.push(TimeMarker { text, from_ms, instant_ms, deadline, is_on_drive: false });
    }
    let elapsed_metrics = Metric::ALL.iter().filter_map(|&metric| Some((metric, metric.spec().elapsed?)));
    for (metric, labels) in elapsed_metrics {
        let of_metric = || scenario.expectations.iter().enumerate().filter(|(_, found)| found.metric == metric);
        let mut shown: Vec<usize> =
            of_metric().filter(|(_, found)| found.verdict != Verdict::Pass).map(|(index, _)| index).collect();
        if shown.is_empty() {
            shown.extend(of_metric().next().map(|(index, _)| index));
        }
        let marker = |index| elapsed_marker(scenario, trial, index, labels);
        found.extend(shown.into_iter().filter_map(marker));
    }
    found
}

/// `None` if the trial has no result or the expectation has no `from_ms`.
fn elapsed_marker(
    scenario: &ScenarioRecord,
    trial: &TrialRecord,
    index: usize,
    labels: ElapsedLabels,
) -> Option<TimeMarker> {
    let expectation = scenario.expectations.get(index)?;
    let from_ms = expectation.definition.from_ms?;
    let after_ms = trial.metrics.get(&scenario.metric_key(index))?;
    let text = after_ms.map_or_else(
        || labels.not_reached.to_owned(),
        |after_ms| format!("{} {} ms", labels.reached, format::number(after_ms)),
    );
    Some(TimeMarker {
        text,
        from_ms: Some(from_ms),
        instant_ms: after_ms.map(|after_ms| from_ms + after_ms),
        deadline: deadline(scenario, index, from_ms),
        is_on_drive: labels.is_on_drive,
    })
}

fn deadline(scenario: &ScenarioRecord, index: usize, from_ms: f64) -> Option<(f64, String)> {
    let expectation = scenario.expectations.get(index)?;
    let at_ms = from_ms + upper_limit(expectation)?;
    Some((at_ms, format!("{} {} ms", expectation.name, format::limit(expectation))))
}

fn upper_limit(expectation: &ExpectationRecord) -> Option<f64> {
    match expectation.limit {
        Limit::AtMost(limit) | Limit::Within(_, limit) => Some(limit),
        Limit::AtLeast(_) | Limit::About(_) => None,
    }
}

/// Limits of an expectation in the window that decided its verdict.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LimitMark {
    pub(crate) text: String,
    pub(crate) name: String,
    pub(crate) is_missed: bool,
    /// False for a settling or recovery time that never came.
    has_value: bool,
    pub(crate) signal: Column,
    pub(crate) window: TimeWindow,
    pub(crate) levels: Vec<Level>,
    /// Meaning of `worst`, such as `last outside the band` or `mean`.
    pub(crate) kind: &'static str,
    /// True if the window ends at the worst instant, as for a settling or recovery time.
    ends_at_worst: bool,
    pub(crate) worst: Vec<WorstPoint>,
}

/// A limit with the value `share · base + offset`, or `offset` if there is no base.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Level {
    pub(crate) base: Option<Column>,
    pub(crate) share: f64,
    pub(crate) offset: f64,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct WorstPoint {
    pub(crate) t_ms: f64,
    pub(crate) value: f64,
    pub(crate) text: String,
}

impl LimitMark {
    /// `rows` are those of the trial that decided. `None` if no figure shows the metric, or if the
    /// record has no worst instant.
    pub(crate) fn new(expectation: &ExpectationRecord, is_missed: bool, rows: &[Row]) -> Option<Self> {
        let spec = expectation.metric.spec();
        let mark = spec.mark?;
        let worst = expectation.worst.as_ref().filter(|worst| !worst.points.is_empty())?;
        let signal = shown_signal(expectation, mark)?;
        let [from_ms, to_ms] = worst.window_ms;
        let window = TimeWindow { from_ms, to_ms };
        let point = |&SignalPoint { t_ms, value }: &SignalPoint| {
            let text = format!("{} {} at {} ms", format::number(value), curves::unit(signal), format::number(t_ms));
            WorstPoint { t_ms, value, text }
        };
        let (limit, unit) = (format::limit(expectation), spec.unit.symbol());
        Some(Self {
            text: format!("{} {limit} {unit}", expectation.name).trim_end().to_owned(),
            name: if expectation.name.is_empty() { expectation.metric.to_string() } else { expectation.name.clone() },
            is_missed,
            has_value: expectation.value.is_some(),
            signal,
            window,
            levels: levels(expectation, mark.levels, &worst.points, window, rows),
            kind: mark.label,
            ends_at_worst: mark.levels == Levels::Band,
            worst: worst.points.iter().map(point).collect(),
        })
    }

    /// The judged window if it is short, otherwise the time around the worst instant.
    pub(crate) fn view(&self, whole: TimeWindow) -> Option<TimeWindow> {
        let around = |from_ms: f64, to_ms: f64| TimeWindow {
            from_ms: from_ms.max(whole.from_ms),
            to_ms: to_ms.min(whole.to_ms),
        };
        let worst = self.worst.first()?;
        let to_ms = if self.ends_at_worst { worst.t_ms } else { self.window.to_ms };
        let span_ms = to_ms - self.window.from_ms;
        let view = if span_ms <= 0.3 * whole.span_ms() {
            let air = (0.2 * span_ms).max(1.0);
            around(self.window.from_ms - air, to_ms + air)
        } else {
            let half = (0.05 * whole.span_ms()).max(5.0);
            around(worst.t_ms - half, worst.t_ms + half)
        };
        (view.span_ms() > 0.0 && view.span_ms() < 0.8 * whole.span_ms()).then_some(view)
    }
}

impl LimitMark {
    /// From the last setpoint step before the worst instants to the end of these instants. The
    /// whole trial if the metric has no value.
    pub(crate) fn failure_window(&self, steps_ms: &[f64], whole: TimeWindow) -> TimeWindow {
        let instants = || self.worst.iter().map(|worst| worst.t_ms);
        let (first, last) = (instants().fold(f64::INFINITY, f64::min), instants().fold(f64::NEG_INFINITY, f64::max));
        if !self.has_value || !first.is_finite() {
            return whole;
        }
        let step_ms = steps_ms.iter().copied().rfind(|step_ms| *step_ms < first).unwrap_or(whole.from_ms);
        let air_ms = (0.2 * (last - step_ms)).max(1.0);
        TimeWindow {
            from_ms: (step_ms - 0.5 * air_ms).max(whole.from_ms),
            to_ms: (last + air_ms).clamp(whole.from_ms, whole.to_ms),
        }
    }
}

/// The figures have no signal of the sensor.
fn shown_signal(expectation: &ExpectationRecord, mark: LimitMarkSpec) -> Option<Column> {
    let expected = || match &expectation.definition.signal {
        None => Some(Column::Amplitude),
        Some(name) => Column::from_name(name),
    };
    let signal = mark.signal.or_else(expected)?;
    (!matches!(signal, Column::SensedWd | Column::SensedWq)).then_some(signal)
}

fn levels(
    expectation: &ExpectationRecord,
    rule: Levels,
    worst: &[SignalPoint],
    window: TimeWindow,
    rows: &[Row],
) -> Vec<Level> {
    let ends = || format::limit_ends(expectation.limit).into_iter();
    let constant = |offset: f64| Level { base: None, share: 0.0, offset };
    let around_setpoint = |percent: f64| {
        [1.0, -1.0].map(|side| Level { base: Some(Column::Setpoint), share: 1.0 + side * percent / 100.0, offset: 0.0 })
    };
    match rule {
        Levels::None => Vec::new(),
        Levels::Constant => ends().map(constant).collect(),
        Levels::Band => expectation.definition.band_percent.into_iter().flat_map(around_setpoint).collect(),
        Levels::PercentOfSetpoint => ends().flat_map(around_setpoint).collect(),
        Levels::PercentOfSetpointAndValue => {
            let value = worst.iter().map(|point| constant(point.value));
            ends().flat_map(around_setpoint).chain(value).collect()
        }
        Levels::PercentOfStep => {
            let [before, after] = setpoints_of_step(window, rows);
            ends().map(|percent| constant(after + percent / 100.0 * (after - before))).collect()
        }
        Levels::Around(column) => {
            let level = |offset: f64| Level { base: Some(column), share: 1.0, offset };
            ends().flat_map(|end| [level(end), level(-end)]).collect()
        }
        Levels::TimesColumn(column) => {
            let level = |share: f64| Level { base: Some(column), share, offset: 0.0 };
            ends().flat_map(|end| [level(end), level(-end)]).collect()
        }
    }
}

/// Setpoint before the window, 0 at the start of the trial, and at the end of the window.
fn setpoints_of_step(window: TimeWindow, rows: &[Row]) -> [f64; 2] {
    [window.from_ms, window.to_ms].map(|at_ms| {
        let count = rows.partition_point(|row| row.t_s * 1e3 < at_ms);
        count.checked_sub(1).and_then(|last| rows.get(last)).map_or(0.0, |row| row.setpoint_um)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case::after_the_second_step(true, &[70.0], [48.0, 74.0])]
    #[case::two_instants(true, &[20.0, 40.0], [7.0, 46.0])]
    #[case::before_all_steps(true, &[5.0], [0.0, 6.0])]
    #[case::at_the_end(true, &[100.0], [45.0, 100.0])]
    #[case::never(false, &[70.0], [0.0, 100.0])]
    fn the_window_contains_step_and_violation(
        #[case] has_value: bool,
        #[case] worst_ms: &[f64],
        #[case] expected: [f64; 2],
    ) {
        let whole = TimeWindow { from_ms: 0.0, to_ms: 100.0 };
        let worst = worst_ms.iter().map(|t_ms| WorstPoint { t_ms: *t_ms, value: 1.0, text: String::new() });
        let mark = LimitMark {
            text: String::new(),
            name: String::new(),
            is_missed: true,
            has_value,
            signal: Column::Amplitude,
            window: whole,
            levels: Vec::new(),
            kind: "worst",
            ends_at_worst: false,
            worst: worst.collect(),
        };
        let window = mark.failure_window(&[10.0, 50.0], whole);
        assert_eq!([window.from_ms, window.to_ms], expected);
    }
}
