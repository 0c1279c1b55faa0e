//! Measures the drive. It holds between rows, so the row before the window counts too.

use super::input::{MeasureInput, largest_row};
use super::measurement::{Measurement, SignalPoint, UndefinedValue};
use super::spec::{Levels, LimitMarkSpec, MetricSpec, Unit, WindowRule};
use crate::trace::{Column, Flags, Row};

const DRIVE: MetricSpec = MetricSpec {
    unit: Unit::Vpp,
    mark: Some(LimitMarkSpec { signal: Some(Column::Drive), levels: Levels::Constant, label: "worst" }),
    ..MetricSpec::DEFAULT
};

pub(super) const DRIVE_PEAK: MetricSpec = MetricSpec {
    name: "drive_peak_vpp",
    definition: "highest drive",
    measure: |input| {
        let highest = drives(input).fold(0.0, f64::max);
        Ok(Measurement::value_at(highest, highest_drive(input)))
    },
    ..DRIVE
};

pub(super) const REST_DRIVE: MetricSpec = MetricSpec {
    name: "rest_drive_vpp",
    definition: "largest drive while the setpoint is 0, from one period and loop delay after it became 0",
    window: WindowRule::SetpointZero,
    measure: |input| {
        let highest = drives(input).reduce(f64::max).ok_or(UndefinedValue::EmptyWindow)?;
        Ok(Measurement::value_at(highest, highest_drive(input)))
    },
    ..DRIVE
};

pub(super) const SATURATED: MetricSpec = MetricSpec {
    name: "saturated_percent",
    unit: Unit::Percent,
    definition: "share of the time with the drive at the amplifier's limit",
    value_range: (0.0, 100.0),
    measure: |input| Ok((flagged_share(input.window_rows_with_previous(), Flags::SATURATED) * 100.0).into()),
    ..MetricSpec::DEFAULT
};

fn drives(input: &MeasureInput<'_>) -> impl Iterator<Item = f64> {
    input.window_rows_with_previous().iter().map(|row| row.drive_vpp)
}

/// The row before the window counts at the start of the window.
fn highest_drive(input: &MeasureInput<'_>) -> Option<SignalPoint> {
    let row = largest_row(input.window_rows_with_previous(), |row| row.drive_vpp)?;
    Some(SignalPoint::new(row.t_s.max(input.from_s), row.drive_vpp))
}

fn flagged_share(rows: &[Row], flag: Flags) -> f64 {
    let (Some(first), Some(last)) = (rows.first(), rows.last()) else { return 0.0 };
    let flagged: f64 = rows
        .array_windows()
        .filter(|[left, _]| left.flags.contains(flag))
        .map(|[left, right]| right.t_s - left.t_s)
        .sum();
    if last.t_s > first.t_s { flagged / (last.t_s - first.t_s) } else { 0.0 }
}
