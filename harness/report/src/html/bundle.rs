//! The traces of a scenario, read once each and reduced to what its figures show.
//!
//! Neighbours: `curves` reduces, `figure` draws. What cannot be read is named, in words that fit into the report; it
//! is no error.

use super::curves::{self, Envelope, POINTS, Point, Signal, Window};
use crate::evidence;
use platebench_trace::{Row, TraceError};
use platebench_verdict::{ScenarioRecord, TrialRecord, Verdict};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// Trials whose traces are read; of more, also the one that decided a verdict.
const TRIALS: usize = 30;
/// Points that are kept of a line that another scenario is shown against, in whatever window that takes.
const OVERLAY_POINTS: usize = 4_000;
/// Half width of the band that is drawn around the setpoint.
pub(crate) const BAND: f64 = 0.05;

/// What the figures of a scenario are made from.
#[derive(Debug, Clone, Default)]
pub(crate) struct Bundle {
    /// The response to the setpoint step where the whole trial is much longer, then the whole trial; empty without a
    /// trace.
    pub(crate) views: Vec<View>,
    /// Number of the trial that is drawn as a line.
    pub(crate) first: u32,
    /// Number of the trial that decided an expectation which did not pass, with that metric; `None` where it is the
    /// first.
    pub(crate) exhibit: Option<(u32, String)>,
    /// How many trials are shown.
    pub(crate) shown: usize,
    /// Whether the first trial settles.
    pub(crate) settling: Settling,
    /// What could not be read and why.
    pub(crate) missing: Vec<String>,
    /// |W| of the first trial.
    pub(crate) amplitude: Vec<Point>,
}

/// Whether a trial settles.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) enum Settling {
    /// Nobody asked.
    #[default]
    Unknown,
    /// It was asked for and there is none.
    Never,
    /// It does.
    At {
        /// Since the start of the trial.
        instant_ms: f64,
        /// Since the setpoint step.
        after_ms: f64,
    },
}

/// The curves in a stretch of time.
#[derive(Debug, Clone)]
pub(crate) struct View {
    pub(crate) window: Window,
    pub(crate) strands: BTreeMap<Signal, Strand>,
    /// Where the drive of any trial is at its limit.
    pub(crate) saturated: Vec<Window>,
}

/// A signal over all trials.
#[derive(Debug, Clone)]
pub(crate) struct Strand {
    pub(crate) first: Vec<Point>,
    pub(crate) exhibit: Vec<Point>,
    pub(crate) envelope: Envelope,
}

impl View {
    fn new(window: Window) -> Self {
        let strand = |signal| Strand { first: vec![], exhibit: vec![], envelope: Envelope::new(window, signal) };
        let strands = Signal::ALL.into_iter().map(|signal| (signal, strand(signal))).collect();
        Self { window, strands, saturated: Vec::new() }
    }

    fn take(&mut self, rows: &[Row], is_first: bool, is_exhibit: bool) {
        for (&signal, strand) in &mut self.strands {
            if is_first {
                strand.first = curves::line(rows, signal, self.window, POINTS);
            } else if is_exhibit {
                strand.exhibit = curves::line(rows, signal, self.window, POINTS);
            }
            strand.envelope.widen(rows, signal);
        }
        let spans = curves::saturated(rows, self.window);
        self.saturated = curves::merged(std::mem::take(&mut self.saturated).into_iter().chain(spans).collect());
    }
}

impl Bundle {
    /// Reads the traces of `scenario` below the run's `folder`.
    pub(crate) fn read(scenario: &ScenarioRecord, folder: &Path) -> Self {
        let mut bundle = Self::default();
        let exhibit = exhibit(scenario);
        for (position, trial) in scenario.trials.iter().enumerate() {
            let is_exhibit = exhibit.as_ref().is_some_and(|(index, _)| *index == trial.index);
            if position >= TRIALS && !is_exhibit {
                continue;
            }
            match platebench_trace::read(&folder.join(&trial.trace)) {
                Ok(rows) => bundle.take(scenario, trial, &rows, is_exhibit),
                Err(error) => bundle.missing.push(format!("{}: {}", trial.trace, reason(&error))),
            }
        }
        bundle.exhibit = exhibit.filter(|_| bundle.views.iter().any(View::has_exhibit));
        bundle
    }

    fn take(&mut self, scenario: &ScenarioRecord, trial: &TrialRecord, rows: &[Row], is_exhibit: bool) {
        let is_first = self.views.is_empty();
        if is_first {
            self.first = trial.index;
            let steps = curves::steps_ms(rows);
            self.settling = settling(trial, &steps, rows);
            let whole = whole(rows);
            self.views = response(scenario, self.settling, whole).into_iter().chain([whole]).map(View::new).collect();
            self.amplitude = curves::line(rows, Signal::Amplitude, whole, OVERLAY_POINTS);
        }
        for view in &mut self.views {
            view.take(rows, is_first, is_exhibit);
        }
        self.shown += 1;
    }
}

impl View {
    fn has_exhibit(&self) -> bool {
        self.strands.values().any(|strand| !strand.exhibit.is_empty())
    }
}

/// The trial that decided the first expectation which failed, or else the first inconclusive one.
fn exhibit(scenario: &ScenarioRecord) -> Option<(u32, String)> {
    let first = |verdict| scenario.expectations.iter().position(|expectation| expectation.verdict == verdict);
    let index = first(Verdict::Fail).or_else(|| first(Verdict::Inconclusive))?;
    Some((evidence::trial(scenario, index)?.index, evidence::key(scenario, index)))
}

fn whole(rows: &[Row]) -> Window {
    let ms = |row: Option<&Row>| row.map_or(0.0, |row| row.t_s * 1e3);
    let (from_ms, to_ms) = (ms(rows.first()), ms(rows.last()));
    Window { from_ms, to_ms: if to_ms > from_ms { to_ms } else { from_ms + 1.0 } }
}

/// The stretch around the setpoint step, where the whole trial would squeeze the response into a corner.
fn response(scenario: &ScenarioRecord, settling: Settling, whole: Window) -> Option<Window> {
    let Settling::At { instant_ms, after_ms } = settling else { return None };
    let step_ms = instant_ms - after_ms;
    let times = scenario.trials.iter().filter_map(|trial| trial.metrics.get("settling_time_ms")?.as_f64());
    let longest_ms = times.fold(after_ms, f64::max);
    let span_ms = (4.0 * longest_ms).max(5.0);
    let from_ms = (step_ms - 0.1 * span_ms).max(whole.from_ms);
    let window = Window { from_ms, to_ms: (step_ms + span_ms).min(whole.to_ms) };
    (after_ms > 0.0 && window.span_ms() * 3.0 < whole.span_ms()).then_some(window)
}

/// Whether the trial settles, and when. Of several setpoint steps it is the one after which the amplitude crosses the
/// band's edge at that time; the record does not say which was meant.
fn settling(trial: &TrialRecord, steps: &[f64], rows: &[Row]) -> Settling {
    let after_ms = match trial.metrics.get("settling_time_ms") {
        None => return Settling::Unknown,
        Some(Value::Number(number)) => number.as_f64().unwrap_or(0.0),
        Some(_) => return Settling::Never,
    };
    let distance = |step_ms: f64| {
        let at = |signal| curves::value_at(rows, signal, step_ms + after_ms);
        let (amplitude, setpoint) = (at(Signal::Amplitude), at(Signal::Setpoint));
        let off = amplitude.zip(setpoint).map(|(w, wished)| (((w - wished) / wished).abs() - BAND).abs());
        off.filter(|off| off.is_finite()).unwrap_or(f64::MAX)
    };
    let step = steps.iter().copied().min_by(|a, b| distance(*a).total_cmp(&distance(*b)));
    step.map_or(Settling::Unknown, |step_ms| Settling::At { instant_ms: step_ms + after_ms, after_ms })
}

/// Why a trace cannot be shown, without the path: a report travels.
fn reason(error: &TraceError) -> String {
    match error {
        TraceError::Io { source, .. } => source.to_string(),
        TraceError::Content { line, message, .. } => format!("line {line}: {message}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_verdict::Telemetry;
    use serde_json::{Map, json};

    /// 0 µm, from 1 ms on 1 µm, from 11 ms on 2 µm, each reached with a time constant of 1 ms.
    fn two_steps() -> Vec<Row> {
        let row = |index: u32| {
            let t_ms = f64::from(index) * 0.01;
            let rise = |since: f64| if since > 0.0 { 1.0 - (-since).exp() } else { 0.0 };
            let setpoint_um = f64::from(u8::from(index >= 100) + u8::from(index >= 1_100));
            let amplitude_um = rise(t_ms - 1.0) + rise(t_ms - 11.0);
            Row { t_s: t_ms / 1e3, setpoint_um, amplitude_um, ..Row::default() }
        };
        (0..2_000).map(row).collect()
    }

    fn marked(settling_ms: Value) -> Settling {
        let metrics = Map::from_iter([("settling_time_ms".to_owned(), settling_ms)]);
        let trace = "traces/a/000.csv".to_owned();
        let trial = TrialRecord {
            index: 0,
            seed: 1,
            trace,
            metrics,
            sha256: None,
            telemetry: Telemetry::default(),
            cause: None,
            reason: None,
            diverged_at_s: None,
            wall_ms: None,
        };
        let rows = two_steps();
        settling(&trial, &curves::steps_ms(&rows), &rows)
    }

    #[test]
    fn of_two_steps_the_one_that_the_number_fits_is_marked() {
        let instant = |settling| match settling {
            Settling::At { instant_ms, .. } => instant_ms,
            other => panic!("{other:?}"),
        };
        // 1 µm less 5 % after ln 20; 2 µm less 5 %, coming from 1 µm, after ln 10.
        assert!((instant(marked(json!(20.0_f64.ln()))) - (1.0 + 20.0_f64.ln())).abs() < 1e-9);
        assert!((instant(marked(json!(10.0_f64.ln()))) - (11.0 + 10.0_f64.ln())).abs() < 1e-9);
        assert_eq!(marked(Value::Null), Settling::Never);
    }
}
