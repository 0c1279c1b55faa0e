//! Writes the comparison of two runs, with both values of every expectation.

use super::elements::{scenario_anchor, scroll_table};
use crate::document::verdict_badge;
use crate::format;
use crate::text::cost;
use maud::{Markup, html};
use platebench_model::record::{ExpectationRecord, Metric, RunRecord, ScenarioRecord};

#[derive(Debug, Clone, Copy)]
pub(super) struct OtherRun<'a> {
    pub(super) name: &'a str,
    pub(super) record: &'a RunRecord,
}

impl<'a> OtherRun<'a> {
    pub(super) fn scenario(self, file: &str) -> Option<&'a ScenarioRecord> {
        self.record.scenarios.iter().find(|scenario| scenario.file == file)
    }
}

struct ExpectationPair<'a> {
    scenario_index: Option<usize>,
    file: &'a str,
    name: &'a str,
    this_run: Option<&'a ExpectationRecord>,
    other_run: Option<&'a ExpectationRecord>,
}

impl ExpectationPair<'_> {
    fn verdict_changed(&self) -> bool {
        self.this_run.map(|found| found.verdict) != self.other_run.map(|found| found.verdict)
    }

    fn format_change(&self) -> Option<String> {
        let (now, then) = (self.this_run?.value?, self.other_run?.value?);
        if now == then {
            return Some("none".to_owned());
        }
        let sign = if now > then { "+" } else { "−" };
        let size = (now - then).abs();
        let relative = (then != 0.0).then(|| format!(" ({sign}{} %)", format::percent(size / then.abs() * 100.0)));
        Some(format!("{sign}{}{}", format::number(size), relative.unwrap_or_default()))
    }
}

fn expectation_pairs<'a>(record: &'a RunRecord, other: OtherRun<'a>) -> Vec<ExpectationPair<'a>> {
    let here = record.scenarios.iter().enumerate().map(|(number, scenario)| (Some(number), scenario.file.as_str()));
    let known = |file: &str| record.scenarios.iter().any(|scenario| scenario.file == file);
    let there = other.record.scenarios.iter().filter(|scenario| !known(&scenario.file));
    let files = here.chain(there.map(|scenario| (None, scenario.file.as_str())));
    let mut pairs: Vec<ExpectationPair<'a>> = files
        .flat_map(|(number, file)| {
            let of_this = number.and_then(|number| record.scenarios.get(number));
            let this_run = of_this.map_or(&[][..], |scenario| &scenario.expectations);
            let other_run = other.scenario(file).map_or(&[][..], |scenario| &scenario.expectations);
            let find = |all: &'a [ExpectationRecord], name: &str| all.iter().find(|found| found.name == name);
            let only_other = other_run.iter().filter(|found| find(this_run, &found.name).is_none());
            let pair = |found: &'a ExpectationRecord| ExpectationPair {
                scenario_index: number,
                file,
                this_run: find(this_run, &found.name),
                other_run: find(other_run, &found.name),
                name: &found.name,
            };
            this_run.iter().chain(only_other).map(pair).collect::<Vec<_>>()
        })
        .collect();
    pairs.sort_by_key(|pair| !pair.verdict_changed());
    pairs
}

pub(super) fn section(record: &RunRecord, other: OtherRun<'_>) -> Markup {
    let pairs = expectation_pairs(record, other);
    let changed = pairs.iter().filter(|pair| pair.verdict_changed()).count();
    let columns =
        ["Scenario", "Metric", "Other run", "#Other run measured", "This run", "#This run measured", "#Change"];
    let rows = html! { @for pair in &pairs { (table_row(pair)) } };
    html! {
        section aria-labelledby="against" {
            h2 id="against" { "Comparison with the run of " (other.record.started) }
            p {
                code { (other.name) } ": " (verdict_badge(other.record.verdict, other.record.verdict.name())) " on "
                code { (other.record.rig.name) }
                ", " (format_build(other.record)) "; this run: " (format_build(record)) ". "
                @match changed {
                    0 => "No verdict differs.",
                    1 => "1 verdict differs.",
                    _ => { (changed) " verdicts differ." },
                }
            }
            (scroll_table("Comparison of both runs", "contents stacked", &columns, &rows))
        }
    }
}

fn format_build(record: &RunRecord) -> String {
    record.rig.firmware.as_ref().map_or_else(
        || "firmware unknown".to_owned(),
        |firmware| format!("{} {}, build {}", firmware.name, firmware.version, cost::short_build_id(&firmware.build)),
    )
}

fn table_row(pair: &ExpectationPair<'_>) -> Markup {
    let verdict = |found: Option<&ExpectationRecord>| {
        html! {
            @match found {
                Some(found) => (verdict_badge(found.verdict, &format::verdict(found))),
                None => span.nothing { "not played" },
            }
        }
    };
    let value = |found: Option<&ExpectationRecord>| {
        let unit =
            if found.is_some_and(|found| found.value.is_some()) { metric(pair).map_or("", format::unit) } else { "" };
        html! {
            @match found.and_then(format::value_or_not_reached) {
                Some(value) => { (value) " " span.unit { (unit) } },
                None => span.nothing { "–" },
            }
        }
    };
    html! {
        tr.changed[pair.verdict_changed()] {
            th scope="row" {
                @match pair.scenario_index {
                    Some(number) => a href={ "#" (scenario_anchor(number)) } { (pair.file) },
                    None => (pair.file),
                }
            }
            td data-label="Metric" { code { (pair.name) } }
            td data-label="Other run" { (verdict(pair.other_run)) }
            td.number data-label="Other run measured" { span { (value(pair.other_run)) } }
            td data-label="This run" { (verdict(pair.this_run)) }
            td.number data-label="This run measured" { span { (value(pair.this_run)) } }
            td.number data-label="Change" {
                @match pair.format_change() { Some(change) => (change), None => span.nothing { "–" } }
            }
        }
    }
}

fn metric(pair: &ExpectationPair<'_>) -> Option<Metric> {
    pair.this_run.or(pair.other_run).map(|found| found.metric)
}
