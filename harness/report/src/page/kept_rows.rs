//! Keeps rows of a run in memory, so that its report need not read the traces.

use platebench_model::trace::Row;
use std::collections::BTreeMap;

/// Largest number of kept rows, about 56 MB. The report reads the other traces from their files.
const MAX_ROWS: usize = 500_000;

#[derive(Debug, Clone, Default)]
pub struct RowCache {
    by_trace: BTreeMap<String, Vec<Row>>,
    count: usize,
}

impl RowCache {
    /// `trace` is relative to the run folder. Drops rows beyond `MAX_ROWS`.
    pub fn add(&mut self, trace: &str, rows: Vec<Row>) {
        if !rows.is_empty() && self.count + rows.len() <= MAX_ROWS {
            self.count += rows.len();
            self.by_trace.insert(trace.to_owned(), rows);
        }
    }

    pub(super) fn get(&self, trace: &str) -> Option<&[Row]> {
        self.by_trace.get(trace).map(Vec::as_slice)
    }
}
