//! Measures the time-weighted mean over a window with a constant setpoint.

use super::input::MeasureInput;
use super::measurement::{Measurement, SignalPoint, UndefinedValue};
use super::spec::{DriveBound, Levels, LimitMarkSpec, MetricSpec, TrialRule, Unit, WindowRule};

const WINDOW_MEAN: MetricSpec = MetricSpec {
    unit: Unit::Percent,
    window: WindowRule::ConstantSetpoint,
    takes_signal: true,
    needs_setpoint: true,
    ..MetricSpec::DEFAULT
};

/// Twice the bound of the propagation error, percent of the setpoint.
const SIMULATION_ERROR_PERCENT: f64 = 2e-4;

pub(super) const STATIC_ERROR: MetricSpec = MetricSpec {
    name: "static_error_percent",
    definition: "|mean(x) − s|/s over the window, weighted with time",
    trials: TrialRule::Mean,
    is_signed: true,
    simulation_error: SIMULATION_ERROR_PERCENT,
    drive_bound: DriveBound::Smallest,
    mark: Some(LimitMarkSpec { signal: None, levels: Levels::PercentOfSetpointAndValue, label: "mean" }),
    measure: static_error,
    ..WINDOW_MEAN
};

/// The value of a trial is the mean in percent of the setpoint.
pub(super) const REPEATABILITY: MetricSpec = MetricSpec {
    name: "repeatability_percent",
    definition: "standard deviation (n − 1) over trials of mean(x)/s over the window",
    trials: TrialRule::Deviation,
    drive_bound: DriveBound::MeanBelowSetpoint,
    measure: |input| Ok((window_mean(input)?.ratio() * 100.0).into()),
    ..WINDOW_MEAN
};

fn static_error(input: &MeasureInput<'_>) -> Result<Measurement, UndefinedValue> {
    let mean = window_mean(input)?;
    let end = input.window_rows().last().map(|row| SignalPoint::new(row.t_s, mean.value));
    Ok(Measurement::value_at((mean.ratio() - 1.0) * 100.0, end))
}

struct WindowMean {
    value: f64,
    setpoint: f64,
}

impl WindowMean {
    fn ratio(&self) -> f64 {
        self.value / self.setpoint
    }
}

/// Fails if the setpoint changes, because a stuck signal could match its mean.
fn window_mean(input: &MeasureInput<'_>) -> Result<WindowMean, UndefinedValue> {
    let mut setpoint = None;
    let (mut area, mut length) = (0.0, 0.0);
    // The row before the window is in force at its start.
    let first = input.rows.partition_point(|row| row.t_s <= input.from_s).saturating_sub(1);
    let rows = input.rows.get(first..).unwrap_or_default();
    for [left, right] in rows.array_windows().take_while(|[left, _]| left.t_s < input.to_s) {
        let (start, end) = (left.t_s.max(input.from_s), right.t_s.min(input.to_s));
        if start >= end {
            continue;
        }
        if *setpoint.get_or_insert(left.setpoint_um) != left.setpoint_um {
            return Err(UndefinedValue::SetpointChanges);
        }
        let level = if input.signal.is_zero_order_hold {
            input.value_in(left)
        } else {
            // The mean over a linear piece is its value at the middle.
            let share = (f64::midpoint(start, end) - left.t_s) / (right.t_s - left.t_s);
            input.value_in(left) + (input.value_in(right) - input.value_in(left)) * share
        };
        area += (end - start) * level;
        length += end - start;
    }
    match setpoint {
        Some(setpoint) if setpoint > 0.0 => Ok(WindowMean { value: area / length, setpoint }),
        Some(_) => Err(UndefinedValue::ZeroSetpoint),
        None => Err(UndefinedValue::EmptyWindow),
    }
}
