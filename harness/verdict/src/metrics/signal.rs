//! Reads a column of a trace as a signal.

use platebench_scenario::Expectation;
use platebench_trace::{AmplitudeColumn, Row};

#[derive(Clone, Copy)]
pub(super) struct MetricSignal {
    column: AmplitudeColumn,
    /// True for samples, which stay constant until the next one. False for the motion of the plate.
    pub(super) is_zero_order_hold: bool,
}

impl MetricSignal {
    pub(super) fn from_name(name: &str, sensed: bool) -> Self {
        let column =
            AmplitudeColumn::ALL.into_iter().find(|column| column.name() == name).unwrap_or(AmplitudeColumn::Amplitude);
        let is_sample = matches!(column, AmplitudeColumn::SensedWd | AmplitudeColumn::SensedWq);
        Self { column, is_zero_order_hold: sensed || is_sample }
    }

    pub(super) fn value_in(self, row: &Row) -> f64 {
        self.column.value(row)
    }

    pub(super) fn is_outside(self, row: &Row, expectation: &Expectation) -> bool {
        let (low, high) = expectation.band(row.setpoint_um);
        !(low..=high).contains(&self.value_in(row))
    }
}
