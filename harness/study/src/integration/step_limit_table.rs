//! Formats the largest stable step of each method, measured and predicted.

use crate::integration::stability::{StepLimit, StepLimitRow};
use std::fmt::Write as _;

pub(crate) const NOTE: &str = "Up to this step the free motion of a method decays: measured by bisection on the \
    spectral radius of its step, and predicted by theory. The bench itself uses the exact forms, which have no limit.";

pub(crate) fn limits_table(rows: &[StepLimitRow]) -> String {
    let mut text = format!(
        "Methods: the largest stable step\n\n{:<20} {:<38} {:>10} {:>10} {:>11}  in the usual unit\n",
        "method", "problem", "measured", "theory", "difference"
    );
    for row in rows {
        // Rounded to 0.01 %, without −0.
        let hundredths = |share: f64| (share * 1e4).round() as i64 as f64 / 100.0;
        let difference = row.deviation().map_or_else(|| "–".to_owned(), |share| format!("{:.2} %", hundredths(share)));
        let _ = writeln!(
            text,
            "{:<20} {:<38} {:>10} {:>10} {difference:>11}  {}",
            row.method,
            row.problem,
            format_limit(row.measured),
            format_limit(row.predicted),
            row.in_usual_unit
        );
    }
    text
}

fn format_limit(limit: StepLimit) -> String {
    match limit {
        StepLimit::Never => "none".to_owned(),
        StepLimit::Always => "no limit".to_owned(),
        StepLimit::Step(seconds) if seconds < 1e-6 => format!("{:.3} ns", seconds * 1e9),
        StepLimit::Step(seconds) if seconds < 1e-3 => format!("{:.3} µs", seconds * 1e6),
        StepLimit::Step(seconds) => format!("{:.3} ms", seconds * 1e3),
    }
}
