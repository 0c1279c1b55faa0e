//! Measures the largest minus the smallest value of the signal over a window.

use super::input::{MeasureInput, largest_row};
use super::measurement::{Measurement, UndefinedValue};
use super::spec::{Levels, LimitMarkSpec, MetricSpec, Unit, WindowRule};

pub(super) const MICROMETRES: MetricSpec = MetricSpec {
    name: "ripple_um",
    unit: Unit::Micrometres,
    definition: "largest minus smallest x over the window",
    window: WindowRule::ConstantSetpoint,
    takes_signal: true,
    mark: Some(LimitMarkSpec { signal: None, levels: Levels::None, label: "extremes" }),
    measure: |input| measurement(input, ripple_um(input)?),
    ..MetricSpec::DEFAULT
};

pub(super) const PERCENT: MetricSpec = MetricSpec {
    name: "ripple_percent",
    unit: Unit::Percent,
    definition: "largest minus smallest x over the window, relative to the setpoint",
    needs_setpoint: true,
    measure: ripple_percent,
    ..MICROMETRES
};

fn ripple_percent(input: &MeasureInput<'_>) -> Result<Measurement, UndefinedValue> {
    let um = ripple_um(input)?;
    let setpoint = input.window_rows().first().map(|row| row.setpoint_um).filter(|setpoint| *setpoint > 0.0);
    measurement(input, um / setpoint.ok_or(UndefinedValue::ZeroSetpoint)? * 100.0)
}

fn ripple_um(input: &MeasureInput<'_>) -> Result<f64, UndefinedValue> {
    let values = || input.window_rows().iter().map(|row| input.value_in(row));
    let ends = values().reduce(f64::max).zip(values().reduce(f64::min));
    ends.map(|(high, low)| high - low).ok_or(UndefinedValue::EmptyWindow)
}

/// The value, at the row with the largest and the row with the smallest signal.
#[expect(clippy::unnecessary_wraps, reason = "the result of a metric")]
fn measurement(input: &MeasureInput<'_>, value: f64) -> Result<Measurement, UndefinedValue> {
    let rows = input.window_rows();
    let highest = largest_row(rows, |row| input.value_in(row));
    let lowest = largest_row(rows, |row| -input.value_in(row));
    Ok(Measurement::value_at(value, highest.into_iter().chain(lowest).map(|row| input.point(row))))
}
