//! Measures settling and recovery: the time to the last entry into the band around the setpoint.

use super::input::{MeasureInput, rounded_ms};
use super::measurement::{Measure, Measurement, MissingValue, SignalPoint, UndefinedValue};
use super::spec::{DriveBound, ElapsedLabels, Levels, LimitMarkSpec, MetricSpec, Unit, WindowRule};
use crate::trace::{Flags, Row};

const BAND_ENTRY: MetricSpec = MetricSpec {
    unit: Unit::Milliseconds,
    takes_band: true,
    takes_signal: true,
    needs_setpoint: true,
    drive_bound: DriveBound::Smallest,
    mark: Some(LimitMarkSpec { signal: None, levels: Levels::Band, label: "last outside the band" }),
    ..MetricSpec::DEFAULT
};

pub(super) const SETTLING_TIME: MetricSpec = MetricSpec {
    name: "settling_time_ms",
    definition: "from the setpoint step to the last entry of x into the band before the next step",
    window: WindowRule::StepResponse,
    measure: settling_time,
    ..BAND_ENTRY
};

pub(super) const RECOVERY_TIME: MetricSpec = MetricSpec {
    name: "recovery_time_ms",
    definition: "from the disturbance at `from_ms` to the last entry of x into the band in the window, which \
                 `from_ms`, `until_ms` or `after` must give; 0 if x never leaves the band",
    window: WindowRule::Required,
    on_real_plate: Some(UndefinedValue::UnknownDisturbance),
    elapsed: Some(ElapsedLabels { reached: "recovered after", not_reached: "does not recover", is_on_drive: false }),
    measure: recovery_time,
    ..BAND_ENTRY
};

fn settling_time(input: &MeasureInput<'_>) -> Result<Measurement, UndefinedValue> {
    let (rows, _) = input.step_response().ok_or(UndefinedValue::NoSetpointStep)?;
    let (first, last) = rows.first().zip(rows.last()).ok_or(UndefinedValue::EmptyTrace)?;
    if last.setpoint_um == 0.0 {
        return Err(UndefinedValue::NoBand);
    }
    let outside = last_outside(input, rows);
    let measure = match last_band_entry(input, rows, outside) {
        Some(entry) => elapsed_ms(first.t_s, entry),
        None => Measure::Missing(MissingValue::NeverSettles),
    };
    Ok(Measurement { measure, worst: point(input, rows, outside) })
}

fn recovery_time(input: &MeasureInput<'_>) -> Result<Measurement, UndefinedValue> {
    let rows = input.window_rows();
    if rows.last().is_none_or(|row| row.setpoint_um == 0.0) {
        return Err(UndefinedValue::NoSetpointToRecoverTo);
    }
    let outside = last_outside(input, rows);
    let measure = match last_band_entry(input, rows, outside) {
        Some(entry) if rows.first().is_some_and(|first| entry == [first.t_s; 2]) => Measure::Value(0.0),
        Some(entry) => elapsed_ms(input.from_s, entry),
        None => Measure::Missing(MissingValue::NeverRecovers),
    };
    Ok(Measurement { measure, worst: point(input, rows, outside) })
}

/// Number of the last row outside the band.
fn last_outside(input: &MeasureInput<'_>, rows: &[Row]) -> Option<usize> {
    rows.iter().rposition(input.is_outside())
}

fn point(input: &MeasureInput<'_>, rows: &[Row], number: Option<usize>) -> Vec<SignalPoint> {
    number.and_then(|number| rows.get(number)).map(|row| input.point(row)).into_iter().collect()
}

/// Interval, s, that contains the last entry into the band. Both ends are equal for a signal that
/// is known between rows. `None` if the signal ends outside. `outside` is the last row there.
fn last_band_entry(input: &MeasureInput<'_>, rows: &[Row], outside: Option<usize>) -> Option<[f64; 2]> {
    if input.signal.is_zero_order_hold {
        return last_sampled_band_entry(input, rows);
    }
    let Some(outside) = outside else { return rows.first().map(|row| [row.t_s; 2]) };
    let (left, entered) = (rows.get(outside)?, rows.get(outside + 1)?);
    // Distance from the edge through which the signal enters. The edge may move between the rows.
    let below = input.value_in(left) < input.band(left.setpoint_um).0;
    let beyond = |row: &Row| {
        let (low, high) = input.band(row.setpoint_um);
        if below { low - input.value_in(row) } else { input.value_in(row) - high }
    };
    let (from, to) = (beyond(left), beyond(entered));
    // A signal that jumps across the whole band crosses the other edge.
    let share = if to <= 0.0 { from / (from - to) } else { 1.0 };
    Some([left.t_s + (entered.t_s - left.t_s) * share; 2])
}

/// Like [`last_band_entry`], for a sampled signal: from the last sample outside to the next sample.
fn last_sampled_band_entry(input: &MeasureInput<'_>, rows: &[Row]) -> Option<[f64; 2]> {
    let has_flags = rows.iter().any(|row| row.flags.contains(Flags::CONTROL));
    // Rows between control instants repeat the last sample; a trace without flags has samples only.
    let mut samples = rows.iter().filter(|row| !has_flags || row.flags.contains(Flags::CONTROL));
    let start = rows.first()?.t_s;
    let mut is_outside = input.is_outside();
    let outside = samples.clone().rfind(|row| is_outside(row)).map(|row| row.t_s);
    let entered = samples.find(|row| outside.is_none_or(|outside| row.t_s > outside))?;
    Some([outside.unwrap_or(start), entered.t_s])
}

fn elapsed_ms(from_s: f64, entry: [f64; 2]) -> Measure {
    let [first, last] = entry.map(|t_s| (t_s - from_s) * 1e3);
    if first == last { Measure::Value(last) } else { Measure::Interval([first, last].map(rounded_ms)) }
}
