//! Draws the values of an expectation over earlier runs against its limit.

use super::navigation::margin_text;
use crate::chart::marks::extent;
use crate::format;
use crate::text::history::TrendPoint;
use maud::{Markup, html};
use platebench_model::record::ExpectationRecord;

/// Width and height, CSS pixels.
const SIZE: (f64, f64) = (132.0, 34.0);
const AIR: f64 = 5.0;

/// `points` begin with the oldest run and end with this one. Draws nothing without an earlier run.
pub(super) fn trend(expectation: &ExpectationRecord, points: &[TrendPoint]) -> Markup {
    let ends = format::limit_ends(expectation.limit);
    if points.len() < 2 {
        return Markup::default();
    }
    let values = points.iter().filter_map(|point| point.value).chain(ends.iter().copied());
    let (low, high) = extent(values).unwrap_or_default();
    let (width, height) = SIZE;
    let y = |value: f64| {
        let share = if high > low { (value - low) / (high - low) } else { 0.5 };
        format!("{:.1}", height - AIR - share * (height - 2.0 * AIR))
    };
    let x = |index: usize| format!("{:.1}", AIR + index as f64 * (width - 2.0 * AIR) / (points.len() - 1) as f64);
    let unit = format::unit(expectation.metric);
    let text = |point: &TrendPoint| {
        let value =
            point.value.map_or_else(|| "no value".to_owned(), |value| format!("{} {unit}", format::number(value)));
        let margin = point.margin.map_or_else(String::new, |margin| format!(", margin {}", margin_text(margin)));
        format!("{}: {value}{margin}", point.run)
    };
    let label = points.iter().map(text).collect::<Vec<_>>().join("; ");
    html! {
        svg.trend viewBox={ "0 0 " (width) " " (height) } role="img" aria-label=(label) {
            title { (label) }
            @for end in &ends { path.end d={ "M0 " (y(*end)) "H" (width) } {} }
            @for (index, point) in points.iter().enumerate() {
                @match point.value {
                    Some(value) => circle class=(point.verdict) cx=(x(index)) cy=(y(value)) r="3" {},
                    None => path class=(point.verdict) d={ "M" (x(index)) " " (AIR) "v" (height - 2.0 * AIR) } {},
                }
            }
        }
    }
}
