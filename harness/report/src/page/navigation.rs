//! Writes the list of scenarios next to the page: verdict, title, response, smallest margin.

use super::elements::{scenario_anchor, sorted_by_verdict};
use super::trace_data::TraceData;
use crate::{format, record_queries};
use maud::{Markup, html};
use platebench_model::record::{RunRecord, ScenarioRecord, Verdict};
use platebench_model::trace::Column;
use std::collections::BTreeSet;
use std::fmt::Write as _;

/// Width and height, CSS pixels.
const SPARKLINE: (f64, f64) = (88.0, 22.0);
const SPARKLINE_POINTS: usize = 44;
/// The bar is full at this margin (100 %) and above.
const FULL_MARGIN: f64 = 1.0;

/// `navigation.js` builds the filters from the attributes of the entries.
pub(super) fn list(record: &RunRecord, data: &[TraceData]) -> Markup {
    html! {
        nav.list aria-label="Scenarios" {
            h1.home {
                a href="#overview" {
                    span class={ "sign " (record.verdict) } { (format::sign(record.verdict)) }
                    " Run of " (record.started)
                }
            }
            div.filters {}
            ol {
                @for (index, scenario) in sorted_by_verdict(record) { (entry(index, scenario, data.get(index))) }
            }
        }
    }
}

fn entry(index: usize, scenario: &ScenarioRecord, data: Option<&TraceData>) -> Markup {
    let folder = scenario.file.rsplit_once('/').map_or(".", |(folder, _)| folder);
    let requirements = scenario.expectations.iter().filter_map(|expectation| expectation.requirement.as_deref());
    let requirements: BTreeSet<&str> = requirements.collect();
    let requirements: Vec<&str> = requirements.into_iter().collect();
    html! {
        li data-verdict=(scenario.verdict) data-folder=(folder)
            data-law=(scenario.law) data-tag=(scenario.tags.join("\n"))
            data-requirement=(requirements.join("\n")) {
            a href={ "#" (scenario_anchor(index)) } {
                span class={ "sign " (scenario.verdict) } { (format::sign(scenario.verdict)) }
                span.name { (scenario.title) span.file { (scenario.file) } }
                span.small { @if let Some(data) = data { (sparkline(data)) } (margin_bar(scenario)) }
            }
        }
    }
}

fn sparkline(data: &TraceData) -> Markup {
    let line = data.sampled_trials.first().and_then(|trial| trial.peak_lines.get(&Column::Amplitude));
    let (Some(line), Some(whole)) = (line, data.views.last().map(|view| view.window)) else { return Markup::default() };
    let known = data.grid.t_ms.iter().zip(line).filter_map(|(t_ms, value)| Some((*t_ms, (*value)?)));
    let known: Vec<(f64, f64)> = known.collect();
    let top = known.iter().map(|point| point.1).fold(f64::MIN_POSITIVE, f64::max);
    let (width, height) = SPARKLINE;
    let part = |t_ms: f64| ((t_ms - whole.from_ms) / whole.span_ms() * SPARKLINE_POINTS as f64).floor();
    let mut path = String::new();
    for points in known.chunk_by(|a, b| part(a.0) == part(b.0)) {
        let Some(point) = points.iter().max_by(|a, b| a.1.total_cmp(&b.1)) else { continue };
        let x = (point.0 - whole.from_ms) / whole.span_ms() * width;
        let y = height - 1.0 - point.1 / top * (height - 2.0);
        let _ = write!(path, "{}{x:.0} {y:.1}", if path.is_empty() { "M" } else { "L" });
    }
    html! { svg.spark viewBox={ "0 0 " (width) " " (height) } aria-hidden="true" { path d=(path) {} } }
}

pub(super) fn margin_bar(scenario: &ScenarioRecord) -> Markup {
    let closest = record_queries::closest_expectation(scenario).and_then(|index| scenario.expectations.get(index));
    let Some((closest, margin)) = closest.and_then(|found| Some((found, found.margin?))) else {
        return Markup::default();
    };
    let width = if margin < 0.0 { 100.0 } else { (margin / FULL_MARGIN).min(1.0) * 100.0 };
    let title = format!("smallest margin {}: {}", margin_text(margin), closest.name);
    let verdict = if margin < 0.0 { Verdict::Fail } else { scenario.verdict };
    html! {
        svg.margin viewBox="0 0 100 5" preserveAspectRatio="none" role="img" aria-label=(title) {
            rect.rail width="100" height="5" {}
            rect class=(verdict) width=(format::number(width)) height="5" {}
        }
    }
}

pub(super) fn margin_text(margin: f64) -> String {
    format!("{} %", format::number((margin * 1e4).round() / 1e2))
}
