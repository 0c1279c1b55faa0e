//! Writes the overview: result, what did not pass and why, smallest margins, requirements.

use super::elements::{MAX_NAMED, file_link, scenario_anchor, scroll_table, sorted_by_verdict, with_unit};
use super::navigation::margin_text;
use super::trace_data::{TRACE_CHANGED, TraceData};
use crate::document::verdict_badge;
use crate::text::history::RunHistory;
use crate::text::traceability::{self, RequirementLink};
use crate::{format, record_queries};
use maud::{Markup, html};
use platebench_model::record::{ExpectationRecord, RunRecord, ScenarioRecord, Statistic, Verdict};
use std::collections::BTreeSet;

const MAX_CLOSEST: usize = 5;

pub(super) fn head(record: &RunRecord) -> Markup {
    let scenarios = format::VerdictCounts::of_scenarios(record);
    let expectations = format::VerdictCounts::of_expectations(record);
    let tiles = [
        ("failed", Verdict::Fail, scenarios.failed, expectations.failed),
        ("inconclusive", Verdict::Inconclusive, scenarios.inconclusive, expectations.inconclusive),
        ("passed", Verdict::Pass, scenarios.passed, expectations.passed),
    ];
    html! {
        p.eyebrow { (record.tool.name) " · run of " (record.started) }
        h1 { "Run " (verdict_badge(record.verdict, record.verdict.name())) }
        p.lead {
            (format::count(scenarios.total(), "scenario")) ", " (format::count(expectations.total(), "expectation"))
            " on " code { (record.rig.name) } ", " (record.clock) " clock."
        }
        @if !record.complete {
            p.notice { "The run was not finished. The page shows the part that was played." }
        }
        ul.tiles {
            @for (word, verdict, of_scenarios, of_expectations) in tiles {
                li class={ "tile " (verdict) @if of_scenarios + of_expectations == 0 { " none" } } {
                    span.number { (of_scenarios) }
                    span.word { @if of_scenarios == 1 { "scenario " } @else { "scenarios " } (word) }
                    span.detail { (format::count(of_expectations, "expectation")) }
                }
            }
        }
    }
}

pub(super) fn not_passed_section(
    record: &RunRecord,
    data: &[TraceData],
    history: &RunHistory,
    changed: &BTreeSet<String>,
) -> Markup {
    let open: Vec<_> = sorted_by_verdict(record)
        .into_iter()
        .filter(|(_, scenario)| scenario.expectations.iter().any(|found| found.verdict != Verdict::Pass))
        .collect();
    html! {
        @if !open.is_empty() || !changed.is_empty() {
            section aria-labelledby="open" {
                h2 id="open" { @if open.is_empty() { "Changed traces" } @else { "What did not pass" } }
                ol.open {
                    @for (index, scenario) in record.scenarios.iter().enumerate() {
                        (changed_traces(index, scenario, changed))
                    }
                    @for (index, _) in open { (not_passed_card(record, index, data.get(index), history, changed)) }
                }
            }
        }
    }
}

fn changed_traces(index: usize, scenario: &ScenarioRecord, changed: &BTreeSet<String>) -> Markup {
    let traces: Vec<&str> =
        scenario.trials.iter().map(|trial| trial.trace.as_str()).filter(|trace| changed.contains(*trace)).collect();
    let (named, further) = traces.split_at(traces.len().min(MAX_NAMED));
    html! {
        @if !traces.is_empty() {
            li.inconclusive {
                p.what {
                    span class="badge inconclusive" { span aria-hidden="true" { "!" } " changed" } " "
                    a href={ "#" (scenario_anchor(index)) } { (scenario.title) }
                }
                p.why {
                    (format::count(traces.len(), "trace")) " " (TRACE_CHANGED)
                    ": the verdicts are those of the run; the changed traces are not drawn."
                }
                p.where {
                    @for (place, trace) in named.iter().enumerate() { @if place > 0 { ", " } (file_link(trace)) }
                    @if !further.is_empty() { " and " (further.len()) " more" }
                }
            }
        }
    }
}

fn not_passed_card(
    record: &RunRecord,
    place: usize,
    data: Option<&TraceData>,
    history: &RunHistory,
    changed: &BTreeSet<String>,
) -> Markup {
    let Some(scenario) = record.scenarios.get(place) else { return Markup::default() };
    html! {
        li class=(scenario.verdict) {
            p.what {
                (verdict_badge(scenario.verdict, scenario.verdict.name()))
                " " a href={ "#" (scenario_anchor(place)) } { (scenario.title) }
                " " span.file { (scenario.file) }
            }
            @for index in record_queries::indices_not_passed(scenario) {
                (not_passed_item(record, scenario, index, data, history, changed))
            }
        }
    }
}

fn not_passed_item(
    record: &RunRecord,
    scenario: &ScenarioRecord,
    index: usize,
    data: Option<&TraceData>,
    history: &RunHistory,
    changed: &BTreeSet<String>,
) -> Markup {
    let Some(expectation) = scenario.expectations.get(index) else { return Markup::default() };
    let unit = format::unit(expectation.metric);
    let trial = record_queries::trial_to_inspect(scenario, index);
    // A statistic over trials is not the value of one trial.
    let decided = trial.filter(|_| expectation.statistic == Statistic::Worst && scenario.trials.len() > 1);
    let decided = decided.map(|trial| trial.index);
    let limit = data.and_then(|data| data.limits.iter().find(|limit| limit.name == expectation.name));
    let worst = limit.and_then(|limit| Some((limit.kind, limit.worst.first()?)));
    html! {
        div.missed {
            p.why {
                (verdict_badge(expectation.verdict, &format::verdict(expectation))) " "
                code { (expectation.name) } " "
                @match (format::value(expectation), format::value_or_not_reached(expectation)) {
                    (Some(value), _) => {
                        strong { (value) @if !unit.is_empty() { " " (unit) } }
                        @if let Some(index) = decided { " in trial " (index) }
                        ", expected "
                    },
                    (None, Some(text)) => { strong { (text) } ", expected " },
                    (None, None) => "expected ",
                }
                span.number { (format::limit(expectation)) @if !unit.is_empty() { " " (unit) } }
                @if let Some(window) = format::in_window(expectation) { ", " (window) }
                @if let Some((kind, worst)) = worst { "; " (kind) ": " strong { (worst.text) } }
                @if let Some(requirement) = &expectation.requirement { " · " (requirement) }
                @if let Some(reason) = format::remaining_reason(expectation) { span.reason { (reason) } }
            }
            @if let Some(text) = requirement_text(scenario, expectation) { p.requirement { (text) } }
            p.where {
                @if let Some(since) = history.not_passed_since(record, scenario, index) { span.since { (since) } " " }
                @if let Some(trial) = trial {
                    (file_link(&trial.trace))
                    @if changed.contains(&trial.trace) { ", " (TRACE_CHANGED) }
                }
            }
        }
    }
}

fn requirement_text<'a>(scenario: &'a ScenarioRecord, expectation: &ExpectationRecord) -> Option<&'a str> {
    scenario.requirement_texts.get(expectation.requirement.as_ref()?).map(String::as_str)
}

pub(super) fn closest(record: &RunRecord) -> Markup {
    let found = record_queries::smallest_margins(record);
    let rows = html! {
        @for (index, scenario, expectation, margin) in found.iter().take(MAX_CLOSEST) {
            tr {
                th scope="row" {
                    a href={ "#" (scenario_anchor(*index)) } { (scenario.title) }
                    span.file { (scenario.file) }
                }
                td data-label="Expectation" { code { (expectation.name) } }
                td.number data-label="Measured" {
                    (with_unit(format::value(expectation), format::unit(expectation.metric)))
                }
                td.number data-label="Limit" {
                    (with_unit(Some(format::limit(expectation)), format::unit(expectation.metric)))
                }
                td.number data-label="Margin" { (margin_text(*margin)) }
            }
        }
    };
    let columns = ["Scenario", "Expectation", "#Measured", "#Limit", "#Margin"];
    html! {
        @if !found.is_empty() && record.scenarios.len() > 1 {
            section aria-labelledby="closest" {
                h2 id="closest" { "Passed with the smallest margin" }
                (scroll_table("Smallest margins", "contents stacked", &columns, &rows))
            }
        }
    }
}

pub(super) fn not_applicable(record: &RunRecord) -> Markup {
    html! {
        @if record.scenarios.is_empty() { p.notice { "The run has no scenarios." } }
        @if !record.not_applicable.is_empty() { div.notice {
            p { (format::count(record.not_applicable.len(), "scenario")) " not applicable to this controller:" }
            ul {
                @for scenario in &record.not_applicable {
                    li { (scenario.title) " (" (scenario.file) "): " (scenario.reason) }
                }
            }
        } }
    }
}

pub(super) fn requirements(record: &RunRecord) -> Markup {
    let links = traceability::requirement_links(record);
    let all: usize = record.scenarios.iter().map(|scenario| scenario.expectations.len()).sum();
    let rows = html! {
        @for links in links.chunk_by(|a, b| a.requirement == b.requirement) { (requirement_row(record, links)) }
    };
    let columns = ["Requirement", "Verdict", "#Expectations passed", "Not passed, or else the first"];
    html! {
        @if !links.is_empty() {
            section aria-labelledby="requirements" {
                h2 id="requirements" { "Requirements" }
                p {
                    (links.len()) " of " (format::count(all, "expectation")) " belong to a requirement; "
                    code { (traceability::FILE) } " lists them with their traces."
                }
                (scroll_table("Requirements", "contents stacked", &columns, &rows))
            }
        }
    }
}

fn requirement_row(record: &RunRecord, links: &[RequirementLink]) -> Markup {
    let text = links
        .iter()
        .find_map(|link| record.scenarios.get(link.scenario_index)?.requirement_texts.get(&link.requirement));
    let verdict = Verdict::combine(links.iter().map(|link| link.verdict));
    let open: Vec<&RequirementLink> = links.iter().filter(|link| link.verdict != Verdict::Pass).collect();
    let named: Vec<&RequirementLink> = if open.is_empty() { links.iter().take(1).collect() } else { open.clone() };
    html! {
        tr {
            th scope="row" {
                (links.first().map_or("", |link| link.requirement.as_str()))
                @if let Some(text) = text { span.text { (text) } }
            }
            td data-label="Verdict" { (verdict_badge(verdict, verdict.name())) }
            td.number data-label="Expectations passed" { (links.len() - open.len()) " of " (links.len()) }
            td data-label="Expectations" { div {
                @for link in named.iter().take(MAX_NAMED) {
                    div {
                        a href={ "#" (scenario_anchor(link.scenario_index)) } { (link.scenario) } ": "
                        code { (link.expectation) } " " (link.limit)
                    }
                }
                @if named.len() > MAX_NAMED { "and " (named.len() - MAX_NAMED) " more" }
            } }
        }
    }
}
