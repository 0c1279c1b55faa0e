//! Writes the beginning of the page: result, what did not pass and why, all scenarios, requirements.

use super::elements::{MAX_NAMED, file_link, scenario_anchor, scroll_table, sorted_by_verdict, verdict_badge};
use super::trace_data::TRACE_CHANGED;
use crate::text::history::RunHistory;
use crate::text::traceability;
use crate::{format, record_queries};
use maud::{Markup, html};
use platebench_record::{RunRecord, ScenarioRecord, Statistic, Verdict};
use std::collections::BTreeSet;

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

pub(super) fn not_passed_section(record: &RunRecord, history: &RunHistory, changed: &BTreeSet<String>) -> Markup {
    let open = record_queries::expectations_not_passed(record);
    html! {
        @if !open.is_empty() || !changed.is_empty() {
            section aria-labelledby="open" {
                h2 id="open" { @if open.is_empty() { "Changed traces" } @else { "What did not pass" } }
                ol.open {
                    @for (index, scenario) in record.scenarios.iter().enumerate() { (changed_traces(index, scenario, changed)) }
                    @for (scenario, index) in open { (not_passed_item(record, scenario, index, history, changed)) }
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
                p.what { span class="badge inconclusive" { span aria-hidden="true" { "!" } " changed" } " " a href={ "#" (scenario_anchor(index)) } { (scenario.title) } }
                p.why {
                    (format::count(traces.len(), "trace")) " " (TRACE_CHANGED)
                    ": the verdicts are those of the run; the changed traces are not drawn."
                }
                p.where {
                    @for (place, trace) in named.iter().enumerate() { @if place > 0 { ", " } (file_link(trace)) } @if !further.is_empty() { " and " (further.len()) " more" }
                }
            }
        }
    }
}

fn not_passed_item(
    record: &RunRecord,
    scenario: &ScenarioRecord,
    index: usize,
    history: &RunHistory,
    changed: &BTreeSet<String>,
) -> Markup {
    let place = record.scenarios.iter().position(|other| std::ptr::eq(other, scenario)).unwrap_or(0);
    let Some(expectation) = scenario.expectations.get(index) else { return Markup::default() };
    let unit = format::unit(expectation.metric);
    let trial = record_queries::trial_to_inspect(scenario, index);
    // A statistic over trials is no value of a single trial.
    let decided = trial.filter(|_| expectation.statistic == Statistic::Worst && scenario.trials.len() > 1);
    let decided = decided.map(|trial| trial.index);
    html! {
        li class=(expectation.verdict) {
            p.what {
                (verdict_badge(expectation.verdict, &format::verdict(expectation)))
                " " a href={ "#" (scenario_anchor(place)) } { (scenario.title) }
            }
            p.why {
                code { (expectation.name) } " "
                @match (format::value(expectation), format::value_or_not_reached(expectation)) {
                    (Some(value), _) => { strong { (value) @if !unit.is_empty() { " " (unit) } } @if let Some(index) = decided { " in trial " (index) } ", expected " },
                    (None, Some(text)) => { strong { (text) } ", expected " },
                    (None, None) => "expected ",
                }
                span.number { (format::limit(expectation)) @if !unit.is_empty() { " " (unit) } }
                @if let Some(reason) = format::remaining_reason(expectation) { span.reason { (reason) } }
            }
            @if let Some(since) = history.not_passed_since(record, scenario, index) {
                p.since { (since) }
            }
            p.where {
                (scenario.file)
                @if let Some(trial) = trial {
                    " · " (file_link(&trial.trace))
                    @if changed.contains(&trial.trace) { ", " (TRACE_CHANGED) }
                }
            }
        }
    }
}

pub(super) fn scenarios(record: &RunRecord) -> Markup {
    let row = |index: usize, scenario: &ScenarioRecord| {
        let expectations = &scenario.expectations;
        let met = expectations.iter().filter(|found| found.verdict == Verdict::Pass).count();
        html! {
            tr {
                th scope="row" {
                    a href={ "#" (scenario_anchor(index)) } { (scenario.title) }
                    span.file { (scenario.file) }
                }
                td data-label="Verdict" { (verdict_badge(scenario.verdict, scenario.verdict.name())) }
                td data-label="Law" { (scenario.law) }
                td.number data-label="Trials" { (scenario.trials.len()) }
                td.number data-label="Expectations met" { (met) " of " (expectations.len()) }
            }
        }
    };
    let rows = html! { @for (index, scenario) in sorted_by_verdict(record) { (row(index, scenario)) } };
    let columns = ["Scenario", "Verdict", "Law", "#Trials", "#Expectations met"];
    html! {
        section aria-labelledby="scenarios" {
            h2 id="scenarios" { "Scenarios" }
            @if record.scenarios.is_empty() { p.notice { "The run has no scenarios." } }
            @else { (scroll_table("Scenarios", "contents stacked", &columns, &rows)) }
            @if !record.not_applicable.is_empty() { (not_applicable(record)) }
        }
    }
}

/// They change no verdict.
fn not_applicable(record: &RunRecord) -> Markup {
    html! {
        div.notice {
            p { (format::count(record.not_applicable.len(), "scenario")) " not applicable to this controller:" }
            ul {
                @for scenario in &record.not_applicable {
                    li { (scenario.title) " (" (scenario.file) "): " (scenario.reason) }
                }
            }
        }
    }
}

pub(super) fn requirements(record: &RunRecord) -> Markup {
    let links = traceability::requirement_links(record);
    let all: usize = record.scenarios.iter().map(|scenario| scenario.expectations.len()).sum();
    let rows = html! {
        @for link in &links {
            tr {
                th scope="row" { (link.requirement) }
                td data-label="Expectation" { span { code { (link.expectation) } " " (link.limit) } }
                td data-label="Scenario" { a href={ "#" (scenario_anchor(link.scenario_index)) } { (link.scenario) } }
                td data-label="Verdict" { (verdict_badge(link.verdict, link.verdict.name())) }
                td.file data-label="Trace" { (file_link(&link.trace)) }
            }
        }
    };
    let columns = ["Requirement", "Expectation", "Scenario", "Verdict", "Trace"];
    html! {
        @if !links.is_empty() {
            section aria-labelledby="requirements" {
                h2 id="requirements" { "Requirements" }
                p {
                    (links.len()) " of " (format::count(all, "expectation")) " belong to a requirement; see also "
                    code { (traceability::FILE) } "."
                }
                (scroll_table("Requirements", "contents stacked", &columns, &rows))
            }
        }
    }
}
