//! The page's beginning: how the run ended, what did not pass and why, and what was played.
//!
//! Neighbours: `html` puts it on top; everything here links to the scenarios below.

use super::bundle::CHANGED;
use super::scenario::NAMED;
use super::{anchor, badge, file, in_order};
use crate::history::History;
use crate::{evidence, shown, traceability};
use maud::{Markup, html};
use platebench_verdict::{RunRecord, ScenarioRecord, Verdict};
use std::collections::BTreeSet;

/// Title, verdict, counts.
pub(super) fn head(record: &RunRecord) -> Markup {
    let scenarios = shown::Counts::of_scenarios(record);
    let expectations = shown::Counts::of_expectations(record);
    let tiles = [
        ("failed", Verdict::Fail, scenarios.failed, expectations.failed),
        ("inconclusive", Verdict::Inconclusive, scenarios.inconclusive, expectations.inconclusive),
        ("passed", Verdict::Pass, scenarios.passed, expectations.passed),
    ];
    html! {
        p.eyebrow { (record.tool.name) " · run of " (record.started) }
        h1 { "Run " (badge(record.verdict, record.verdict.name())) }
        p.lead {
            (shown::count(scenarios.total(), "scenario")) ", " (shown::count(expectations.total(), "expectation"))
            " on " code { (record.rig.name) } ", " (record.clock) " clock."
        }
        @if !record.complete {
            p.notice { "The run was not finished. What follows was played until then." }
        }
        ul.tiles {
            @for (word, verdict, of_scenarios, of_expectations) in tiles {
                li class={ "tile " (verdict) @if of_scenarios + of_expectations == 0 { " none" } } {
                    span.number { (of_scenarios) }
                    span.word { @if of_scenarios == 1 { "scenario " } @else { "scenarios " } (word) }
                    span.detail { (shown::count(of_expectations, "expectation")) }
                }
            }
        }
    }
}

/// Everything that did not pass, with its reason, since when, and its trace; and the traces that were changed after the run.
pub(super) fn open_points(record: &RunRecord, history: &History, changed: &BTreeSet<String>) -> Markup {
    let open = evidence::open_points(record);
    html! {
        @if !open.is_empty() || !changed.is_empty() {
            section aria-labelledby="open" {
                h2 id="open" { @if open.is_empty() { "What was changed" } @else { "What did not pass" } }
                ol.open {
                    @for (index, scenario) in record.scenarios.iter().enumerate() { (changed_traces(index, scenario, changed)) }
                    @for (scenario, index) in open { (open_point(record, scenario, index, history, changed)) }
                }
            }
        }
    }
}

/// Which traces of a scenario are no longer the run's.
fn changed_traces(index: usize, scenario: &ScenarioRecord, changed: &BTreeSet<String>) -> Markup {
    let traces: Vec<&str> =
        scenario.trials.iter().map(|trial| trial.trace.as_str()).filter(|trace| changed.contains(*trace)).collect();
    let (named, further) = traces.split_at(traces.len().min(NAMED));
    html! {
        @if !traces.is_empty() {
            li.inconclusive {
                p.what { span class="badge inconclusive" { span aria-hidden="true" { "!" } " changed" } " " a href={ "#" (anchor(index)) } { (scenario.title) } }
                p.why {
                    (shown::count(traces.len(), "trace")) @if traces.len() == 1 { " is " } @else { " are " } (CHANGED)
                    ": the verdicts are those of the run, its plots would be those of another file and are not drawn."
                }
                p.where {
                    @for (place, trace) in named.iter().enumerate() { @if place > 0 { ", " } (file(trace)) } @if !further.is_empty() { " and " (further.len()) " more" }
                }
            }
        }
    }
}

fn open_point(
    record: &RunRecord,
    scenario: &ScenarioRecord,
    index: usize,
    history: &History,
    changed: &BTreeSet<String>,
) -> Markup {
    let place = record.scenarios.iter().position(|other| std::ptr::eq(other, scenario)).unwrap_or(0);
    let Some(expectation) = scenario.expectations.get(index) else { return Markup::default() };
    let unit = shown::unit(&expectation.metric);
    let trial = evidence::trial(scenario, index);
    // Of one trial there is nothing to choose from, and over trials none decided alone.
    let decided = trial.filter(|_| expectation.statistic == "worst" && scenario.trials.len() > 1);
    let decided = decided.map(|trial| trial.index);
    html! {
        li class=(expectation.verdict) {
            p.what {
                (badge(expectation.verdict, &shown::verdict(expectation)))
                " " a href={ "#" (anchor(place)) } { (scenario.title) }
            }
            p.why {
                code { (expectation.metric) } " "
                @match (shown::value(expectation), shown::found(expectation)) {
                    (Some(value), _) => { strong { (value) @if !unit.is_empty() { " " (unit) } } @if let Some(index) = decided { " in trial " (index) } ", demanded " },
                    (None, Some(never)) => { strong { (never) } ", demanded " },
                    (None, None) => "demanded ",
                }
                span.number { (shown::limit(expectation)) @if !unit.is_empty() { " " (unit) } }
                @if let Some(reason) = shown::why(expectation) { span.reason { (reason) } }
            }
            @if let Some(since) = history.since(record, scenario, index) {
                p.since { (since) }
            }
            p.where {
                (scenario.file)
                @if let Some(trial) = trial {
                    " · " (file(&trial.trace))
                    @if changed.contains(&trial.trace) { ", " (CHANGED) }
                }
            }
        }
    }
}

/// All scenarios in a table.
pub(super) fn scenarios(record: &RunRecord) -> Markup {
    html! {
        section aria-labelledby="scenarios" {
            h2 id="scenarios" { "Scenarios" }
            @if record.scenarios.is_empty() { p.notice { "There was nothing to run." } }
            @else {
                div.scroll role="group" aria-labelledby="scenarios" tabindex="0" {
                    table.contents.stacked {
                        thead { tr {
                            th scope="col" { "Scenario" }
                            th scope="col" { "Verdict" }
                            th scope="col" { "Law" }
                            th.number scope="col" { "Trials" }
                            th.number scope="col" { "Expectations met" }
                        } }
                        tbody {
                            @for (index, scenario) in in_order(record) {
                                @let expectations = &scenario.expectations;
                                @let met = expectations.iter().filter(|found| found.verdict == Verdict::Pass).count();
                                tr {
                                    th scope="row" {
                                        a href={ "#" (anchor(index)) } { (scenario.title) }
                                        span.file { (scenario.file) }
                                    }
                                    td data-label="Verdict" { (badge(scenario.verdict, scenario.verdict.name())) }
                                    td data-label="Law" { (scenario.law) }
                                    td.number data-label="Trials" { (scenario.trials.len()) }
                                    td.number data-label="Expectations met" { (met) " of " (expectations.len()) }
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

/// From each requirement to what holds it.
pub(super) fn requirements(record: &RunRecord) -> Markup {
    let links = traceability::links(record);
    let all: usize = record.scenarios.iter().map(|scenario| scenario.expectations.len()).sum();
    html! {
        @if !links.is_empty() {
            section aria-labelledby="requirements" {
                h2 id="requirements" { "Requirements" }
                p { (links.len()) " of " (shown::count(all, "expectation")) " hold a requirement; the same is in " code { (traceability::FILE) } "." }
                div.scroll role="group" aria-labelledby="requirements" tabindex="0" {
                    table.contents.stacked {
                        thead { tr {
                            th scope="col" { "Requirement" }
                            th scope="col" { "Expectation" }
                            th scope="col" { "Scenario" }
                            th scope="col" { "Verdict" }
                            th scope="col" { "Trace" }
                        } }
                        tbody { @for link in &links {
                            tr {
                                th scope="row" { (link.requirement) }
                                td data-label="Expectation" { span { code { (link.expectation) } " " (link.limit) } }
                                td data-label="Scenario" { a href={ "#" (anchor(link.number)) } { (link.scenario) } }
                                td data-label="Verdict" { (badge(link.verdict, link.verdict.name())) }
                                td.file data-label="Trace" { (file(&link.trace)) }
                            }
                        } }
                    }
                }
            }
        }
    }
}
