//! Selects the rows of a trial from which a metric is computed.
//!
//! The engine adds a row on either side of every crossing of an expected band. The plate's signals
//! count as linear between rows. This changes a settling time by less than 1 ns, or by some µs if
//! the run did not know the band. The controller's samples are known at control instants only, so a
//! time measured from them is an interval.

use super::measurement::{SignalPoint, UndefinedValue};
use crate::scenario::expect::Comparison;
use crate::trace::{Column, Flags, Row};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What a metric is computed from. Instants are in s since the start of the trial.
#[derive(Debug, Clone, Copy)]
pub struct MeasureInput<'a> {
    /// All rows of the trial.
    pub rows: &'a [Row],
    /// Rows at extremes of the signal between `rows`, if a search found them. Only the metrics of
    /// extremes read them.
    pub extremes: &'a [Row],
    pub from_s: f64,
    /// End of the window. A row at this instant belongs to the next window, except at the end of
    /// the trace.
    pub to_s: f64,
    pub signal: MetricSignal,
    pub band_percent: f64,
    pub comparison: Comparison,
    /// Empty for metrics without the key `text`.
    pub text: &'a str,
    /// `None` on rigs that do not see the text of the firmware.
    pub firmware_log: Option<FirmwareLog<'a>>,
    pub reports: RigReports,
}

/// Numbers that the rig reports about a whole trial; `None` if it does not measure them.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RigReports {
    pub loop_delay_us: Option<f64>,
    pub instructions_worst: Option<f64>,
    pub step_time_percent: Option<f64>,
    pub reference_difference_percent: Option<f64>,
    pub protocol_differences: Option<f64>,
    /// True if a stall of the computer may have caused further differences.
    pub has_undecided_scripts: bool,
    pub enable_pin: Option<EnablePin>,
}

/// The pin that enables the amplifier, PB0 of an emulated chip.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct EnablePin {
    /// True if it was high in the trial.
    pub was_high: bool,
    /// Instant from which it is low to the end of the trial, s; `null` if it is high at the end.
    pub low_from_s: Option<f64>,
}

/// Text that the firmware wrote in a trial.
#[derive(Debug, Clone, Copy)]
pub struct FirmwareLog<'a> {
    pub text: &'a str,
    /// In the order of time. A remark of the bench may follow the text of the last one.
    pub reads: &'a [OutputRead],
}

/// A part of the text, and the interval of time in which the firmware wrote it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct OutputRead {
    /// End of the part, bytes from the start of the text.
    pub end: usize,
    /// Instant of the read before it, s. Text from before the trial has 0.
    pub from_s: f64,
    /// Instant of the read, s.
    pub to_s: f64,
}

#[derive(Debug, Clone, Copy)]
pub struct MetricSignal {
    column: Column,
    /// True for samples, which stay constant until the next one. False for the motion of the plate.
    pub(crate) is_zero_order_hold: bool,
}

impl MetricSignal {
    pub fn from_name(name: &str, sensed: bool) -> Self {
        let column = Column::from_name(name).unwrap_or(Column::Amplitude);
        let is_sample = matches!(column, Column::SensedWd | Column::SensedWq);
        Self { column, is_zero_order_hold: sensed || is_sample }
    }
}

/// Lower and upper edge of the band around the setpoint. Both belong to the band.
pub(crate) fn band_around(setpoint: f64, percent: f64) -> (f64, f64) {
    let half = setpoint.abs() * percent / 100.0;
    (setpoint - half, setpoint + half)
}

impl<'a> MeasureInput<'a> {
    pub(crate) fn value_in(&self, row: &Row) -> f64 {
        self.signal.column.value(row)
    }

    pub(crate) fn point(&self, row: &Row) -> SignalPoint {
        SignalPoint::of(row, |row| self.value_in(row))
    }

    pub(crate) fn band(&self, setpoint: f64) -> (f64, f64) {
        band_around(setpoint, self.band_percent)
    }

    /// Returns whether the signal of a row is outside the band. Most rows have one setpoint, so the
    /// band is computed if it changes.
    pub(crate) fn is_outside(&self) -> impl FnMut(&Row) -> bool {
        let (mut setpoint, mut band) = (f64::NAN, (f64::NAN, f64::NAN));
        move |row| {
            if setpoint != row.setpoint_um {
                (setpoint, band) = (row.setpoint_um, self.band(row.setpoint_um));
            }
            !(band.0..=band.1).contains(&self.value_in(row))
        }
    }

    /// The largest `value` of the rows and of the extremes between them, and its last row.
    pub(crate) fn largest(&self, rows: &'a [Row], value: impl Fn(&Row) -> f64) -> Option<(f64, &'a Row)> {
        let between = rows.first().zip(rows.last()).map(|(first, last)| first.t_s..=last.t_s);
        let extremes =
            self.extremes.iter().filter(|row| between.as_ref().is_some_and(|times| times.contains(&row.t_s)));
        largest_row(rows.iter().chain(extremes), value)
    }

    pub(crate) fn window_rows(&self) -> &'a [Row] {
        let start = self.rows.partition_point(|row| row.t_s < self.from_s);
        self.rows.get(start..end_index(self.to_s, self.rows)).unwrap_or_default()
    }

    /// Also contains the row before the window, whose drive and flags are in force at its start.
    pub(crate) fn window_rows_with_previous(&self) -> &'a [Row] {
        let inside = self.window_rows();
        if inside.first().is_some_and(|row| row.t_s == self.from_s) {
            return inside;
        }
        let start = self.rows.partition_point(|row| row.t_s < self.from_s);
        self.rows.get(start.saturating_sub(1)..start + inside.len()).unwrap_or_default()
    }

    pub(crate) fn last_row(&self) -> Result<&'a Row, UndefinedValue> {
        self.window_rows().last().ok_or(UndefinedValue::EmptyWindow)
    }

    /// Rows up to the end of the window, also those before it.
    pub(crate) fn rows_until_end(&self) -> &'a [Row] {
        self.rows.get(..end_index(self.to_s, self.rows)).unwrap_or_default()
    }

    /// Rows from the step to the next step or the end of the window, and the setpoint before the
    /// step.
    pub(crate) fn step_response(&self) -> Option<(&'a [Row], f64)> {
        let rows = self.rows;
        let delay = if rows.iter().any(|row| row.flags.contains(Flags::SENSED)) { MAX_TELEMETRY_DELAY_S } else { 0.0 };
        let steps = setpoint_steps(rows);
        let is_after = |step: &&usize| rows.get(**step).is_some_and(|row| row.t_s >= self.from_s);
        let position = steps.iter().position(|step| is_after(&step)).unwrap_or(steps.len().saturating_sub(1));
        let start = *steps.get(position)?;
        let window_end = end_index(self.to_s + delay, rows);
        let end = steps.get(position + 1).copied().unwrap_or(rows.len()).min(window_end);
        let before = start.checked_sub(1).and_then(|index| rows.get(index)).map_or(0.0, |row| row.setpoint_um);
        rows.get(start..end).map(|part| (part, before))
    }
}

/// The telemetry of a real plate shows a setpoint up to this much later than the profile.
const MAX_TELEMETRY_DELAY_S: f64 = 0.1;

/// Number of rows before `to_s`; all rows if the trace ends by then.
fn end_index(to_s: f64, rows: &[Row]) -> usize {
    let is_last = rows.last().is_none_or(|row| to_s >= row.t_s);
    if is_last { rows.len() } else { rows.partition_point(|row| row.t_s < to_s) }
}

/// The largest value, and the last row that has it. A value that is NaN is not the largest.
pub(crate) fn largest_row<'a>(
    rows: impl Iterator<Item = &'a Row>,
    value: impl Fn(&Row) -> f64,
) -> Option<(f64, &'a Row)> {
    let values = rows.map(|row| (value(row), row));
    values.reduce(|largest, next| if next.0 >= largest.0 || largest.0.is_nan() { next } else { largest })
}

/// Indices of the rows at which steps start. A constant setpoint above 0 steps at the start. A ramp
/// or curve is one step from the row before its first change. It ends when two instants in a row do
/// not change, because a curve may rest for one instant at its crest.
pub fn setpoint_steps(rows: &[Row]) -> Vec<usize> {
    let mut steps = Vec::new();
    let mut before = 0.0;
    let (mut next, mut moved) = (0, 0_u32);
    while let Some((rest, changed)) = first_change(rows.get(next..).unwrap_or_default(), before) {
        // The rows of the instant with the change, and the instants before it without one.
        let is_same = |row: &&Row| row.t_s == changed.t_s;
        let earlier = rest.iter().rev().take_while(is_same).count();
        let quiet = rest.get(..rest.len() - earlier).unwrap_or_default();
        let rested =
            quiet.first().zip(quiet.last()).map_or(0, |(first, last)| if first.t_s == last.t_s { 1 } else { 2 });
        let (start, index) = (next + quiet.len(), next + rest.len());
        let continues = moved > 0 && (rested == 0 || (moved > 1 && rested == 1));
        if continues {
            moved += 1;
        } else {
            steps.push(index);
            // The initial setpoint is no change that a ramp could continue.
            moved = u32::from(start > 0);
        }
        if moved == 2 && continues {
            // Two changes in a row are a ramp, which starts at the row before the first change.
            let began = steps.pop().map_or(0, |step| step.saturating_sub(1));
            if steps.last() != Some(&began) {
                steps.push(began);
            }
        }
        let later = rows.get(index + 1..).unwrap_or_default().iter().take_while(is_same).count();
        next = index + 1 + later;
        before = rows.get(next - 1).map_or(before, |row| row.setpoint_um);
    }
    steps
}

/// The rows before the first one with another setpoint than `before`, and this row.
fn first_change(rows: &[Row], before: f64) -> Option<(&[Row], &Row)> {
    let index = rows.iter().position(|row| row.setpoint_um != before)?;
    rows.get(..index).zip(rows.get(index))
}

/// Time stamps have a resolution of 1 µs, so picoseconds are rounding and must not decide.
pub(crate) fn rounded_ms(ms: f64) -> f64 {
    (ms * 1e9).round() / 1e9
}
