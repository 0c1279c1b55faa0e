//! Measures the ripple of a signal.

use platebench_trace::Row;

pub(super) fn ripple_um(rows: &[Row], value: impl Fn(&Row) -> f64) -> Option<f64> {
    let (low, high) = rows
        .iter()
        .map(value)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
    (low <= high).then_some(high - low)
}
