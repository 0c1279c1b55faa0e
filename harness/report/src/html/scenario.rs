//! A scenario on the page: what was expected, what came of it, and how it looked.
//!
//! Neighbours: `figure` makes the drawings. The words of verdicts and reasons are the record's.

use super::bundle::Bundle;
use super::figure::{Behind, Figure, Key, figures};
use super::plot::SIZE;
use super::{anchor, badge, file, script};
use crate::error::ReportError;
use crate::{evidence, shown, timing};
use maud::{Markup, PreEscaped, html};
use platebench_verdict::{ExpectationRecord, ScenarioRecord};
use serde_json::Value;

/// How many traces that cannot be shown are named one by one.
pub(super) const NAMED: usize = 5;

/// What a scenario is shown with.
pub(super) struct Parts<'a> {
    pub(super) bundle: &'a Bundle,
    pub(super) behind: Option<&'a Behind<'a>>,
    /// For the script.
    pub(super) curves: Option<Value>,
    /// Why its baseline cannot be shown.
    pub(super) damaged: Option<String>,
    /// Points of a line in a drawing.
    pub(super) points: usize,
    /// Whether it has all drawings.
    pub(super) all: bool,
}

/// The scenario with number `index` of the record.
pub(super) fn article(index: usize, scenario: &ScenarioRecord, parts: &Parts<'_>) -> Result<Markup, ReportError> {
    let mut groups = Vec::new();
    for (heading, figures) in figures(parts.bundle, parts.behind, parts.points, parts.all) {
        let drawn: Vec<Markup> = figures.iter().map(drawing).collect::<Result<_, _>>()?;
        groups.push((heading, drawn));
    }
    let id = anchor(index);
    Ok(html! {
        section class={ "scenario " (scenario.verdict) } id=(id) aria-labelledby={ (id) "-title" } {
            p.eyebrow { (scenario.file) }
            h2 id={ (id) "-title" } { (scenario.title) " " (badge(scenario.verdict, scenario.verdict.name())) }
            p.facts {
                @if let Some(source) = &scenario.source { span { "Source: " (source) } }
                span { "Law: " (scenario.law) }
                span { "Plate model: " (scenario.model) (chosen(scenario)) }
                span { (shown::count(scenario.trials.len(), "trial")) }
            }
            @if let Some(sentence) = timing::sentence(scenario) { p { (sentence) } }
            (expectations(&id, scenario))
            (missing(parts.bundle))
            @if let Some(reason) = &parts.damaged { p.notice { "The baseline cannot be shown: " (reason) } }
            div.drawings {
                @for (heading, drawn) in &groups {
                    h3 { (heading) }
                    div.figures { @for figure in drawn { (figure) } }
                }
                @if !parts.all && !groups.is_empty() { p.facts { "The other signals are among the plots, which need scripts, and in the traces." } }
            }
            @if let Some(curves) = &parts.curves { (script::data(curves)) }
            (trials(scenario))
        }
    })
}

/// Who chose the plate's model, where the bench did, and on what grounds.
fn chosen(scenario: &ScenarioRecord) -> String {
    let by_itself = scenario.model_choice.as_ref().filter(|choice| choice.asked == "auto");
    by_itself.map_or_else(String::new, |choice| match choice.bound {
        Some(bound) => format!(" (auto: |ΔW| ≤ {bound:.1e} of the setpoint, budget {:.1e})", choice.budget),
        None => " (auto)".to_owned(),
    })
}

fn with_unit(text: Option<String>, unit: &str) -> Markup {
    html! { @match text {
        Some(text) => span { (text) @if !unit.is_empty() { " " span.unit { (unit) } } },
        None => { span.nothing { "–" } },
    } }
}

/// True where the paper has a value for something.
fn has_paper(scenario: &ScenarioRecord) -> bool {
    scenario.expectations.iter().any(|expectation| expectation.paper.is_some())
}

/// True where an interval says more than the value beside it.
fn has_interval(scenario: &ScenarioRecord) -> bool {
    scenario.expectations.iter().any(|expectation| interval(expectation).is_some())
}

/// Nothing where the worst trial is the best one too.
fn interval(expectation: &ExpectationRecord) -> Option<String> {
    let is_one = expectation.statistic == "worst" && expectation.interval.is_some_and(|[low, high]| low == high);
    shown::interval(expectation).filter(|_| !is_one)
}

fn expectations(id: &str, scenario: &ScenarioRecord) -> Markup {
    let columns = 4 + usize::from(has_paper(scenario)) + usize::from(has_interval(scenario));
    let row = |index: usize, expectation: &ExpectationRecord| {
        let unit = shown::unit(&expectation.metric);
        let unit_of_value = if expectation.value.is_some() { unit } else { "" };
        html! {
            tr {
                th scope="row" {
                    code { (evidence::key(scenario, index)) }
                    @if let Some(requirement) = &expectation.requirement { span.file { (requirement) } }
                }
                td data-label="Verdict" { (badge(expectation.verdict, &shown::verdict(expectation))) }
                td.number data-label="Measured" {
                    strong { (with_unit(shown::found(expectation), unit_of_value)) }
                    @if scenario.trials.len() > 1 { span.statistic { (shown::statistic(expectation)) } }
                }
                @if has_paper(scenario) {
                    td.number data-label="Paper" { (with_unit(expectation.paper.map(shown::number), unit)) }
                }
                td.number data-label="Demanded" { (with_unit(Some(shown::limit(expectation)), unit)) }
                @if has_interval(scenario) {
                    td.number data-label="Interval" { (with_unit(interval(expectation), "")) }
                }
            }
            @if let Some(reason) = shown::why(expectation) {
                tr.reason { td colspan=(columns) { span { (reason) } } }
            }
            @if let Some(evidence) = shown::evidence(expectation) {
                tr.evidence { td colspan=(columns) { span { (evidence) } } }
            }
        }
    };
    html! {
        h3 id={ (id) "-expectations" } { "Expectations" }
        @if scenario.expectations.is_empty() { p.notice { "Nothing was judged." } }
        @else {
            div.scroll role="group" aria-labelledby={ (id) "-expectations" } tabindex="0" {
                table.expectations.stacked {
                    thead { tr {
                        th scope="col" { "Metric" }
                        th scope="col" { "Verdict" }
                        th.number scope="col" { "Measured" }
                        @if has_paper(scenario) { th.number scope="col" { "Paper" } }
                        th.number scope="col" { "Demanded" }
                        @if has_interval(scenario) { th.number scope="col" { "Interval" } }
                    } }
                    tbody { @for (index, expectation) in scenario.expectations.iter().enumerate() {
                        (row(index, expectation))
                    } }
                }
            }
        }
    }
}

fn missing(bundle: &Bundle) -> Markup {
    let (named, further) = bundle.missing.split_at(bundle.missing.len().min(NAMED));
    html! {
        @if !named.is_empty() {
            div.notice {
                p { (shown::count(bundle.missing.len(), "trace")) " cannot be shown." }
                ul {
                    @for reason in named { li { (reason) } }
                    @if !further.is_empty() { li { "and " (further.len()) " more" } }
                }
            }
        }
    }
}

fn drawing(figure: &Figure) -> Result<Markup, ReportError> {
    let chart = &figure.chart;
    let (from_ms, to_ms) = (shown::number(chart.window.from_ms), shown::number(chart.window.to_ms));
    let keys: Vec<&str> = figure.legend.iter().map(|key| key.text.as_str()).collect();
    let label =
        format!("{} in {} against time, {from_ms} to {to_ms} ms: {}", figure.title, chart.unit, keys.join("; "));
    let svg = chart.draw(figure.title)?;
    Ok(html! {
        figure {
            figcaption { (figure.title) }
            svg viewBox={ "0 0 " (SIZE.0) " " (SIZE.1) } role="img" aria-label=(label) { (PreEscaped(svg)) }
            ul.legend { @for key in &figure.legend { li { (swatch(key)) (key.text) } } }
        }
    })
}

fn swatch(key: &Key) -> Markup {
    html! {
        svg.swatch viewBox="0 0 24 10" aria-hidden="true" {
            @if key.is_area { rect width="24" height="10" rx="2" class={ "f-" (key.ink.name()) } {} }
            @else { path d="M0 5H24" class={ "s-" (key.ink.name()) } {} }
        }
    }
}

/// Every trial with its numbers, folded away.
fn trials(scenario: &ScenarioRecord) -> Markup {
    let columns: Vec<String> = (0..scenario.expectations.len())
        .map(|index| evidence::key(scenario, index))
        .filter(|key| scenario.trials.iter().any(|trial| trial.metrics.contains_key(key)))
        .collect();
    let number = |value: Option<&Value>| value.and_then(Value::as_f64).map(shown::number);
    html! {
        @if !scenario.trials.is_empty() {
            details {
                summary { (shown::count(scenario.trials.len(), "trial")) " in numbers" }
                div.scroll role="group" aria-label="Trials" tabindex="0" {
                    table.trials {
                        thead { tr {
                            th.number scope="col" { "Trial" }
                            th.number scope="col" { "Seed" }
                            @for column in &columns { th.number scope="col" { code { (column) } } }
                            th scope="col" { "Trace" }
                            th scope="col" { "Remark" }
                        } }
                        tbody { @for trial in &scenario.trials {
                            tr {
                                th.number scope="row" { (trial.index) }
                                td.number { (trial.seed) }
                                @for column in &columns {
                                    td.number { (with_unit(number(trial.metrics.get(column)), "")) }
                                }
                                td.file { (file(&trial.trace)) }
                                td {
                                    @if let Some(cause) = trial.cause { strong { (cause) } }
                                    @if let Some(reason) = &trial.reason { " " (reason) }
                                }
                            }
                        } }
                    }
                }
            }
        }
    }
}
