//! Numbers of one trial, off its trace alone.
//!
//! The runner puts a row on either side of every crossing of an expected band, found on the continuous solution; between rows the plate's signals
//! are taken as straight, which then moves a settling time by less than a nanosecond. For a band that the run did not know of it moves by some
//! microseconds at the default row spacing. What the controller was given is known at the control instants only, so a time read off it is an interval: from
//! the last sample outside to the first one that stays inside.

use crate::record::Telemetry;
use platebench_plate::Time;
use platebench_scenario::{Expectation, Metric, Window};
use platebench_trace::{Column, Flags, Row};

/// What a metric came to in a trial.
#[derive(Debug, Clone, PartialEq)]
pub enum Measure {
    /// A number. The static error carries its sign here: mean − setpoint.
    Value(f64),
    /// A number between these two: it was read off samples, and what happened between two of them nobody saw.
    Between([f64; 2]),
    /// There is none, and that is the controller's failure: it never settled.
    Missing(&'static str),
    /// There is none, because the trial does not have what the metric is about.
    Undefined(&'static str),
}

impl Measure {
    /// The number, if there is one; the upper end of what samples leave.
    pub fn value(&self) -> Option<f64> {
        match self {
            Self::Value(value) | Self::Between([_, value]) => Some(*value),
            Self::Missing(_) | Self::Undefined(_) => None,
        }
    }
}

/// The metric of `expectation` in a trial, where the controller's commands left no doubt of what it wanted. [`Metric::Repeatability`] gives the trial's contribution: its window mean over the setpoint, in percent.
pub fn measure(expectation: &Expectation, rows: &[Row], telemetry: &Telemetry) -> Measure {
    let measure = of_trace(expectation, rows, telemetry);
    let has_number = matches!(measure, Measure::Value(_) | Measure::Between(_));
    match breach(telemetry).filter(|_| has_number && expectation.metric != Metric::MissedReplies) {
        Some(what) => Measure::Missing(what),
        None => measure,
    }
}

/// What the controller commanded that the trace cannot show: the plate that it shows was driven by less than that.
fn breach(telemetry: &Telemetry) -> Option<&'static str> {
    if telemetry.not_finite.is_some() {
        Some("0 V took the place of a drive that is no number")
    } else {
        (telemetry.contradictions > 0).then_some("answered one sample with two different commands")
    }
}

fn of_trace(expectation: &Expectation, rows: &[Row], telemetry: &Telemetry) -> Measure {
    let Some(last) = rows.last() else { return Measure::Undefined("the trace is empty") };
    // A controller that has given up neither overshoots nor saturates: that is no merit, unless giving up is what was asked of it.
    // Not if it was cut off: the 0 V is then the bench's own.
    let is_of_the_line = matches!(expectation.metric, Metric::ShutdownTime | Metric::MissedReplies);
    if last.flags.contains(Flags::SAFE) && !(is_of_the_line && telemetry.ended.is_none()) {
        return Measure::Missing("ends with the controller not running");
    }
    let sensed = last.flags.contains(Flags::SENSED);
    if let Some(why) = unobservable(expectation.metric).filter(|_| sensed) {
        return Measure::Undefined(why);
    }
    let signal = Signal::named(expectation.signal, sensed);
    match expectation.metric {
        Metric::SettlingTime => settling_time(expectation, signal, rows),
        Metric::RecoveryTime => recovery_time(expectation, signal, rows),
        Metric::Overshoot => overshoot(expectation, signal, rows),
        Metric::PeakDeviation => peak_deviation(expectation, signal, rows),
        Metric::StaticError => match window_ratio(signal, &expectation.window, rows) {
            Ok(ratio) => Measure::Value((ratio - 1.0) * 100.0),
            Err(what) => Measure::Undefined(what),
        },
        Metric::Repeatability => match window_ratio(signal, &expectation.window, rows) {
            Ok(ratio) => Measure::Value(ratio * 100.0),
            Err(what) => Measure::Undefined(what),
        },
        Metric::FrequencyError => Measure::Value((last.frequency_hz - last.resonance_hz).abs()),
        Metric::QuadratureRatio if last.wd_um == 0.0 => Measure::Undefined("Wd is 0 at the end"),
        Metric::QuadratureRatio => Measure::Value((last.wq_um / last.wd_um).abs()),
        Metric::FinalAmplitude => Measure::Value(last.amplitude_um),
        Metric::DrivePeak => Measure::Value(rows.iter().map(|row| row.drive_vpp).fold(0.0, f64::max)),
        Metric::Saturated => Measure::Value(flagged_share(rows, Flags::SATURATED) * 100.0),
        Metric::LoopDelay => told(telemetry.loop_delay_us),
        Metric::InstructionsPerStep => told(telemetry.instructions_worst),
        Metric::Overruns => count(rows, Flags::OVERRUN),
        Metric::ShutdownTime => shutdown_time(&expectation.window, rows),
        Metric::MissedReplies => count(rows, Flags::CONTROL | Flags::LINK_LOST),
    }
}

/// Why a metric cannot be had of a real plate, of which there is nothing but what its own controller tells.
const fn unobservable(metric: Metric) -> Option<&'static str> {
    match metric {
        Metric::FrequencyError => Some("the true resonance of a real plate is not known"),
        Metric::RecoveryTime => Some("the instant at which a person's hand disturbs a real plate is not known"),
        Metric::Overruns | Metric::MissedReplies | Metric::LoopDelay => {
            Some("the bench is not in the loop of a real plate")
        }
        Metric::InstructionsPerStep => Some("a controller that drives a real plate does not tell its instructions"),
        Metric::SettlingTime
        | Metric::StaticError
        | Metric::Repeatability
        | Metric::Overshoot
        | Metric::PeakDeviation
        | Metric::QuadratureRatio
        | Metric::FinalAmplitude
        | Metric::DrivePeak
        | Metric::Saturated
        | Metric::ShutdownTime => None,
    }
}

fn count(rows: &[Row], flags: Flags) -> Measure {
    Measure::Value(rows.iter().filter(|row| row.flags.contains(flags)).count() as f64)
}

fn told(number: Option<f64>) -> Measure {
    number.map_or(Measure::Undefined("the rig does not tell"), Measure::Value)
}

/// A column with its behaviour between rows.
#[derive(Clone, Copy)]
struct Signal {
    column: Column,
    /// The plate moves on between rows; what the controller was given stays.
    held: bool,
}

impl Signal {
    fn named(name: &str, sensed: bool) -> Self {
        let column = Column::ALL.into_iter().find(|column| column.name() == name).unwrap_or(Column::Amplitude);
        Self { column, held: sensed || matches!(column, Column::SensedWd | Column::SensedWq) }
    }

    fn of(self, row: &Row) -> f64 {
        self.column.of(row)
    }

    fn is_outside(self, row: &Row, expectation: &Expectation) -> bool {
        let (low, high) = expectation.band(row.setpoint_um);
        !(low..=high).contains(&self.of(row))
    }
}

/// Index of each row at which the setpoint starts to move; a constant one moves at the start, unless it is 0.
///
/// A jump is over at once. A ramp or a curve moves from row to row and is one step; it began at the row before the first that differs, and it is over
/// when two instants in a row have not moved: a curve may stand still for one at its crest.
pub fn setpoint_steps(rows: &[Row]) -> Vec<usize> {
    let mut steps = Vec::new();
    let mut before = 0.0;
    let mut start = 0;
    // Instants that moved, and instants that have rested since.
    let (mut moved, mut rested) = (0_u32, 0_u32);
    // Several rows may share an instant.
    for instant in rows.chunk_by(|a, b| a.t_s == b.t_s) {
        let first_moved = instant.iter().position(|row| row.setpoint_um != before);
        before = instant.last().map_or(before, |row| row.setpoint_um);
        match first_moved {
            Some(offset) => {
                let goes_on = moved > 0 && (rested == 0 || (moved > 1 && rested == 1));
                if goes_on {
                    moved += 1;
                } else {
                    steps.push(start + offset);
                    // What is there from the start is no movement that could go on.
                    moved = u32::from(start > 0);
                }
                if moved == 2 && goes_on {
                    // It was no jump: it has been moving since the row before, which may be the start.
                    let began = steps.pop().map_or(0, |step| step.saturating_sub(1));
                    if steps.last() != Some(&began) {
                        steps.push(began);
                    }
                }
                rested = 0;
            }
            None => rested += 1,
        }
        start += instant.len();
    }
    steps
}

/// The rows from the setpoint step that `from` asks for up to the next one, and the setpoint before it.
fn after_step<'a>(expectation: &Expectation, rows: &'a [Row]) -> Option<(&'a [Row], f64)> {
    let steps = setpoint_steps(rows);
    let chosen = match expectation.from {
        None => 0,
        Some(from) => {
            let passed = steps.partition_point(|&step| rows.get(step).is_some_and(|row| row.t_s <= from.seconds()));
            passed.saturating_sub(1)
        }
    };
    let start = *steps.get(chosen)?;
    let end = steps.get(chosen + 1).copied().unwrap_or(rows.len());
    let before = start.checked_sub(1).and_then(|index| rows.get(index)).map_or(0.0, |row| row.setpoint_um);
    rows.get(start..end).map(|part| (part, before))
}

/// The seconds between which the signal enters the band for the last time, both the same where the solution is known; `None` where it ends outside.
fn last_entry(expectation: &Expectation, signal: Signal, rows: &[Row]) -> Option<[f64; 2]> {
    if signal.held {
        return last_entry_of_samples(expectation, signal, rows);
    }
    let Some(outside) = rows.iter().rposition(|row| signal.is_outside(row, expectation)) else {
        return rows.first().map(|row| [row.t_s; 2]);
    };
    let (left, entered) = (rows.get(outside)?, rows.get(outside + 1)?);
    // How far outside the edge that it comes in by, which may be moving itself; not positive once inside.
    let below = signal.of(left) < expectation.band(left.setpoint_um).0;
    let beyond = |row: &Row| {
        let (low, high) = expectation.band(row.setpoint_um);
        if below { low - signal.of(row) } else { signal.of(row) - high }
    };
    let (from, to) = (beyond(left), beyond(entered));
    // Where it jumped across the whole band there is no edge to come in by.
    let share = if to <= 0.0 { from / (from - to) } else { 1.0 };
    Some([left.t_s + (entered.t_s - left.t_s) * share; 2])
}

/// The same for what is known at control instants alone: from the last sample outside to the first one after it.
fn last_entry_of_samples(expectation: &Expectation, signal: Signal, rows: &[Row]) -> Option<[f64; 2]> {
    let sampled = rows.iter().any(|row| row.flags.contains(Flags::CONTROL));
    // Between control instants the last sample stands in every row; a trace without flags has nothing but samples.
    let mut samples = rows.iter().filter(|row| !sampled || row.flags.contains(Flags::CONTROL));
    let outside = samples.rfind(|row| signal.is_outside(row, expectation)).map(|row| row.t_s);
    let start = rows.first()?.t_s;
    let after = |row: &&Row| outside.is_none_or(|outside| row.t_s > outside);
    let entered = rows.iter().filter(|row| !sampled || row.flags.contains(Flags::CONTROL)).find(after)?;
    Some([outside.unwrap_or(start), entered.t_s])
}

/// A time after `from` in ms.
fn since(from: f64, entry: [f64; 2]) -> Measure {
    let [first, last] = entry.map(|t_s| (t_s - from) * 1e3);
    if first == last { Measure::Value(last) } else { between([first, last]) }
}

/// Samples are stamped to the microsecond, so that picoseconds are rounding and must not decide.
fn between(ends_ms: [f64; 2]) -> Measure {
    Measure::Between(ends_ms.map(|ms| (ms * 1e9).round() / 1e9))
}

fn settling_time(expectation: &Expectation, signal: Signal, rows: &[Row]) -> Measure {
    let Some((rows, _)) = after_step(expectation, rows) else {
        return Measure::Undefined("the setpoint never steps");
    };
    let (Some(first), Some(last)) = (rows.first(), rows.last()) else { return Measure::Undefined("no rows") };
    if last.setpoint_um == 0.0 {
        return Measure::Undefined("a setpoint of 0 has no band");
    }
    match last_entry(expectation, signal, rows) {
        Some(entry) => since(first.t_s, entry),
        None => Measure::Missing("never stays inside the band"),
    }
}

/// The rows from `start` up to the next setpoint step.
fn until_next_step(rows: &[Row], start: usize) -> &[Row] {
    let end = setpoint_steps(rows).into_iter().find(|&step| step > start).unwrap_or(rows.len());
    rows.get(start..end).unwrap_or_default()
}

fn recovery_time(expectation: &Expectation, signal: Signal, rows: &[Row]) -> Measure {
    let from = expectation.from.unwrap_or(Time::ZERO).seconds();
    let rows = until_next_step(rows, rows.partition_point(|row| row.t_s < from));
    if rows.last().is_none_or(|row| row.setpoint_um == 0.0) {
        return Measure::Undefined("no setpoint to recover to");
    }
    match last_entry(expectation, signal, rows) {
        // Never outside: there was nothing to recover from.
        Some(entry) if rows.first().is_some_and(|first| entry == [first.t_s; 2]) => Measure::Value(0.0),
        Some(entry) => since(from, entry),
        None => Measure::Missing("never stays inside the band again"),
    }
}

/// To the instant from which a controller that ran at the start of the window has stopped and the drive is 0 V, up to the window's end.
fn shutdown_time(window: &Window, rows: &[Row]) -> Measure {
    let (from, to) = (window.from.seconds(), window.to.seconds());
    let has_stopped = |row: &Row| row.flags.contains(Flags::SAFE) && row.drive_vpp == 0.0;
    let is_last = to >= rows.last().map_or(0.0, |row| row.t_s);
    let end = if is_last { rows.len() } else { rows.partition_point(|row| row.t_s < to) };
    let rows = rows.get(..end).unwrap_or_default();
    let Some(ran) = rows.iter().rposition(|row| !has_stopped(row)) else {
        return Measure::Missing("never ran");
    };
    let before = rows.get(..=ran).unwrap_or_default();
    if before.iter().any(|row| row.setpoint_um > 0.0) && before.iter().all(|row| row.drive_vpp == 0.0) {
        return Measure::Missing("never drove");
    }
    match rows.get(ran + 1) {
        None => Measure::Missing("does not come to rest at 0 V"),
        Some(stopped) if stopped.t_s < from => Measure::Missing("stopped before"),
        Some(stopped) if stopped.flags.contains(Flags::SENSED) => {
            let last = rows.get(ran).map_or(from, |row| row.t_s).max(from);
            between([last, stopped.t_s].map(|t_s| (t_s - from) * 1e3))
        }
        Some(stopped) => Measure::Value((stopped.t_s - from) * 1e3),
    }
}

fn overshoot(expectation: &Expectation, signal: Signal, rows: &[Row]) -> Measure {
    let Some((rows, before)) = after_step(expectation, rows) else {
        return Measure::Undefined("the setpoint never steps");
    };
    let Some(last) = rows.last() else { return Measure::Undefined("no rows") };
    let step = last.setpoint_um - before;
    if step == 0.0 {
        return Measure::Undefined("the setpoint comes back to where it was");
    }
    let beyond = rows.iter().map(|row| (signal.of(row) - last.setpoint_um) / step).fold(0.0, f64::max);
    Measure::Value(beyond * 100.0)
}

fn peak_deviation(expectation: &Expectation, signal: Signal, rows: &[Row]) -> Measure {
    let looked_at = if let Some(from) = expectation.from {
        until_next_step(rows, rows.partition_point(|row| row.t_s < from.seconds()))
    } else {
        let Some((rows, _)) = after_step(expectation, rows) else {
            return Measure::Undefined("the setpoint never steps");
        };
        let entered = rows.iter().position(|row| !signal.is_outside(row, expectation));
        let Some(entered) = entered else { return Measure::Missing("never enters the band") };
        rows.get(entered..).unwrap_or_default()
    };
    let deviations = looked_at.iter().filter(|row| row.setpoint_um > 0.0);
    let peak = deviations.map(|row| (signal.of(row) - row.setpoint_um).abs() / row.setpoint_um).reduce(f64::max);
    peak.map_or(Measure::Undefined("no setpoint to deviate from"), |peak| Measure::Value(peak * 100.0))
}

/// Mean of the signal over the window, weighted with time, in units of the setpoint, which has to rest there: a mean over a moving one could come
/// out right for a signal that never moved.
fn window_ratio(signal: Signal, window: &Window, rows: &[Row]) -> Result<f64, &'static str> {
    let (from, to) = (window.from.seconds(), window.to.seconds());
    let mut setpoint = None;
    let (mut area, mut length) = (0.0, 0.0);
    for pair in rows.windows(2) {
        let [left, right] = pair else { continue };
        let (start, end) = (left.t_s.max(from), right.t_s.min(to));
        if start >= end {
            continue;
        }
        if *setpoint.get_or_insert(left.setpoint_um) != left.setpoint_um {
            return Err("the setpoint moves in the window");
        }
        let level = if signal.held {
            signal.of(left)
        } else {
            // Straight between the rows: the mean over a piece is the value in its middle.
            let share = (f64::midpoint(start, end) - left.t_s) / (right.t_s - left.t_s);
            signal.of(left) + (signal.of(right) - signal.of(left)) * share
        };
        area += (end - start) * level;
        length += end - start;
    }
    match setpoint {
        Some(setpoint) if setpoint > 0.0 => Ok(area / length / setpoint),
        Some(_) => Err("the setpoint is 0 in the window"),
        None => Err("no rows in the window"),
    }
}

fn flagged_share(rows: &[Row], flag: Flags) -> f64 {
    let (Some(first), Some(last)) = (rows.first(), rows.last()) else { return 0.0 };
    let flagged: f64 = rows
        .windows(2)
        .filter_map(|pair| match pair {
            [left, right] if left.flags.contains(flag) => Some(right.t_s - left.t_s),
            _ => None,
        })
        .sum();
    if last.t_s > first.t_s { flagged / (last.t_s - first.t_s) } else { 0.0 }
}

#[cfg(test)]
mod tests;
