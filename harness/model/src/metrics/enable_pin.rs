//! Measures how fast the pin that enables the amplifier goes low.

use super::input::{MeasureInput, rounded_ms};
use super::measurement::{Measure, Measurement, MissingValue, UndefinedValue};
use super::spec::{ElapsedLabels, MetricSpec, Subject, Unit, ValidIf, WindowRule};

pub(super) const ENABLE_OFF: MetricSpec = MetricSpec {
    name: "enable_off_ms",
    unit: Unit::Milliseconds,
    definition: "from `from_ms` (required), the instant of a fault, to the instant from which \
                 the pin PB0, which enables the amplifier, is low until the end of the trial; in lockstep on the \
                 emulated rig only, a scenario with it is not applicable elsewhere",
    window: WindowRule::FromDisturbance,
    subject: Subject::Controller,
    valid_if: ValidIf::Present,
    on_real_plate: Some(UndefinedValue::NotReported),
    elapsed: Some(ElapsedLabels { reached: "disabled after", not_reached: "stays enabled", is_on_drive: true }),
    measure: enable_off,
    ..MetricSpec::DEFAULT
};

fn enable_off(input: &MeasureInput<'_>) -> Result<Measurement, UndefinedValue> {
    let pin = input.reports.enable_pin.ok_or(UndefinedValue::NotReported)?;
    let measure = match pin.low_from_s {
        _ if !pin.was_high => Measure::Missing(MissingValue::NeverEnabled),
        None => Measure::Missing(MissingValue::StaysEnabled),
        Some(low_from) if low_from < input.from_s => Measure::Missing(MissingValue::StoppedBefore),
        Some(low_from) => Measure::Value(rounded_ms((low_from - input.from_s) * 1e3)),
    };
    Ok(measure.into())
}
