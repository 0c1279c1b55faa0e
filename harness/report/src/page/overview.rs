//! Writes the parts of the page about the whole run: result, what did not pass, requirements, cost,
//! boards, environment, and the list of scenarios next to the page.

use super::elements::{MAX_NAMED, file_link, scenario_anchor, sorted_by_verdict};
use super::scenario::symptom_remark;
use super::trace_data::{TRACE_CHANGED, TraceData};
use crate::record_queries::CauseGroup;
use crate::text::history::RunHistory;
use crate::text::timing;
use crate::text::traceability::{self, RequirementLink};
use crate::{format, record_queries};
use maud::{Markup, html};
use platebench_document::chart::marks::{Axes, Axis, Drawing, Mark, Point, Role, view_box};
use platebench_document::{Cell, Column, Table, verdict_badge};
use platebench_model::quoted;
use platebench_model::record::{
    CostTrend, EarlierCost, ExpectationRecord, RunRecord, ScenarioRecord, Statistic, Verdict,
};
use std::collections::BTreeSet;

const MAX_CLOSEST: usize = 5;

pub(super) fn head(record: &RunRecord) -> Markup {
    let (scenarios, expectations) = (record.scenario_counts(), record.expectation_counts());
    let tiles = [
        ("failed", Verdict::Fail, scenarios.failed, expectations.failed),
        ("inconclusive", Verdict::Inconclusive, scenarios.inconclusive, expectations.inconclusive),
        ("passed", Verdict::Pass, scenarios.passed, expectations.passed),
    ];
    html! {
        p.eyebrow { (record.tool.name) " · run of " (record.started) }
        h1 { "Run " (verdict_badge(record.verdict, record.verdict.name())) }
        p.lead {
            (format::count(scenarios.total(), "scenario")) ", " (format::count(expectations.total(), "expectation")) "."
        }
        p.lead { "Tested: " (format::tested(record)) "." }
        @if let Some(own) = record_queries::own_verdict_of_run(record) {
            p.notice { (verdict_badge(own.verdict, own.verdict.name())) " " (own.reason) }
        }
        @if let Some(instances) = record_queries::unmodelled_instances(record) {
            p.notice { "The emulated chip has no model of " (instances) ": the writes changed nothing." }
        }
        @if !record.complete { p.notice { "The page shows the part that was played." } }
        @if record.verdict == Verdict::Pass {
            @for (scenario, ..) in record_queries::symptoms(record).take(MAX_NAMED) {
                p.notice { (scenario.file) ": " @if let Some(remark) = symptom_remark(scenario) { (remark) } }
            }
        }
        ul.tiles.compact[record.verdict != Verdict::Pass] {
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

/// What did not pass, as cards.
pub(super) struct NotPassed<'a> {
    pub(super) record: &'a RunRecord,
    /// By index of the scenario, like `plots`.
    pub(super) data: &'a [TraceData],
    pub(super) plots: &'a [Markup],
    pub(super) history: &'a RunHistory,
    /// Traces that were changed after the run.
    pub(super) changed: &'a BTreeSet<String>,
}

impl NotPassed<'_> {
    pub(super) fn section(&self) -> Markup {
        let mut groups = record_queries::cause_groups(self.record);
        // The newest change is the likeliest cause, so what it broke comes first.
        let is_new =
            |(_, scenario, index): &(usize, &ScenarioRecord, usize)| self.history.is_new(self.record, scenario, *index);
        for group in &mut groups {
            group.members.sort_by_key(|member| !is_new(member));
        }
        groups.sort_by_key(|group| (group.verdict != Verdict::Fail, !group.members.first().is_some_and(is_new)));
        let (shared, alone): (Vec<_>, Vec<_>) = groups.into_iter().partition(|group| group.members.len() > 1);
        let (failed, inconclusive): (Vec<_>, Vec<_>) = shared.iter().partition(|group| group.verdict == Verdict::Fail);
        let indices = |place: usize| -> Vec<usize> {
            let members = alone.iter().flat_map(|group| &group.members);
            members.filter(|member| member.0 == place).map(|member| member.2).collect()
        };
        let open = sorted_by_verdict(self.record).into_iter();
        let open = open.map(|(place, scenario)| (place, scenario, indices(place)));
        let mut open: Vec<_> = open.filter(|(.., indices)| !indices.is_empty()).collect();
        let has_new = |place: usize| {
            alone.iter().flat_map(|group| &group.members).any(|member| member.0 == place && is_new(member))
        };
        open.sort_by_key(|(place, scenario, _)| (scenario.verdict != Verdict::Fail, !has_new(*place)));
        let missed = record_queries::required_not_applicable(self.record);
        let is_empty = shared.is_empty() && alone.is_empty() && missed.is_empty();
        html! {
            @if !is_empty || !self.changed.is_empty() {
                section aria-labelledby="open" {
                    h2 id="open" { @if is_empty { "Changed traces" } @else { "What did not pass" } }
                    ol.open {
                        @for (index, scenario) in self.record.scenarios.iter().enumerate() {
                            (self.changed_traces(index, scenario))
                        }
                        @for scenario in missed {
                            li class=(Verdict::Fail) {
                                p.what {
                                    (verdict_badge(Verdict::Fail, Verdict::Fail.name())) " " (scenario.title) " "
                                    span.file { (scenario.file) }
                                }
                                p.why { (format::not_applicable(scenario)) }
                            }
                        }
                        @for group in failed { (self.cause_card(group)) }
                        @for (place, scenario, indices) in open {
                            (self.card(scenario.verdict, "", (place, scenario), &indices, &Markup::default()))
                        }
                        @for group in inconclusive { (self.cause_card(group)) }
                    }
                }
            }
        }
    }

    /// Shows the first expectation of the group; the list of the others is folded.
    fn cause_card(&self, group: &CauseGroup<'_>) -> Markup {
        let Some(&(place, scenario, index)) = group.members.first() else { return Markup::default() };
        let others = html! {
            details {
                summary { "All " (format::count(group.members.len(), "expectation")) " with this cause" }
                ul {
                    @for (place, scenario, indices) in group.scenarios() {
                        li {
                            (scenario_link(place, scenario)) ": "
                            @for (number, index) in indices.iter().enumerate() {
                                @if number > 0 { ", " }
                                @if let Some(found) = scenario.expectations.get(*index) { code { (found.name) } }
                            }
                        }
                    }
                }
            }
        };
        let intro = format!("{}. First: ", format::group_size(group));
        self.card(group.verdict, &intro, (place, scenario), &[index], &others)
    }

    /// The plot follows the first expectation.
    fn card(
        &self,
        verdict: Verdict,
        intro: &str,
        (place, scenario): (usize, &ScenarioRecord),
        indices: &[usize],
        further: &Markup,
    ) -> Markup {
        html! {
            li class=(verdict) {
                p.what { (verdict_badge(verdict, verdict.name())) " " (intro) (scenario_link(place, scenario)) }
                @if let Some(remark) = symptom_remark(scenario) { p.notice { (remark) } }
                @for (number, index) in indices.iter().enumerate() {
                    (self.item(scenario, *index, self.data.get(place)))
                    @if number == 0 { @if let Some(plot) = self.plots.get(place) { (plot) } }
                }
                (further)
            }
        }
    }

    fn changed_traces(&self, index: usize, scenario: &ScenarioRecord) -> Markup {
        let traces = scenario.trials.iter().map(|trial| trial.trace.as_str());
        let traces: Vec<&str> = traces.filter(|trace| self.changed.contains(*trace)).collect();
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

    fn item(&self, scenario: &ScenarioRecord, index: usize, data: Option<&TraceData>) -> Markup {
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
                    @if let Some(since) = self.history.not_passed_since(self.record, scenario, index) {
                        span.since { (since) } " "
                    }
                    @if let Some(trial) = trial {
                        (file_link(&trial.trace))
                        @if self.changed.contains(&trial.trace) { ", " (TRACE_CHANGED) }
                    }
                }
            }
        }
    }
}

fn scenario_link(place: usize, scenario: &ScenarioRecord) -> Markup {
    html! { a href={ "#" (scenario_anchor(place)) } { (scenario.title) } " " span.file { (scenario.file) } }
}

fn requirement_text<'a>(scenario: &'a ScenarioRecord, expectation: &ExpectationRecord) -> Option<&'a str> {
    scenario.requirement_texts.get(expectation.requirement.as_ref()?).map(String::as_str)
}

pub(super) fn closest(record: &RunRecord) -> Markup {
    let found = record_queries::smallest_margins(record);
    let columns = ["Scenario", "Expectation"].map(Column::from).into_iter();
    let mut table = Table::new(columns.chain(["Measured", "Limit", "Margin"].map(|name| Column::number(name, ""))));
    table.extend(found.iter().take(MAX_CLOSEST).map(|(index, scenario, expectation, margin)| {
        let (value, unit) = (format::value(expectation).unwrap_or_default(), format::unit(expectation.metric));
        let link = Some(format!("#{}", scenario_anchor(*index)));
        [
            Cell::from(&*scenario.title).with_link(link).with_notes([scenario.file.clone()]),
            Cell::code(&*expectation.name),
            Cell::from(value).with_unit(unit),
            Cell::from(format::limit(expectation)).with_unit(unit),
            margin_text(*margin).into(),
        ]
    }));
    html! {
        @if !found.is_empty() && record.scenarios.len() > 1 {
            section aria-labelledby="closest" {
                h2 id="closest" { "Passed with the smallest margin" }
                (table.html_as("Smallest margins", "contents stacked"))
            }
        }
    }
}

pub(super) fn not_applicable(record: &RunRecord) -> Markup {
    let groups = record_queries::not_applicable_groups(record);
    html! {
        @let skipped = record_queries::skipped_scenarios(record);
        @if !skipped.is_empty() { div.notice {
            p { (format::count(skipped.len(), "scenario")) " not applicable to this controller:" }
            ul {
                @for scenario in skipped {
                    li { (scenario.title) " (" (scenario.file) "): " (scenario.reason) }
                }
            }
        } }
        @if !groups.is_empty() { div.notice {
            p { "Not applicable to the controller's own law:" }
            ul { @for group in &groups { li { (format::not_applicable_group(group)) } } }
        } }
    }
}

pub(super) fn requirements(record: &RunRecord) -> Markup {
    let links = traceability::requirement_links(record);
    let all: usize = record.scenarios.iter().map(|scenario| scenario.expectations.len()).sum();
    let passed = Column::number("Expectations passed", "");
    let mut table =
        Table::new(["Requirement".into(), "Verdict".into(), passed, "Not passed, or else the first".into()]);
    table.extend(links.chunk_by(|a, b| a.requirement == b.requirement).map(requirement_row));
    html! {
        @if !links.is_empty() {
            section aria-labelledby="requirements" {
                h2 id="requirements" { "Requirements" }
                p {
                    (links.len()) " of " (format::count(all, "expectation")) " belong to a requirement; "
                    code { (traceability::FILE) } " lists them with their traces."
                }
                (table.html_as("Requirements", "contents stacked"))
            }
        }
    }
}

fn requirement_row(links: &[RequirementLink<'_>]) -> [Cell; 4] {
    let requirement = links.first().map_or("", |link| link.requirement);
    let text = links.iter().find_map(|link| link.scenario.requirement_texts.get(link.requirement));
    let open: Vec<_> = links.iter().filter(|link| link.expectation.verdict != Verdict::Pass).collect();
    let named = if open.is_empty() { links.iter().take(1).collect() } else { open.clone() };
    [
        Cell::default().with_markup(html! { (requirement) @if let Some(text) = text { span.text { (text) } } }),
        Cell::verdict(Verdict::combine(links.iter().map(|link| link.expectation.verdict))),
        format!("{} of {}", links.len() - open.len(), links.len()).into(),
        Cell::default().with_markup(html! { div {
            @for link in named.iter().take(MAX_NAMED) {
                div {
                    a href={ "#" (scenario_anchor(link.scenario_index)) } { (link.scenario.file) } ": "
                    code { (link.expectation.name) } " " (format::limit(link.expectation))
                }
            }
            @if named.len() > MAX_NAMED { "and " (named.len() - MAX_NAMED) " more" }
        } }),
    ]
}

pub(super) fn cost_section(record: &RunRecord) -> Markup {
    let tight = record_queries::tight_steps(record);
    html! {
        @if !record.cost.is_empty() || !tight.is_empty() {
            section aria-labelledby="cost" {
                h2 id="cost" { "Instructions per control step" }
                @for trend in &record.cost {
                    p {
                        (timing::format_worst(trend)) ", mean " (timing::format_instructions(trend.cost.mean)) "."
                        @if let Some(change) = timing::describe_change(trend) { " " strong { (change) } "." }
                    }
                }
                @for (scenario, percent) in tight {
                    p { strong { "Warning: " (timing::describe_tight_step(scenario, percent)) "." } }
                }
                @if record.cost.iter().any(|trend| !trend.earlier.is_empty()) { (earlier_runs_table(&record.cost)) }
                p { "Instructions, not cycles. The comparison counts only trials that both runs played." }
            }
        }
    }
}

fn earlier_runs_table(trends: &[CostTrend]) -> Markup {
    let columns = ["Earlier run", "Build", "Law"].map(Column::from).into_iter();
    let numbers = ["Trials of both", "Worst then", "Worst now", "Mean then", "Mean now"];
    let mut table = Table::new(columns.chain(numbers.map(|name| Column::number(name, ""))));
    let earlier = trends.iter().flat_map(|trend| trend.earlier.iter().map(move |earlier| (trend, earlier)));
    table.extend(earlier.map(|(trend, EarlierCost { run, build, trials, then, now, .. })| {
        [
            Cell::from(run.as_deref().unwrap_or(timing::SHIPPED_IMAGE)),
            Cell::code(format::short_build_id(build)),
            Cell::from(&*trend.law),
            trials.to_string().into(),
            timing::format_instructions(then.worst).into(),
            format_change(then.worst, now.worst).into(),
            timing::format_instructions(then.mean).into(),
            format_change(then.mean, now.mean).into(),
        ]
    }));
    table.html_as("Instructions per control step", "contents")
}

fn format_change(then: f64, now: f64) -> String {
    if then == now {
        return timing::format_instructions(now);
    }
    let percent = (now / then - 1.0) * 100.0;
    let sign = if percent > 0.0 { "+" } else { "−" };
    format!("{} ({sign}{} %)", timing::format_instructions(now), format::percent(percent))
}

pub(super) fn environment_section(record: &RunRecord) -> Markup {
    let firmware = record
        .rig
        .firmware
        .as_ref()
        .map(|firmware| format!("{}, chip {}", format::firmware_build(record), quoted(&firmware.chip)));
    let facts = [
        ("Tool", format!("{} {}", record.tool.name, record.tool.version)),
        ("Started", record.started.clone()),
        ("Rig", record.rig.name.clone()),
        ("Firmware", firmware.unwrap_or_else(|| "unknown, the controller sent no identity".to_owned())),
        ("Clock", record.clock.to_string()),
        ("Host", format!("{}, {}", record.host.os, record.host.arch)),
        ("Overridden", format::overrides(record).unwrap_or_else(|| "nothing".to_owned())),
    ];
    let not_played = record_queries::scripts_not_played(record).map(|scripts| ("Not played", scripts));
    let facts = facts.into_iter().chain(not_played);
    let inputs = record.scenarios.iter().flat_map(|scenario| &scenario.inputs);
    let inputs: BTreeSet<(&str, &str)> = inputs.map(|input| (input.file.as_str(), input.sha256.as_str())).collect();
    let mut table = Table::new(["File", "SHA-256"]);
    table.extend(inputs.iter().map(|(file, sha256)| [Cell::from(*file), Cell::code(*sha256)]));
    html! {
        section aria-labelledby="environment" {
            h2 id="environment" { "Environment" }
            dl { @for (name, value) in facts { div { dt { (name) } dd { (value) } } } }
            @if !inputs.is_empty() {
                h3 { "Inputs" }
                (table.html_as("Inputs", "inputs"))
            }
        }
    }
}

pub(super) fn boards_section(record: &RunRecord) -> Markup {
    html! { @if let Some(boards) = traceability::board_document(record) { section id="boards" { (boards.body()) } } }
}

/// Width and height of small drawings, CSS pixels.
const SPARKLINE: Point = (88.0, 22.0);
const MARGIN_BAR: Point = (88.0, 5.0);
const SPARKLINE_POINTS: usize = 44;
/// The bar is full at this margin (100 %) and above.
const FULL_MARGIN: f64 = 1.0;

/// `navigation.js` builds the filters from the attributes of the entries.
pub(super) fn scenario_list(record: &RunRecord, data: &[TraceData]) -> Markup {
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
                @for (index, scenario) in sorted_by_verdict(record) { (list_entry(index, scenario, data.get(index))) }
            }
        }
    }
}

fn list_entry(index: usize, scenario: &ScenarioRecord, data: Option<&TraceData>) -> Markup {
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
    let line =
        data.sampled_trials.first().and_then(|trial| trial.peak_lines.get(&platebench_model::trace::Column::Amplitude));
    let (Some(line), Some(whole)) = (line, data.views.last().map(|view| view.window)) else { return Markup::default() };
    let known = data.grid.t_ms.iter().zip(line).filter_map(|(t_ms, value)| Some((*t_ms, (*value)?)));
    let known: Vec<(f64, f64)> = known.collect();
    let top = known.iter().map(|point| point.1).fold(f64::MIN_POSITIVE, f64::max);
    let part = |t_ms: f64| ((t_ms - whole.from_ms) / whole.span_ms() * SPARKLINE_POINTS as f64).floor();
    let parts = known.chunk_by(|a, b| part(a.0) == part(b.0));
    let peaks = parts.filter_map(|points| points.iter().max_by(|a, b| a.1.total_cmp(&b.1)).copied());
    let axes = Axes {
        x: Axis::linear(whole.from_ms..whole.to_ms, 0.0..SPARKLINE.0),
        y: Axis::linear(0.0..top, SPARKLINE.1 - 1.0..1.0),
    };
    let mut drawing = Drawing::default();
    drawing.marks(&axes, &[Mark::Line(Role::First, peaks.collect())]);
    html! { svg.spark viewBox=(view_box(SPARKLINE)) aria-hidden="true" { (drawing.into_markup()) } }
}

fn margin_bar(scenario: &ScenarioRecord) -> Markup {
    let closest = record_queries::closest_expectation(scenario).and_then(|index| scenario.expectations.get(index));
    let Some((closest, margin)) = closest.and_then(|found| Some((found, found.margin?))) else {
        return Markup::default();
    };
    let end = if margin < 0.0 { FULL_MARGIN } else { margin };
    let (width, height) = MARGIN_BAR;
    let axes = Axes { x: Axis::linear(0.0..FULL_MARGIN, 0.0..width), y: Axis::linear(0.0..1.0, height..0.0) };
    let bar = |role: Role, end: f64| Mark::Cell(role, [(0.0, 0.0), (end, 1.0)]);
    let mut drawing = Drawing::default();
    drawing.marks(&axes, &[bar(Role::Grid, FULL_MARGIN), bar(closest.verdict.into(), end)]);
    let title = format!("smallest margin {}: {}", margin_text(margin), closest.name);
    html! {
        svg.margin viewBox=(view_box(MARGIN_BAR)) preserveAspectRatio="none" role="img" aria-label=(title) {
            (drawing.into_markup())
        }
    }
}

pub(super) fn margin_text(margin: f64) -> String {
    format!("{} %", format::number((margin * 1e4).round() / 1e2))
}
