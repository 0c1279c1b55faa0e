//! Measures how far the signal goes from the setpoint: beyond a step, or in a window.

use super::input::MeasureInput;
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
    let worst = input.largest(rows, beyond);
    let value = worst.map_or(0.0, |(value, _)| value).max(0.0) * 100.0;
    Ok(Measurement::value_at(value, worst.map(|(_, row)| input.point(row))))
}

fn peak_deviation(input: &MeasureInput<'_>) -> Result<Measurement, UndefinedValue> {
    let deviation = |row: &Row| {
        let has_setpoint = row.setpoint_um > 0.0;
        if has_setpoint { (input.value_in(row) - row.setpoint_um).abs() / row.setpoint_um } else { f64::NAN }
    };
    let worst = input.largest(input.window_rows(), deviation).filter(|(_, row)| row.setpoint_um > 0.0);
    let (value, row) = worst.ok_or(UndefinedValue::NoSetpointToDeviateFrom)?;
    Ok(Measurement::value_at(value * 100.0, [input.point(row)]))
}
