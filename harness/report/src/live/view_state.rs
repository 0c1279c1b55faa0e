//! Holds what the view draws: counts, newest rows, and minimum and maximum of each signal per time slice.

use crate::live::events::RunDescription;
use platebench_engine::Clock;
use platebench_engine::live_tap::{TapCounts, TapRow};
use platebench_model::record::{Event, VerdictCounts};
use platebench_model::scenario::Scenario;
use platebench_model::trace::{Column, Row};
use std::collections::VecDeque;

/// Half width of the band in % if no expectation has one, as in the paper for the response time.
const BAND_PERCENT: f64 = 5.0;
/// Longest part of a trial that the view draws. It draws the last part.
const MAX_WINDOW_S: f64 = 10.0;

#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct FinishedCounts {
    pub(crate) trials: u64,
    pub(crate) scenarios: VerdictCounts,
}

impl FinishedCounts {
    pub(crate) const fn add(&mut self, event: &Event) {
        match event {
            Event::TrialFinished { .. } => self.trials += 1,
            Event::ScenarioFinished { verdict, .. } => self.scenarios.add(*verdict),
            _ => {}
        }
    }
}

#[derive(Debug)]
pub(crate) struct ViewState {
    pub(crate) run: RunDescription,
    /// Name or location of the rig.
    pub(crate) rig: String,
    /// Indices of scenario and trial.
    newest_trial: Option<(usize, u32)>,
    pub(crate) newest_row: Option<Row>,
    pub(crate) history: SignalHistory,
    pub(crate) counts: TapCounts,
    pub(crate) finished: FinishedCounts,
    pub(crate) messages: Vec<String>,
}

impl ViewState {
    pub(crate) fn new(run: RunDescription) -> Self {
        Self {
            rig: run.plan.rig.clone(),
            run,
            newest_trial: None,
            newest_row: None,
            history: SignalHistory::new(1.0, 1.0),
            counts: TapCounts::default(),
            finished: FinishedCounts::default(),
            messages: Vec::new(),
        }
    }

    /// A row of another trial, or with an earlier time, starts a new history.
    pub(crate) fn add_row(&mut self, tap_row: &TapRow) {
        let playing = Some((tap_row.scenario, tap_row.trial));
        let is_new = self.newest_trial != playing || self.newest_row.is_none_or(|newest| newest.t_s > tap_row.row.t_s);
        self.newest_trial = playing;
        self.newest_row = Some(tap_row.row);
        if is_new && let Some(scenario) = self.current_scenario() {
            let window_s = self.duration_s(scenario).map_or(MAX_WINDOW_S, |duration| duration.min(MAX_WINDOW_S));
            let spacing = scenario.trace_step.min(scenario.controller.period);
            self.history = SignalHistory::new(window_s, spacing.seconds());
        }
        self.history.push(&tap_row.row);
    }

    /// `None` if the operator ends the trial.
    pub(crate) fn duration_s(&self, scenario: &Scenario) -> Option<f64> {
        self.run.has_end.then(|| scenario.duration.seconds())
    }

    pub(crate) fn is_lockstep(&self) -> bool {
        matches!(self.run.plan.clock, Clock::Lockstep { .. })
    }

    pub(crate) fn current_trial(&self) -> Option<(&Scenario, u64)> {
        self.newest_trial.and_then(|(_, trial)| Some((self.current_scenario()?, u64::from(trial) + 1)))
    }

    fn current_scenario(&self) -> Option<&Scenario> {
        self.run.plan.scenarios.get(self.newest_trial?.0)
    }
}

pub(crate) fn band_percent(scenario: &Scenario) -> f64 {
    let mut banded = scenario.expectations.iter().filter(|expectation| expectation.metric.has_band());
    let band = banded.find(|expectation| expectation.signal == "amplitude_um");
    band.map_or(BAND_PERCENT, |expectation| expectation.band_percent)
}

pub(crate) fn band(scenario: &Scenario, setpoint_um: f64) -> Option<[f64; 2]> {
    let half = setpoint_um.abs() * band_percent(scenario) / 100.0;
    (half > 0.0).then_some([setpoint_um - half, setpoint_um + half])
}

/// Slices per window: two for each of 256 characters, because a Braille character has two columns.
const SLICES: f64 = 512.0;
/// The curve has a gap if two rows are further apart than this many times the usual distance.
const GAP_SPACINGS: f64 = 3.5;

const SIGNALS: usize = Column::ALL.len();
/// Columns that the charts draw.
const DRAWN: [Column; 7] =
    [Column::Setpoint, Column::Amplitude, Column::Wd, Column::Wq, Column::Drive, Column::Frequency, Column::Resonance];

#[derive(Debug, Clone, Copy)]
struct HistorySlice {
    number: i64,
    low: [f64; SIGNALS],
    high: [f64; SIGNALS],
}

#[derive(Debug)]
pub(crate) struct SignalHistory {
    window_s: f64,
    gap_s: f64,
    slices: VecDeque<HistorySlice>,
}

impl SignalHistory {
    /// Both arguments must be above 0.
    pub(crate) fn new(window_s: f64, spacing_s: f64) -> Self {
        let slice_s = window_s / SLICES;
        Self { window_s, gap_s: GAP_SPACINGS * spacing_s.max(slice_s), slices: VecDeque::new() }
    }

    fn slice_s(&self) -> f64 {
        self.window_s / SLICES
    }

    /// The row must not be older than the last one. Ignores a row if its time
    /// or a drawn number is not finite.
    pub(crate) fn push(&mut self, row: &Row) {
        if !row.t_s.is_finite() || DRAWN.iter().any(|column| !column.value(row).is_finite()) {
            return;
        }
        let values = Column::ALL.map(|column| column.value(row));
        let number = (row.t_s / self.slice_s()) as i64;
        match self.slices.back_mut() {
            Some(last) if last.number == number => {
                for (signal, value) in values.into_iter().enumerate() {
                    last.low[signal] = last.low[signal].min(value);
                    last.high[signal] = last.high[signal].max(value);
                }
            }
            _ => self.slices.push_back(HistorySlice { number, low: values, high: values }),
        }
        while self.slices.front().is_some_and(|first| number - first.number > SLICES as i64) {
            self.slices.pop_front();
        }
    }

    pub(crate) fn span_s(&self) -> [f64; 2] {
        let newest = self.slices.back().map_or(0.0, |last| (last.number + 1) as f64 * self.slice_s());
        let end = newest.max(self.window_s);
        [end - self.window_s, end]
    }

    pub(crate) fn range(&self, signals: &[Column]) -> Option<[f64; 2]> {
        let all = signals.iter().flat_map(|signal| {
            let signal = *signal as usize;
            self.slices.iter().map(move |slice| [slice.low[signal], slice.high[signal]])
        });
        all.reduce(|[low, high], [lower, higher]| [low.min(lower), high.max(higher)])
    }

    pub(crate) fn lines(&self, signal: Column, of: impl Fn(f64) -> f64) -> Vec<Vec<(f64, f64)>> {
        let signal = signal as usize;
        let mut lines: Vec<Vec<(f64, f64)>> = Vec::new();
        let mut last_s = f64::NEG_INFINITY;
        for slice in &self.slices {
            let at_s = (slice.number as f64 + 0.5) * self.slice_s();
            if at_s - last_s > self.gap_s {
                lines.push(Vec::new());
            }
            last_s = at_s;
            if let Some(line) = lines.last_mut() {
                line.push((at_s, of(slice.low[signal])));
                if slice.high[signal] != slice.low[signal] {
                    line.push((at_s, of(slice.high[signal])));
                }
            }
        }
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(t_s: f64, amplitude_um: f64) -> Row {
        Row { t_s, amplitude_um, ..Row::default() }
    }

    #[test]
    fn a_slice_keeps_its_lowest_and_its_highest_value() {
        let mut history = SignalHistory::new(512.0, 0.1);
        for (t_s, value) in [(0.1, 2.0), (0.5, -1.0), (0.9, 7.0), (1.1, 3.0)] {
            history.push(&row(t_s, value));
        }
        assert_eq!(history.range(&[Column::Amplitude]), Some([-1.0, 7.0]));
        assert_eq!(history.lines(Column::Amplitude, |value| value), [[(0.5, -1.0), (0.5, 7.0), (1.5, 3.0)]]);
    }

    #[test]
    fn the_window_bounds_the_memory() {
        let mut history = SignalHistory::new(512.0, 1.0);
        (0..100_000).for_each(|second| history.push(&row(f64::from(second), f64::from(second))));
        assert!(history.slices.len() <= 513, "{}", history.slices.len());
        assert_eq!(history.span_s(), [99_488.0, 100_000.0]);
        assert_eq!(history.range(&[Column::Amplitude]).unwrap()[1], 99_999.0);
    }

    #[test]
    fn a_line_has_gaps_only_at_missing_rows() {
        let of_gap = |gap: f64| {
            let mut history = SignalHistory::new(512.0, 1.0);
            for t_s in [0.0, 1.0, 1.0 + gap] {
                history.push(&row(t_s, 1.0));
            }
            history.lines(Column::Amplitude, |value| value).len()
        };
        assert_eq!([of_gap(1.0), of_gap(3.0), of_gap(4.0)], [1, 1, 2]);
        let mut sparse = SignalHistory::new(512.0, 20.0);
        (0..5).for_each(|number| sparse.push(&row(f64::from(number) * 20.0, 1.0)));
        assert_eq!(sparse.lines(Column::Amplitude, |value| value).len(), 1);
    }

    #[test]
    fn ignores_rows_with_numbers_that_are_not_finite() {
        let mut history = SignalHistory::new(1.0, 0.1);
        history.push(&row(f64::NAN, 1.0));
        history.push(&row(0.0, f64::INFINITY));
        assert_eq!(history.range(&[Column::Amplitude]), None);
        assert_eq!(history.span_s(), [0.0, 1.0]);
        history.push(&Row { sensed_wd_um: f64::INFINITY, ..row(0.0, 1.0) });
        assert_eq!(history.range(&[Column::Amplitude]), Some([1.0, 1.0]));
    }
}
