//! Two runs side by side: every expectation of either, with what both measured.
//!
//! Neighbours: the records are shown as they are. Whether responses are alike is what `platebench compare` decides.

use super::{anchor, badge};
use crate::{evidence, shown};
use maud::{Markup, html};
use platebench_verdict::{ExpectationRecord, RunRecord, ScenarioRecord};

/// A run that another is held against.
#[derive(Debug, Clone, Copy)]
pub(super) struct Other<'a> {
    pub(super) name: &'a str,
    pub(super) record: &'a RunRecord,
}

impl<'a> Other<'a> {
    /// What it has of the scenario in `file`.
    pub(super) fn scenario(self, file: &str) -> Option<&'a ScenarioRecord> {
        self.record.scenarios.iter().find(|scenario| scenario.file == file)
    }
}

/// A row of the comparison: an expectation of either run.
struct Pair<'a> {
    /// Number of the scenario in this run's record, where this run has it.
    number: Option<usize>,
    file: &'a str,
    key: String,
    here: Option<&'a ExpectationRecord>,
    there: Option<&'a ExpectationRecord>,
}

impl Pair<'_> {
    fn changed(&self) -> bool {
        self.here.map(|found| found.verdict) != self.there.map(|found| found.verdict)
    }

    /// From the other run's value to this one's.
    fn change(&self) -> Option<String> {
        let (now, then) = (self.here?.value?, self.there?.value?);
        if now == then {
            return Some("none".to_owned());
        }
        let sign = if now > then { "+" } else { "−" };
        let size = (now - then).abs();
        let relative = (then != 0.0).then(|| format!(" ({sign}{} %)", shown::percent(size / then.abs() * 100.0)));
        Some(format!("{sign}{}{}", shown::number(size), relative.unwrap_or_default()))
    }
}

fn keyed<'a>(scenario: Option<&'a ScenarioRecord>) -> Vec<(String, &'a ExpectationRecord)> {
    let of = |scenario: &'a ScenarioRecord| {
        let numbered = scenario.expectations.iter().enumerate();
        numbered.map(|(index, found)| (evidence::key(scenario, index), found)).collect()
    };
    scenario.map(of).unwrap_or_default()
}

/// What both runs have of a scenario; what changed its verdict first.
fn pairs<'a>(record: &'a RunRecord, other: Other<'a>) -> Vec<Pair<'a>> {
    let here = record.scenarios.iter().enumerate().map(|(number, scenario)| (Some(number), scenario.file.as_str()));
    let known = |file: &str| record.scenarios.iter().any(|scenario| scenario.file == file);
    let there = other.record.scenarios.iter().filter(|scenario| !known(&scenario.file));
    let files = here.chain(there.map(|scenario| (None, scenario.file.as_str())));
    let mut pairs: Vec<Pair<'a>> = files
        .flat_map(|(number, file)| {
            let of_this = keyed(number.and_then(|number| record.scenarios.get(number)));
            let of_other = keyed(other.scenario(file));
            let mut keys: Vec<String> = of_this.iter().map(|(key, _)| key.clone()).collect();
            keys.extend(
                of_other.iter().map(|(key, _)| key.clone()).filter(|key| !keys.contains(key)).collect::<Vec<_>>(),
            );
            let find = |all: &[(String, &'a ExpectationRecord)], key: &str| {
                all.iter().find(|(known, _)| known == key).map(|(_, found)| *found)
            };
            let pair =
                |key: String| Pair { number, file, here: find(&of_this, &key), there: find(&of_other, &key), key };
            keys.into_iter().map(pair).collect::<Vec<_>>()
        })
        .collect();
    pairs.sort_by_key(|pair| !pair.changed());
    pairs
}

/// The table of both runs.
pub(super) fn section(record: &RunRecord, other: Other<'_>) -> Markup {
    let pairs = pairs(record, other);
    let changed = pairs.iter().filter(|pair| pair.changed()).count();
    html! {
        section aria-labelledby="against" {
            h2 id="against" { "Beside the run of " (other.record.started) }
            p {
                code { (other.name) } ": " (badge(other.record.verdict, other.record.verdict.name())) " on "
                code { (other.record.rig.name) }
                ", " (build(other.record)) "; this run: " (build(record)) ". "
                @if changed == 0 { "No verdict differs." } @else { (shown::count(changed, "verdict")) " differ." }
            }
            div.scroll role="group" aria-labelledby="against" tabindex="0" {
                table.contents.stacked {
                    thead { tr {
                        th scope="col" { "Scenario" }
                        th scope="col" { "Metric" }
                        th scope="col" { "Other run" }
                        th.number scope="col" { "Other run measured" }
                        th scope="col" { "This run" }
                        th.number scope="col" { "This run measured" }
                        th.number scope="col" { "Change" }
                    } }
                    tbody { @for pair in &pairs { (row(pair)) } }
                }
            }
        }
    }
}

fn build(record: &RunRecord) -> String {
    record.rig.firmware.as_ref().map_or_else(
        || "firmware unknown".to_owned(),
        |firmware| format!("{} {}, build {}", firmware.name, firmware.version, crate::cost::short(&firmware.build)),
    )
}

fn row(pair: &Pair<'_>) -> Markup {
    let verdict = |found: Option<&ExpectationRecord>| {
        html! { @match found { Some(found) => (badge(found.verdict, &shown::verdict(found))), None => span.nothing { "not played" } } }
    };
    let value = |found: Option<&ExpectationRecord>| {
        let unit = if found.is_some_and(|found| found.value.is_some()) { shown::unit(&metric(pair)) } else { "" };
        html! { @match found.and_then(shown::found) { Some(value) => { (value) " " span.unit { (unit) } }, None => span.nothing { "–" } } }
    };
    html! {
        tr.changed[pair.changed()] {
            th scope="row" {
                @match pair.number {
                    Some(number) => a href={ "#" (anchor(number)) } { (pair.file) },
                    None => (pair.file),
                }
            }
            td data-label="Metric" { code { (pair.key) } }
            td data-label="Other run" { (verdict(pair.there)) }
            td.number data-label="Other run measured" { span { (value(pair.there)) } }
            td data-label="This run" { (verdict(pair.here)) }
            td.number data-label="This run measured" { span { (value(pair.here)) } }
            td.number data-label="Change" { @match pair.change() { Some(change) => (change), None => span.nothing { "–" } } }
        }
    }
}

fn metric(pair: &Pair<'_>) -> String {
    pair.here.or(pair.there).map(|found| found.metric.clone()).unwrap_or_default()
}
