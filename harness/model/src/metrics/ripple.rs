//! Measures the largest minus the smallest value of the signal over a window.

use super::input::MeasureInput;
use super::measurement::{Measurement, SignalPoint, UndefinedValue};
use super::spec::{Levels, LimitMarkSpec, MetricSpec, Unit, WindowRule};

pub(super) const MICROMETRES: MetricSpec = MetricSpec {
    name: "ripple_um",
    unit: Unit::Micrometres,
    definition: "largest minus smallest x over the window",
    window: WindowRule::ConstantSetpoint,
    takes_signal: true,
    mark: Some(LimitMarkSpec { signal: None, levels: Levels::None, label: "extremes" }),
    measure: |input| ripple_um(input).map(|(um, worst)| Measurement::value_at(um, worst)),
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
    let (um, worst) = ripple_um(input)?;
    let setpoint = input.window_rows().first().map(|row| row.setpoint_um).filter(|setpoint| *setpoint > 0.0);
    let percent = um / setpoint.ok_or(UndefinedValue::ZeroSetpoint)? * 100.0;
    Ok(Measurement::value_at(percent, worst))
}

/// The ripple in µm, and the points with the largest and with the smallest signal.
fn ripple_um(input: &MeasureInput<'_>) -> Result<(f64, [SignalPoint; 2]), UndefinedValue> {
    let rows = input.window_rows();
    let highest = input.largest(rows, |row| input.value_in(row));
    let lowest = input.largest(rows, |row| -input.value_in(row));
    let ((highest, high), (lowest, low)) = highest.zip(lowest).ok_or(UndefinedValue::EmptyWindow)?;
    Ok((highest + lowest, [high, low].map(|row| input.point(row))))
}
