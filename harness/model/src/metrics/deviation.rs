//! Measures how far the signal goes from the setpoint: beyond a step, or in a window.

use super::input::{MeasureInput, largest_row};
use super::measurement::{Measurement, UndefinedValue};
use super::spec::{DriveBound, Levels, LimitMarkSpec, MetricSpec, Unit, WindowRule};
use crate::trace::Row;

const DEVIATION: MetricSpec =
    MetricSpec { unit: Unit::Percent, takes_signal: true, needs_setpoint: true, ..MetricSpec::DEFAULT };

pub(super) const OVERSHOOT: MetricSpec = MetricSpec {
    name: "overshoot_percent",
    definition: "largest distance of x beyond the new s in the direction of the step, relative to the step height",
    window: WindowRule::StepResponse,
    mark: Some(LimitMarkSpec { signal: None, levels: Levels::PercentOfStep, label: "worst" }),
    measure: overshoot,
    ..DEVIATION
};

pub(super) const PEAK_DEVIATION: MetricSpec = MetricSpec {
    name: "peak_deviation_percent",
    definition: "largest |x − s|/s in the window, which `from_ms`, `until_ms` or `after` must give",
    window: WindowRule::Required,
    takes_band: true,
    drive_bound: DriveBound::Smallest,
    mark: Some(LimitMarkSpec { signal: None, levels: Levels::PercentOfSetpoint, label: "worst" }),
    measure: peak_deviation,
    ..DEVIATION
};

fn overshoot(input: &MeasureInput<'_>) -> Result<Measurement, UndefinedValue> {
    let (rows, before) = input.step_response().ok_or(UndefinedValue::NoSetpointStep)?;
    let setpoint = rows.last().ok_or(UndefinedValue::EmptyTrace)?.setpoint_um;
    let step = setpoint - before;
    if step == 0.0 {
        return Err(UndefinedValue::NoNetStep);
    }
    let beyond = |row: &Row| (input.value_in(row) - setpoint) / step;
    let worst = largest_row(rows, beyond);
    let value = worst.map_or(0.0, beyond).max(0.0) * 100.0;
    Ok(Measurement::value_at(value, worst.map(|row| input.point(row))))
}

fn peak_deviation(input: &MeasureInput<'_>) -> Result<Measurement, UndefinedValue> {
    let rows = input.window_rows();
    let deviation = |row: &Row| (input.value_in(row) - row.setpoint_um).abs() / row.setpoint_um;
    let peak = rows.iter().filter(|row| row.setpoint_um > 0.0).map(deviation).reduce(f64::max);
    let value = peak.ok_or(UndefinedValue::NoSetpointToDeviateFrom)? * 100.0;
    let worst = largest_row(rows, |row| if row.setpoint_um > 0.0 { deviation(row) } else { 0.0 });
    Ok(Measurement::value_at(value, worst.map(|row| input.point(row))))
}
