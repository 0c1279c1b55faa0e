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
        let (highest, point) = highest_drive(input).unzip();
        Ok(Measurement::value_at(highest.map_or(0.0, |vpp| vpp.max(0.0)), point))
    },
    ..DRIVE
};

pub(super) const REST_DRIVE: MetricSpec = MetricSpec {
    name: "rest_drive_vpp",
    definition: "largest drive while the setpoint is 0, from one period and loop delay after it became 0",
    window: WindowRule::SetpointZero,
    measure: |input| {
        let (highest, point) = highest_drive(input).ok_or(UndefinedValue::EmptyWindow)?;
        Ok(Measurement::value_at(highest, [point]))
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

/// The row before the window counts at the start of the window.
fn highest_drive(input: &MeasureInput<'_>) -> Option<(f64, SignalPoint)> {
    let (highest, row) = largest_row(input.window_rows_with_previous().iter(), |row| row.drive_vpp)?;
    Some((highest, SignalPoint::new(row.t_s.max(input.from_s), highest)))
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
