//! The traces of a scenario, read once each and reduced to what its figures show.
//!
//! Neighbours: `curves` reduces, `figure` draws. What cannot be read is named, in words that fit into the report; it
//! is no error.

use super::curves::{self, Envelope, Point, Signal, Window};
use super::grid::Grid;
use super::resolution::Resolution;
use super::timed::{Timed, timed};
use crate::evidence;
use platebench_trace::{Flags, Row, TraceError};
use platebench_verdict::{Definition, ScenarioRecord, TrialRecord, Verdict};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Trials whose traces are read; of more, also the one that decided a verdict.
pub(crate) const TRIALS: usize = 30;
/// What is said of a trace that was changed after the run.
pub(crate) const CHANGED: &str = "not the file that the run was made with";
/// Points that are kept of a line that another scenario is shown against, in whatever window that takes.
const OVERLAY_POINTS: usize = 4_000;
/// Half width of the band in records that do not tell it, percent of the setpoint: what scenarios have unless they say otherwise.
const BAND_PERCENT: f64 = 5.0;
/// More instants of overruns are not marked.
const OVERRUNS: usize = 200;

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
    /// What was to come in time in the first trial.
    pub(crate) timed: Vec<Timed>,
    /// What could not be read and why.
    pub(crate) missing: Vec<String>,
    /// |W| of the first trial.
    pub(crate) amplitude: Vec<Point>,
    /// The band around the setpoint, and where it is looked at.
    pub(crate) band: Band,
    /// Instants of the interactive curves.
    pub(crate) grid: Grid,
    /// The trials there, in the order in which they were read.
    pub(crate) sampled: Vec<Sampled>,
    /// Where no sample of any trial was answered.
    pub(crate) lost: Vec<Window>,
    /// For which instants the bench was too late, over all trials, ms.
    pub(crate) overruns: Vec<f64>,
}

/// A trial at the instants of the grid.
#[derive(Debug, Clone)]
pub(crate) struct Sampled {
    pub(crate) index: u32,
    /// With every peak.
    pub(crate) lines: BTreeMap<Signal, Vec<Option<f64>>>,
    /// At the very instants.
    pub(crate) at: BTreeMap<Signal, Vec<Option<f64>>>,
}

/// A band around the setpoint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Band {
    /// Half width, percent of the setpoint.
    pub(crate) percent: f64,
    /// True where it is held around a component of the vibration instead of |W|.
    pub(crate) of_components: bool,
}

impl Default for Band {
    fn default() -> Self {
        Self { percent: BAND_PERCENT, of_components: false }
    }
}

impl Band {
    /// The edge on that side of a setpoint, 1 above and -1 below.
    pub(crate) fn edge(self, setpoint: f64, side: f64) -> f64 {
        setpoint + side * setpoint.abs() * self.percent / 100.0
    }
}

/// The number of the expectation whose band and settling time are drawn: of those with a settling time the first that did not pass, or else the first; without
/// one, the first that has a band.
fn settling_expectation(scenario: &ScenarioRecord) -> Option<usize> {
    let all = || scenario.expectations.iter().enumerate();
    let settling = || all().filter(|(_, found)| found.metric == "settling_time_ms");
    let not_passed = settling().find(|(_, found)| found.verdict != Verdict::Pass);
    let banded = all().find(|(_, found)| found.definition.band_percent.is_some());
    not_passed.or_else(|| settling().next()).or(banded).map(|(index, _)| index)
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
    fn new(window: Window, resolution: Resolution) -> Self {
        let envelope = |signal| Envelope::new(window, signal, resolution.buckets);
        let strand = |signal| Strand { first: vec![], exhibit: vec![], envelope: envelope(signal) };
        let strands = Signal::ALL.into_iter().map(|signal| (signal, strand(signal))).collect();
        Self { window, strands, saturated: Vec::new() }
    }

    fn take(&mut self, rows: &[Row], is_first: bool, is_exhibit: bool, points: usize) {
        for (&signal, strand) in &mut self.strands {
            if is_first {
                strand.first = curves::line(rows, signal, self.window, points);
            } else if is_exhibit {
                strand.exhibit = curves::line(rows, signal, self.window, points);
            }
            strand.envelope.widen(rows, signal);
        }
        let spans = curves::flagged(rows, self.window, Flags::SATURATED);
        self.saturated = curves::merged(std::mem::take(&mut self.saturated).into_iter().chain(spans).collect());
    }
}

impl Bundle {
    /// Reads the traces of `scenario` below the run's `folder`, but for those that were `changed` after the run.
    pub(crate) fn read(
        scenario: &ScenarioRecord,
        folder: &Path,
        resolution: Resolution,
        changed: &BTreeSet<String>,
    ) -> Self {
        let mut bundle = Self::default();
        let exhibit = exhibit(scenario);
        for (position, trial) in scenario.trials.iter().enumerate() {
            let is_exhibit = exhibit.as_ref().is_some_and(|(index, _)| *index == trial.index);
            if position >= TRIALS && !is_exhibit {
                continue;
            }
            if changed.contains(&trial.trace) {
                bundle.missing.push(format!("{}: {CHANGED}", trial.trace));
                continue;
            }
            match platebench_trace::read(&folder.join(&trial.trace)) {
                Ok(rows) => bundle.take(scenario, trial, &rows, is_exhibit, resolution),
                Err(error) => bundle.missing.push(format!("{}: {}", trial.trace, reason(&error))),
            }
        }
        bundle.exhibit = exhibit.filter(|_| bundle.views.iter().any(View::has_exhibit));
        bundle
    }

    /// The first trial at the instants of another scenario's grid.
    pub(crate) fn first_on(&self, grid: &Grid) -> Option<Sampled> {
        let first = self.sampled.first()?;
        let onto = |signal: Signal, line: &Vec<Option<f64>>| {
            let known = self.grid.t_ms.iter().zip(line).filter_map(|(t_ms, value)| Some((*t_ms, (*value)?)));
            let known: Vec<Point> = known.collect();
            grid.t_ms.iter().map(|t_ms| curves::on_line(&known, signal, *t_ms)).collect()
        };
        let lines: BTreeMap<Signal, _> =
            first.lines.iter().map(|(signal, line)| (*signal, onto(*signal, line))).collect();
        Some(Sampled { index: first.index, lines, at: BTreeMap::new() })
    }

    fn take(
        &mut self,
        scenario: &ScenarioRecord,
        trial: &TrialRecord,
        rows: &[Row],
        is_exhibit: bool,
        resolution: Resolution,
    ) {
        let is_first = self.views.is_empty();
        if is_first {
            self.first = trial.index;
            let steps = curves::steps_ms(rows);
            let expected = settling_expectation(scenario);
            let definition = expected.and_then(|index| Some(&scenario.expectations.get(index)?.definition));
            let definition = definition.cloned().unwrap_or_default();
            self.band = Band {
                percent: definition.band_percent.unwrap_or(BAND_PERCENT),
                of_components: definition.signal.as_ref().is_some_and(|signal| signal != "amplitude_um"),
            };
            let key = expected.map_or_else(|| SETTLING.to_owned(), |index| evidence::key(scenario, index));
            let settling = if key.starts_with(SETTLING) {
                settling(trial, &key, &definition, &steps, rows)
            } else {
                Settling::Unknown
            };
            let step_ms = match settling {
                Settling::At { instant_ms, after_ms } => Some(instant_ms - after_ms),
                _ => counted_from(&definition, &steps),
            };
            self.timed = timed(scenario, trial, settling, expected, step_ms);
            let whole = whole(rows);
            let response = response(scenario, settling, whole);
            self.grid = Grid::new(rows, whole, response, resolution.instants);
            self.views = response.into_iter().chain([whole]).map(|window| View::new(window, resolution)).collect();
            self.amplitude = curves::line(rows, Signal::Amplitude, whole, OVERLAY_POINTS);
        }
        for view in &mut self.views {
            view.take(rows, is_first, is_exhibit, resolution.points);
        }
        let window = Window { from_ms: f64::NEG_INFINITY, to_ms: f64::INFINITY };
        let lost = curves::flagged(rows, window, Flags::LINK_LOST);
        self.lost = curves::merged(std::mem::take(&mut self.lost).into_iter().chain(lost).collect());
        self.overruns.extend(curves::overruns(rows).take(OVERRUNS.saturating_sub(self.overruns.len())));
        let grid = &self.grid;
        let sampled = |of: fn(&Grid, &[Row], Signal) -> Vec<Option<f64>>| {
            Signal::ALL.into_iter().map(|signal| (signal, of(grid, rows, signal))).collect()
        };
        self.sampled.push(Sampled { index: trial.index, lines: sampled(Grid::line), at: sampled(Grid::at) });
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

const SETTLING: &str = "settling_time_ms";

/// Whether the trial settles, and when, by the number under `key`. It counts from the last setpoint step up to the instant that the expectation names, or from
/// the first. Records that do not tell their band do not tell that instant either: of several steps it is then the one after which the amplitude crosses
/// the band's edge at that time.
fn settling(trial: &TrialRecord, key: &str, definition: &Definition, steps: &[f64], rows: &[Row]) -> Settling {
    let after_ms = match trial.metrics.get(key) {
        None => return Settling::Unknown,
        Some(Value::Number(number)) => number.as_f64().unwrap_or(0.0),
        Some(_) => return Settling::Never,
    };
    let step = if definition.band_percent.is_some() {
        counted_from(definition, steps)
    } else {
        let distance = |step_ms: f64| {
            let at = |signal| curves::value_at(rows, signal, step_ms + after_ms);
            let (amplitude, setpoint) = (at(Signal::Amplitude), at(Signal::Setpoint));
            let off = amplitude.zip(setpoint);
            let off = off.map(|(w, wished)| (((w - wished) / wished).abs() - BAND_PERCENT / 100.0).abs());
            off.filter(|off| off.is_finite()).unwrap_or(f64::MAX)
        };
        steps.iter().copied().min_by(|a, b| distance(*a).total_cmp(&distance(*b)))
    };
    step.map_or(Settling::Unknown, |step_ms| Settling::At { instant_ms: step_ms + after_ms, after_ms })
}

/// The setpoint step that a settling time counts from, where the record tells its definition.
fn counted_from(definition: &Definition, steps: &[f64]) -> Option<f64> {
    definition.band_percent?;
    let passed = definition.from_ms.map_or(1, |from_ms| steps.partition_point(|step_ms| *step_ms <= from_ms));
    steps.get(passed.saturating_sub(1)).copied()
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

    fn marked(settling_ms: Value, definition: &Definition) -> Settling {
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
        settling(&trial, SETTLING, definition, &curves::steps_ms(&rows), &rows)
    }

    fn instant(settling: Settling) -> f64 {
        match settling {
            Settling::At { instant_ms, .. } => instant_ms,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn of_two_steps_the_one_that_the_number_fits_is_marked() {
        let marked = |value| marked(value, &Definition::default());
        // 1 µm less 5 % after ln 20; 2 µm less 5 %, coming from 1 µm, after ln 10.
        assert!((instant(marked(json!(20.0_f64.ln()))) - (1.0 + 20.0_f64.ln())).abs() < 1e-9);
        assert!((instant(marked(json!(10.0_f64.ln()))) - (11.0 + 10.0_f64.ln())).abs() < 1e-9);
        assert_eq!(marked(Value::Null), Settling::Never);
    }

    #[test]
    fn the_step_that_the_record_names_is_taken() {
        let after = |from_ms| {
            let definition = Definition { from_ms, band_percent: Some(1.0), signal: None };
            instant(marked(json!(3.0), &definition))
        };
        // The steps stand in the rows at 1 ms and at 11 ms.
        assert_eq!([after(None), after(Some(0.5)), after(Some(10.99))], [4.0, 4.0, 4.0]);
        assert_eq!([after(Some(11.0)), after(Some(30.0))], [14.0, 14.0]);
    }
}
