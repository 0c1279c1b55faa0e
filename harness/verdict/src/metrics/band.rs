//! Measures settling, recovery, overshoot and deviation against a band around the setpoint.

use super::measure::Measure;
use super::signal::MetricSignal;
use super::steps::step_response;
use super::window::window_rows;
use platebench_model::record::{MissingValue, UndefinedValue};
use platebench_model::scenario::{Expectation, Window};
use platebench_model::trace::{Flags, Row};

pub(super) fn settling_time(
    expectation: &Expectation,
    window: &Window,
    signal: MetricSignal,
    rows: &[Row],
) -> Result<Measure, UndefinedValue> {
    let (rows, _) = step_response(window, rows).ok_or(UndefinedValue::NoSetpointStep)?;
    let (first, last) = rows.first().zip(rows.last()).ok_or(UndefinedValue::EmptyTrace)?;
    if last.setpoint_um == 0.0 {
        return Err(UndefinedValue::NoBand);
    }
    Ok(match last_band_entry(expectation, signal, rows) {
        Some(entry) => elapsed_ms(first.t_s, entry),
        None => Measure::Missing(MissingValue::NeverSettles),
    })
}

pub(super) fn recovery_time(
    expectation: &Expectation,
    window: &Window,
    signal: MetricSignal,
    rows: &[Row],
) -> Result<Measure, UndefinedValue> {
    let rows = window_rows(window, rows);
    if rows.last().is_none_or(|row| row.setpoint_um == 0.0) {
        return Err(UndefinedValue::NoSetpointToRecoverTo);
    }
    Ok(match last_band_entry(expectation, signal, rows) {
        Some(entry) if rows.first().is_some_and(|first| entry == [first.t_s; 2]) => Measure::Value(0.0),
        Some(entry) => elapsed_ms(window.from.seconds(), entry),
        None => Measure::Missing(MissingValue::NeverRecovers),
    })
}

/// Overshoot in percent of the step.
pub(super) fn overshoot(window: &Window, signal: MetricSignal, rows: &[Row]) -> Result<f64, UndefinedValue> {
    let (rows, before) = step_response(window, rows).ok_or(UndefinedValue::NoSetpointStep)?;
    let last = rows.last().ok_or(UndefinedValue::EmptyTrace)?;
    let step = last.setpoint_um - before;
    if step == 0.0 {
        return Err(UndefinedValue::NoNetStep);
    }
    let beyond = rows.iter().map(|row| (signal.value_in(row) - last.setpoint_um) / step).fold(0.0, f64::max);
    Ok(beyond * 100.0)
}

/// Largest deviation in percent of the setpoint.
pub(super) fn peak_deviation(window: &Window, signal: MetricSignal, rows: &[Row]) -> Result<f64, UndefinedValue> {
    let deviations = window_rows(window, rows).iter().filter(|row| row.setpoint_um > 0.0);
    let peak = deviations.map(|row| (signal.value_in(row) - row.setpoint_um).abs() / row.setpoint_um).reduce(f64::max);
    Ok(peak.ok_or(UndefinedValue::NoSetpointToDeviateFrom)? * 100.0)
}

/// Interval, s, that contains the last entry into the band. Both ends are equal for a signal that
/// is known between rows. `None` if the signal ends outside.
fn last_band_entry(expectation: &Expectation, signal: MetricSignal, rows: &[Row]) -> Option<[f64; 2]> {
    if signal.is_zero_order_hold {
        return last_sampled_band_entry(expectation, signal, rows);
    }
    let Some(outside) = rows.iter().rposition(|row| signal.is_outside(row, expectation)) else {
        return rows.first().map(|row| [row.t_s; 2]);
    };
    let (left, entered) = (rows.get(outside)?, rows.get(outside + 1)?);
    // Distance from the edge through which the signal enters. The edge may move between the rows.
    let below = signal.value_in(left) < expectation.band(left.setpoint_um).0;
    let beyond = |row: &Row| {
        let (low, high) = expectation.band(row.setpoint_um);
        if below { low - signal.value_in(row) } else { signal.value_in(row) - high }
    };
    let (from, to) = (beyond(left), beyond(entered));
    // A signal that jumps across the whole band crosses the other edge.
    let share = if to <= 0.0 { from / (from - to) } else { 1.0 };
    Some([left.t_s + (entered.t_s - left.t_s) * share; 2])
}

/// Like [`last_band_entry`], for a sampled signal: from the last sample outside to the next sample.
fn last_sampled_band_entry(expectation: &Expectation, signal: MetricSignal, rows: &[Row]) -> Option<[f64; 2]> {
    let has_flags = rows.iter().any(|row| row.flags.contains(Flags::CONTROL));
    // Rows between control instants repeat the last sample; a trace without flags has samples only.
    let mut samples = rows.iter().filter(|row| !has_flags || row.flags.contains(Flags::CONTROL));
    let start = rows.first()?.t_s;
    let outside = samples.clone().rfind(|row| signal.is_outside(row, expectation)).map(|row| row.t_s);
    let entered = samples.find(|row| outside.is_none_or(|outside| row.t_s > outside))?;
    Some([outside.unwrap_or(start), entered.t_s])
}

fn elapsed_ms(from_s: f64, entry: [f64; 2]) -> Measure {
    let [first, last] = entry.map(|t_s| (t_s - from_s) * 1e3);
    if first == last { Measure::Value(last) } else { Measure::Interval([first, last].map(rounded_ms)) }
}

/// Time stamps have a resolution of 1 µs, so picoseconds are rounding and must not decide.
pub(super) fn rounded_ms(ms: f64) -> f64 {
    (ms * 1e9).round() / 1e9
}
