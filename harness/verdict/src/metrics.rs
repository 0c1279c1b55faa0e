//! Measures one trial from its trace, and selects the worst window of an expectation.

use platebench_model::metrics::{MeasureInput, MetricSignal, ValidIf};
use platebench_model::record::{MissingValue, Telemetry, UndefinedValue, WorstInstant};
use platebench_model::scenario::{Expectation, Window};
use platebench_model::trace::{Flags, Row};

pub use platebench_model::metrics::{Measure, Measurement, setpoint_steps};

/// As [`measure_with_instants`], without the instants.
pub fn measure(expectation: &Expectation, rows: &[Row], telemetry: &Telemetry) -> Measure {
    measure_with_extremes(expectation, rows, &[], telemetry)
}

/// As [`measure`], with rows at extremes of the signal between `rows`, in the order of time.
pub(crate) fn measure_with_extremes(
    expectation: &Expectation,
    rows: &[Row],
    extremes: &[Row],
    telemetry: &Telemetry,
) -> Measure {
    measure_worst_window(expectation, rows, extremes, telemetry).0.measure
}

/// The measure, and the instants of the worst window, which decides. They are `None` if no window
/// was measured. A standard deviation over trials gives the window mean in percent of the setpoint.
/// A trial with a NaN or infinite drive command has no number.
pub fn measure_with_instants(
    expectation: &Expectation,
    trial: u32,
    rows: &[Row],
    telemetry: &Telemetry,
) -> (Measure, Option<WorstInstant>) {
    let (Measurement { measure, mut worst }, window) = measure_worst_window(expectation, rows, &[], telemetry);
    // JSON has no NaN.
    worst.retain(|point| point.value.is_finite());
    let instants =
        window.map(|window| WorstInstant { trial, window_ms: [window.from.ms(), window.to.ms()], points: worst });
    (measure, instants)
}

fn measure_worst_window(
    expectation: &Expectation,
    rows: &[Row],
    extremes: &[Row],
    telemetry: &Telemetry,
) -> (Measurement, Option<Window>) {
    let (mut measurement, window) = measure_trace(expectation, rows, extremes, telemetry);
    let has_number = !matches!(measurement.measure, Measure::Missing(_) | Measure::Undefined(_));
    if telemetry.not_finite.is_some() && has_number {
        measurement.measure = Measure::Missing(MissingValue::NonFiniteDrive);
    }
    (measurement, window)
}

fn measure_trace(
    expectation: &Expectation,
    rows: &[Row],
    extremes: &[Row],
    telemetry: &Telemetry,
) -> (Measurement, Option<Window>) {
    let spec = expectation.metric.spec();
    let Some(last) = rows.last() else { return (Measure::Undefined(UndefinedValue::EmptyTrace).into(), None) };
    // A controller that ended has no value of any metric: the bench applied the 0 V.
    let has_stopped = last.flags.contains(Flags::SAFE) && spec.valid_if == ValidIf::Running;
    if telemetry.ended.is_some() || has_stopped {
        return (Measure::Missing(MissingValue::NotRunning).into(), None);
    }
    let sensed = last.flags.contains(Flags::SENSED);
    if let Some(unknown) = spec.on_real_plate.filter(|_| sensed) {
        return (Measure::Undefined(unknown).into(), None);
    }
    let signal = MetricSignal::from_name(expectation.signal, sensed);
    let measurements = expectation.windows.iter().map(|window| {
        let input = MeasureInput {
            rows,
            extremes,
            from_s: window.from.seconds(),
            to_s: window.to.seconds(),
            signal,
            band_percent: expectation.band_percent,
            comparison: expectation.comparison,
            text: &expectation.text,
            firmware_log: telemetry.firmware_log(),
            reports: telemetry.reports(),
        };
        let measurement = (spec.measure)(&input).unwrap_or_else(|unknown| Measure::Undefined(unknown).into());
        (severity(expectation, &measurement.measure), measurement, *window)
    });
    let worst = measurements.reduce(|worst, other| if other.0 > worst.0 { other } else { worst });
    worst.map_or((Measure::Undefined(UndefinedValue::EmptyWindow).into(), None), |(_, measurement, window)| {
        (measurement, Some(window))
    })
}

/// Rank (0 good, 1 undefined, 2 breaks the limit, 3 missing) and distance from the limit.
fn severity(expectation: &Expectation, measure: &Measure) -> (u8, f64) {
    let (lowest, highest) = expectation.range();
    match measure {
        Measure::Missing(_) => (3, 0.0),
        Measure::Undefined(_) => (1, 0.0),
        Measure::Samples(_) => (0, 0.0),
        Measure::Value(value) | Measure::Interval([_, value]) => {
            // A signed value is judged without its sign; other values are not negative.
            let exceedance = (lowest - value.abs()).max(value.abs() - highest);
            (if exceedance > 0.0 { 2 } else { 0 }, exceedance)
        }
    }
}

#[cfg(test)]
mod tests;
