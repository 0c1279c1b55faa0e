//! Takes the metrics that the rig reports about a whole trial.

use super::input::RigReports;
use super::measurement::{Measurement, UndefinedValue};
use super::spec::{MetricSpec, Subject, Unit, WindowRule};

const REPORTED: MetricSpec = MetricSpec {
    window: WindowRule::WholeTrial,
    subject: Subject::Controller,
    on_real_plate: Some(UndefinedValue::NotInLoop),
    ..MetricSpec::DEFAULT
};

pub(super) const LOOP_DELAY: MetricSpec = MetricSpec {
    name: "loop_delay_us",
    unit: Unit::Microseconds,
    definition: "longest time from sampling to actuation",
    subject: Subject::Rig,
    measure: |input| reported(input.reports.loop_delay_us),
    ..REPORTED
};

pub(super) const INSTRUCTIONS_PER_STEP: MetricSpec = MetricSpec {
    name: "instructions_per_step",
    definition: "most instructions of one control step, on rigs that count them \
                 ([the emulated target](emulated-target.md)); inconclusive on others",
    on_real_plate: Some(UndefinedValue::UncountedInstructions),
    measure: |input| reported(input.reports.instructions_worst),
    ..REPORTED
};

pub(super) const STEP_TIME: MetricSpec = MetricSpec {
    name: "step_time_percent",
    unit: Unit::Percent,
    definition: "longest control step on the emulated chip at one instruction per cycle, relative to the control \
                 period ([time of a control step](emulated-target.md#time-of-a-control-step)). Without an expectation \
                 the limit is 100 %, [below](#checks-of-every-trial); in lockstep on the emulated rig only, a scenario \
                 with it is not applicable elsewhere",
    on_real_plate: Some(UndefinedValue::UncountedInstructions),
    measure: |input| reported(input.reports.step_time_percent),
    ..REPORTED
};

pub(super) const REFERENCE_DIFFERENCE: MetricSpec = MetricSpec {
    name: "reference_difference_percent",
    unit: Unit::Percent,
    definition: "largest difference of a command from that of the reference, this project's implementation of the \
                 same law on the PC, for the same bytes: the drive in percent of its limit, the frequency in percent \
                 of its range. 100 if only one of the two stopped, except by its watchdog; in lockstep only, a \
                 scenario with it is not applicable to other clocks",
    measure: |input| reported(input.reports.reference_difference_percent),
    ..REPORTED
};

pub(super) const PROTOCOL_DIFFERENCES: MetricSpec = MetricSpec {
    name: "protocol_differences",
    definition: "message scripts that the controller answers differently from the reference; in lockstep only, as \
                 `reference_difference_percent`",
    measure: |input| match input.reports {
        RigReports { protocol_differences: Some(0.0), has_undecided_scripts: true, .. } => {
            Err(UndefinedValue::StalledScripts)
        }
        reports => reported(reports.protocol_differences),
    },
    ..REPORTED
};

fn reported(value: Option<f64>) -> Result<Measurement, UndefinedValue> {
    value.map(Measurement::from).ok_or(UndefinedValue::NotReported)
}
