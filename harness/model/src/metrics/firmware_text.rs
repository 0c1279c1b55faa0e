//! Measures when the firmware writes a text by RTT.

use super::input::{MeasureInput, OutputRead, rounded_ms};
use super::measurement::{Measure, Measurement, MissingValue, UndefinedValue};
use super::spec::{ElapsedLabels, MetricSpec, Subject, Unit, ValidIf, WindowRule};

pub(super) const TEXT: MetricSpec = MetricSpec {
    name: "text_ms",
    unit: Unit::Milliseconds,
    definition: "from `from_ms` (required) to the instant at which the firmware has written the key `text` (required) \
                 [by RTT](your-own-firmware.md#text-of-the-firmware): the interval between two reads of the bench, \
                 which reads at each control instant, after each answer and at each fault of the chip. Text from \
                 before the trial has the instant 0; in lockstep on the emulated rig only, a scenario with it is not \
                 applicable elsewhere and to firmware without RTT",
    window: WindowRule::FromDisturbance,
    subject: Subject::Controller,
    valid_if: ValidIf::Present,
    on_real_plate: Some(UndefinedValue::NotReported),
    elapsed: Some(ElapsedLabels { reached: "text after", not_reached: "text is missing", is_on_drive: false }),
    measure: text_time,
    ..MetricSpec::DEFAULT
};

fn text_time(input: &MeasureInput<'_>) -> Result<Measurement, UndefinedValue> {
    let log = input.firmware_log.ok_or(UndefinedValue::NotReported)?;
    let written = log.text.get(..log.reads.last().map_or(0, |read| read.end)).unwrap_or_default();
    // At the start of the trial, text from before it counts.
    let is_late_enough = |read: &&OutputRead| read.to_s > input.from_s || input.from_s == 0.0;
    let first = written
        .match_indices(input.text)
        .filter_map(|(start, found)| log.reads.iter().find(|read| read.end >= start + found.len()))
        .find(is_late_enough);
    let measure = match first {
        Some(read) if read.from_s < input.to_s => {
            let [from, to] = [read.from_s, read.to_s].map(|at| rounded_ms((at - input.from_s).max(0.0) * 1e3));
            if from == to { Measure::Value(to) } else { Measure::Interval([from, to]) }
        }
        None if written.len() < log.text.len() => return Err(UndefinedValue::CutText),
        _ => Measure::Missing(MissingValue::NoText),
    };
    Ok(measure.into())
}
