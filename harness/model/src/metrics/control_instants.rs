//! Measures what happened at the control instants of the window.

use super::input::MeasureInput;
use super::measurement::{Measure, Measurement, UndefinedValue};
use super::spec::{MetricSpec, Subject, TrialRule, Unit, ValidIf};
use crate::scenario::expect::Comparison;
use crate::trace::{Flags, Row};
use platebench_plate::Time;

pub(super) const OVERRUNS: MetricSpec = MetricSpec {
    name: "overruns",
    definition: "control instants for which the bench was too late",
    subject: Subject::Rig,
    on_real_plate: Some(UndefinedValue::NotInLoop),
    measure: |input| Ok(count_flagged(input, Flags::OVERRUN)),
    ..MetricSpec::DEFAULT
};

pub(super) const MISSED_REPLIES: MetricSpec = MetricSpec {
    name: "missed_replies",
    definition: "control instants without an answer before the next one",
    subject: Subject::Controller,
    valid_if: ValidIf::Present,
    on_real_plate: Some(UndefinedValue::NotInLoop),
    measure: |input| Ok(count_flagged(input, Flags::CONTROL | Flags::LINK_LOST)),
    ..MetricSpec::DEFAULT
};

pub(super) const TRIAL_DIFFERENCE: MetricSpec = MetricSpec {
    name: "trial_difference_um",
    unit: Unit::Micrometres,
    definition: "over trials: largest distance of x from x of the first trial at the same control instant; each \
                 further trial is judged. In `[other_trials]` x is divided by `amplitude_factor` and taken `later_ms` \
                 later. Infinite if a trial has another number of control instants. A scene without \
                 noise and spread should give 0 up to the resolution of the wire. All trials are played by one \
                 controller in their order",
    trials: TrialRule::FromFirst,
    takes_signal: true,
    measure: |input| {
        let Comparison { amplitude_factor, later } = input.comparison;
        // A command acts at a row of its own, at an instant that differs by rounding only.
        let later_row = |row: &Row| {
            let at_s = row.t_s + later.seconds() - 1e-10;
            input.rows.iter().find(|row| row.t_s >= at_s)
        };
        let control = control_rows(input, Flags::CONTROL);
        let control = control.filter_map(|row| if later == Time::ZERO { Some(row) } else { later_row(row) });
        Ok(Measure::Samples(control.map(|row| input.value_in(row) / amplitude_factor).collect()).into())
    },
    ..MetricSpec::DEFAULT
};

fn control_rows<'a>(input: &MeasureInput<'a>, flags: Flags) -> impl Iterator<Item = &'a Row> {
    input.window_rows().iter().filter(move |row| row.flags.contains(flags))
}

fn count_flagged(input: &MeasureInput<'_>, flags: Flags) -> Measurement {
    (control_rows(input, flags).count() as f64).into()
}
