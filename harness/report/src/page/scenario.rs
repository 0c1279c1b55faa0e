//! Writes the section of a scenario: expectations, figures, trials.

use super::elements::{MAX_NAMED, link_to, scenario_anchor, trace_link};
use super::figure::{Figure, drawings};
use super::overview::margin_text;
use super::script;
use super::trace_data::TraceData;
use crate::format;
use crate::record_queries;
use crate::text::history::TrendPoint;
use crate::text::timing;
use maud::{Markup, html};
use platebench_document::chart::marks::{Axes, Axis, AxisValue, Drawing, Mark, Point, Role, Shape, extent, view_box};
use platebench_document::{Cell, Column, NOTHING, Table, verdict_badge};
use platebench_model::record::{ExpectationRecord, Metric, ScenarioRecord, Statistic, TrialRecord, Verdict};

/// A longer table would slow the page down.
const MAX_LISTED_TRIALS: usize = 200;

const REMARKABLE_OVERSHOOT_PERCENT: f64 = 20.0;

pub(super) struct ScenarioParts<'a> {
    pub(super) data: &'a TraceData,
    pub(super) figures: Vec<Figure>,
    pub(super) baseline_error: Option<String>,
    pub(super) line_points: usize,
    pub(super) has_drawings: bool,
    pub(super) trends: Vec<Vec<TrendPoint>>,
}

pub(super) fn scenario_article(index: usize, scenario: &ScenarioRecord, parts: &ScenarioParts<'_>) -> Markup {
    let id = scenario_anchor(index);
    let (t_ms, views) = (&parts.data.grid.t_ms, &parts.data.views);
    let drawings = if parts.has_drawings {
        drawings(t_ms, views, &parts.figures, parts.line_points)
    } else {
        html! { p.facts.drawings { "The page has no drawing of this scenario; its plots need scripts." } }
    };
    html! {
        section class={ "scenario " (scenario.verdict) } id=(id) aria-labelledby={ (id) "-title" } {
            p.eyebrow { (scenario.file) }
            h2 id={ (id) "-title" } { (scenario.title) " " (verdict_badge(scenario.verdict, scenario.verdict.name())) }
            p.facts {
                @if let Some(source) = &scenario.source { span { "Source: " (source) } }
                span { "Law: " (scenario.law) }
                span {
                    "Plate model: " (scenario.model)
                    @if let Some(description) = scenario.model_description() { " (" (description) ")" }
                }
                span {
                    (format::count(scenario.trials.len(), "trial"))
                    @if let [only] = scenario.trials.as_slice() { " " (trace_link(only)) }
                }
            }
            @if let Some(sentence) = timing::summary(scenario) { p { (sentence) } }
            (expectations_table(scenario, &parts.trends))
            (requirement_texts(scenario))
            (overshoot_remark(scenario, parts.data))
            @if let Some(remark) = symptom_remark(scenario) { p.notice { "Warning: " (remark) } }
            (golden_difference(parts.data))
            (unreadable_traces(parts.data))
            @if let Some(reason) = &parts.baseline_error { p.notice { "The baseline cannot be shown: " (reason) } }
            (drawings)
            @if !parts.figures.is_empty() { (script::figure_data(&scenario.title, t_ms, views, &parts.figures)) }
            (trials_table(scenario))
            (firmware_output(scenario))
        }
    }
}

fn has_paper(scenario: &ScenarioRecord) -> bool {
    scenario.expectations.iter().any(|expectation| expectation.paper.is_some())
}

fn has_interval(scenario: &ScenarioRecord) -> bool {
    scenario.expectations.iter().any(|expectation| interval(expectation).is_some())
}

/// `None` if all trials have the same value, because the interval then adds nothing.
fn interval(expectation: &ExpectationRecord) -> Option<String> {
    let is_one =
        expectation.statistic == Statistic::Worst && expectation.interval.is_some_and(|[low, high]| low == high);
    format::interval(expectation).filter(|_| !is_one)
}

fn expectations_table(scenario: &ScenarioRecord, trends: &[Vec<TrendPoint>]) -> Markup {
    let (has_paper, has_interval) = (has_paper(scenario), has_interval(scenario));
    let has_trend = trends.iter().any(|points| points.len() > 1);
    let number = |name: &str| Column::number(name, "");
    let columns = [
        Some("Metric".into()),
        Some("Verdict".into()),
        Some(number("Measured")),
        has_paper.then(|| number("Paper")),
        Some(number("Expected")),
        has_interval.then(|| number("Interval")),
        Some(number("Window")),
        has_trend.then(|| "Trend".into()),
    ];
    let mut table: Table = Table::new::<Column>(columns.into_iter().flatten());
    for (index, expectation) in scenario.expectations.iter().enumerate() {
        let unit = format::unit(expectation.metric);
        let value = Cell::optional(format::value_or_not_reached(expectation));
        let value = value.with_unit(format::unit_of_value(expectation)).html();
        let error = expectation.bench_error.map(|error| format!("bench ± {error:.0e}"));
        let limit = Cell::from(format::limit(expectation)).with_unit(unit).html();
        let margin = expectation.margin.filter(|_| expectation.verdict == Verdict::Pass);
        let cells = [
            Some(Cell::code(&*expectation.name).with_notes(expectation.requirement.clone())),
            Some(Cell::from(format::verdict(expectation)).with_verdict(expectation.verdict)),
            Some(Cell::default().with_markup(html! {
                strong { (value) }
                @if scenario.trials.len() > 1 { span.statistic { (format::statistic(expectation)) } }
                @if let Some(error) = &error { span.statistic { (error) } }
            })),
            has_paper.then(|| Cell::optional(expectation.paper.map(format::number)).with_unit(unit)),
            Some(Cell::default().with_markup(html! {
                span {
                    (limit)
                    @if let Some(margin) = margin { span.statistic { "margin " (margin_text(margin)) } }
                }
            })),
            has_interval.then(|| Cell::optional(interval(expectation))),
            Some(Cell::optional(format::windows(expectation))),
            has_trend.then(|| {
                let points = trends.get(index).map_or(&[][..], Vec::as_slice);
                Cell::default().with_markup(trend(expectation, points))
            }),
        ];
        table.push(cells.into_iter().flatten());
        let differences = record_queries::protocol_differences(scenario, index).iter().cloned();
        let reasons = format::remaining_reason(expectation).into_iter().chain(differences);
        table.remarks.extend(reasons.map(|text| (index, "reason", text)));
        table.remarks.extend(format::evidence(expectation).map(|text| (index, "evidence", text)));
    }
    html! {
        h3 { "Expectations" }
        @if scenario.expectations.is_empty() { p.notice { "No expectation was judged." } }
        @else { (table.html_as("Expectations", "expectations stacked")) }
        @if !scenario.not_applicable.is_empty() { div.notice {
            p { "Not applicable:" }
            ul { @for skipped in &scenario.not_applicable { li { code { (skipped.name) } ": " (skipped.reason) } } }
        } }
    }
}

fn requirement_texts(scenario: &ScenarioRecord) -> Markup {
    html! {
        @if !scenario.requirement_texts.is_empty() {
            dl { @for (id, text) in &scenario.requirement_texts { div { dt { (id) } dd { (text) } } } }
        }
    }
}

/// Remarks a large overshoot, because the response can meet its settling time in spite of it.
fn overshoot_remark(scenario: &ScenarioRecord, data: &TraceData) -> Markup {
    let has_settled = scenario
        .expectations
        .iter()
        .any(|found| found.metric == Metric::SettlingTime && found.verdict == Verdict::Pass);
    let overshoot = data.overshoot_percent.filter(|percent| has_settled && *percent > REMARKABLE_OVERSHOOT_PERCENT);
    html! {
        @if let Some(percent) = overshoot {
            p.notice {
                "The settling time passes, but the first step of trial " (data.first_trial) " overshoots by "
                (format::percent(percent)) " %."
            }
        }
    }
}

pub(super) fn symptom_remark(scenario: &ScenarioRecord) -> Option<String> {
    let (trial, symptom) = record_queries::symptom_of(scenario)?;
    Some(format::symptom(scenario, trial, symptom))
}

fn golden_difference(data: &TraceData) -> Markup {
    html! {
        @if !data.golden.exceedances.is_empty() {
            div.notice {
                p { "This run differs from the golden trace:" }
                ul {
                    @for worst in &data.golden.exceedances { li { (format::exceedance(data.first_trial, worst)) } }
                    @for change in &data.golden.values { li { (change) } }
                }
            }
        }
    }
}

fn unreadable_traces(data: &TraceData) -> Markup {
    let (named, further) = data.unreadable.split_at(data.unreadable.len().min(MAX_NAMED));
    html! {
        @if !named.is_empty() {
            div.notice {
                p { (format::count(data.unreadable.len(), "trace")) " cannot be shown:" }
                ul {
                    @for reason in named { li { (reason) } }
                    @if !further.is_empty() { li { "and " (further.len()) " more" } }
                }
            }
        }
    }
}

fn trials_table(scenario: &ScenarioRecord) -> Markup {
    let metrics: Vec<String> = (0..scenario.expectations.len())
        .map(|index| scenario.metric_key(index))
        .filter(|key| scenario.trials.iter().any(|trial| trial.metrics.get(key).is_some()))
        .collect();
    let columns = ["Trial", "Seed"].into_iter().chain(metrics.iter().map(String::as_str));
    let columns = columns.map(|name| Column::number(name, ""));
    let mut table = Table::new(columns.chain(["Trace", "Remark"].map(Column::from)));
    let (count, shown) = (scenario.trials.len(), scenario.trials.len().min(MAX_LISTED_TRIALS));
    table.extend(scenario.trials.iter().take(shown).map(|trial| {
        let values =
            metrics.iter().map(|metric| trial.metrics.number(metric).map_or(NOTHING.to_owned(), format::number));
        let trace = if trial.sha256.is_some() {
            Cell::from(&*trial.trace).with_link(link_to(&trial.trace))
        } else {
            Cell::default()
        };
        let remark = [trial.cause.map(|cause| cause.to_string()), trial.reason.as_ref().map(ToString::to_string)];
        let remark = remark.into_iter().flatten().collect::<Vec<_>>().join(": ");
        let numbers = [trial.index.to_string(), trial.seed.to_string()].into_iter().chain(values).map(Cell::from);
        numbers.chain([trace, remark.into()]).collect::<Vec<_>>()
    }));
    html! {
        // The numbers of a single trial are in the table of expectations.
        @if count > 1 || scenario.trials.iter().any(|trial| trial.reason.is_some()) {
            details {
                summary { (format::count(count, "trial")) " in numbers" }
                @if shown < count { p { "The first " (shown) " trials; " code { "run.json" } " has all." } }
                (table.html_as("Trials", "trials"))
            }
        }
    }
}

/// Shows the output of the first trial with a remark, or else of the first trial with output.
fn firmware_output(scenario: &ScenarioRecord) -> Markup {
    let has_output = |trial: &&TrialRecord| trial.telemetry.firmware_output.is_some();
    let with_remark = scenario.trials.iter().filter(|trial| trial.reason.is_some()).find(has_output);
    let trial = with_remark.or_else(|| scenario.trials.iter().find(has_output));
    let output = trial.and_then(|trial| Some((trial.index, trial.telemetry.firmware_output.as_ref()?)));
    html! {
        @if let Some(command) = record_queries::defmt_command("ELF", std::slice::from_ref(scenario)) {
            p { "Messages of the firmware by defmt: " code { (command) } }
        }
        @if let Some((index, text)) = output {
            details {
                summary { "Output of the firmware, trial " (index) }
                div.scroll role="group" aria-label="Output of the firmware" tabindex="0" { pre { (text) } }
            }
        }
    }
}

/// Width and height, CSS pixels.
const TREND_SIZE: Point = (132.0, 34.0);
const TREND_AIR: f64 = 5.0;

/// `points` begin with the oldest run and end with this one. Draws nothing without an earlier run.
fn trend(expectation: &ExpectationRecord, points: &[TrendPoint]) -> Markup {
    let ends = format::limit_ends(expectation.limit);
    if points.len() < 2 {
        return Markup::default();
    }
    let values = points.iter().filter_map(|point| point.value).chain(ends.iter().copied());
    let (low, high) = extent(values).unwrap_or_default();
    let (width, height) = TREND_SIZE;
    // Equal values lie in the middle.
    let spread = if high > low { 0.0 } else { 1.0 };
    let axes = Axes {
        x: Axis::linear(0.0..(points.len() - 1) as f64, TREND_AIR..width - TREND_AIR),
        y: Axis::linear(low - spread..high + spread, height - TREND_AIR..TREND_AIR),
    };
    let line = |role: Role, at: AxisValue| Mark::Limit { role, at, text: None };
    let mark = |(index, point): (usize, &TrendPoint)| match point.value {
        Some(value) => {
            let at = (index as f64, value);
            Mark::Point { role: point.verdict.into(), at, shape: Shape::Disc, radius: 3.0, text: None }
        }
        None => line(point.verdict.into(), AxisValue::X(index as f64)),
    };
    let limits = ends.iter().map(|end| line(Role::Mark, AxisValue::Y(*end)));
    let marks: Vec<Mark> = limits.chain(points.iter().enumerate().map(mark)).collect();
    let mut drawing = Drawing::default();
    drawing.marks(&axes, &marks);
    let unit = format::unit(expectation.metric);
    let text = |point: &TrendPoint| {
        let value =
            point.value.map_or_else(|| "no value".to_owned(), |value| format!("{} {unit}", format::number(value)));
        let margin = point.margin.map_or_else(String::new, |margin| format!(", margin {}", margin_text(margin)));
        format!("{}: {value}{margin}", point.run)
    };
    let label = points.iter().map(text).collect::<Vec<_>>().join("; ");
    html! {
        svg.trend viewBox=(view_box(TREND_SIZE)) role="img" aria-label=(label) {
            title { (label) }
            (drawing.into_markup())
        }
    }
}
