//! The methods' part of `platebench stability`: the largest stable step of each, measured beside theory, in words.

use platebench_methods::{Limit, LimitRow};
use std::fmt::Write as _;

/// What has to be known to read the table.
pub(super) const NOTE: &str = "The step up to which a method's own free motion dies out, by bisection on the spectral radius of its step, beside theory. The bench itself \
                               plays the exact forms, which have no limit; the others are what a simulation would be made of otherwise.";

/// The table, for a terminal.
pub(super) fn table(rows: &[LimitRow]) -> String {
    let mut text = format!(
        "Methods: the largest stable step\n\n{:<20} {:<38} {:>10} {:>10} {:>11}  in the usual unit\n",
        "method", "problem", "measured", "theory", "difference"
    );
    for row in rows {
        // To a hundredth of a percent, in which there is no −0.
        let hundredths = |share: f64| (share * 1e4).round() as i64 as f64 / 100.0;
        let difference = row.deviation().map_or_else(|| "–".to_owned(), |share| format!("{:.2} %", hundredths(share)));
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{:<20} {:<38} {:>10} {:>10} {difference:>11}  {}",
            row.method,
            row.problem,
            shown(row.measured),
            shown(row.predicted),
            row.told
        );
    }
    text
}

fn shown(limit: Limit) -> String {
    match limit {
        Limit::Never => "none".to_owned(),
        Limit::Always => "no limit".to_owned(),
        Limit::Step(seconds) if seconds < 1e-6 => format!("{:.3} ns", seconds * 1e9),
        Limit::Step(seconds) if seconds < 1e-3 => format!("{:.3} µs", seconds * 1e6),
        Limit::Step(seconds) => format!("{:.3} ms", seconds * 1e3),
    }
}
