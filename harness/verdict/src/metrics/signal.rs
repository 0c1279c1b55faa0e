//! Reads a column of a trace as a signal.

use platebench_model::scenario::Expectation;
use platebench_model::trace::{Column, Row};

#[derive(Clone, Copy)]
pub(super) struct MetricSignal {
    column: Column,
    /// True for samples, which stay constant until the next one. False for the motion of the plate.
    pub(super) is_zero_order_hold: bool,
}

impl MetricSignal {
    pub(super) fn from_name(name: &str, sensed: bool) -> Self {
        let column = Column::from_name(name).unwrap_or(Column::Amplitude);
        let is_sample = matches!(column, Column::SensedWd | Column::SensedWq);
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
