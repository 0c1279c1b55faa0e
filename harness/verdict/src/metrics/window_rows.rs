//! Selects the rows of a window.

use platebench_scenario::Window;
use platebench_trace::Row;

/// The row at the end belongs to the next window, except at the end of the trace.
pub(super) fn window_rows<'a>(window: &Window, rows: &'a [Row]) -> &'a [Row] {
    let (from, to) = (window.from.seconds(), window.to.seconds());
    let start = rows.partition_point(|row| row.t_s < from);
    let is_last = rows.last().is_none_or(|row| to >= row.t_s);
    let end = if is_last { rows.len() } else { rows.partition_point(|row| row.t_s < to) };
    rows.get(start..end).unwrap_or_default()
}

/// With the row before, whose drive and flags are in force at the start of the window.
pub(super) fn window_rows_with_previous<'a>(window: &Window, rows: &'a [Row]) -> &'a [Row] {
    let inside = window_rows(window, rows);
    let from = window.from.seconds();
    if inside.first().is_some_and(|row| row.t_s == from) {
        return inside;
    }
    let start = rows.partition_point(|row| row.t_s < from);
    rows.get(start.saturating_sub(1)..start + inside.len()).unwrap_or_default()
}
