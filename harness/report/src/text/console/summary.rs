//! Summarises a run: counts, duration, smallest margin, verdict, and what did not pass.

use crate::document::{Style, write_wrapped};
use crate::text::cost;
use crate::{format, record_queries};
use platebench_model::record::{Cause, CostTrend, ExpectationRecord, RunRecord, ScenarioRecord, Verdict};
use std::fmt::Write as _;

/// Longest list without `-v`.
const MAX_LISTED: usize = 3;

/// `in_full` lists every scenario that is not applicable and the cost of every law.
pub(super) fn write(text: &mut String, record: &RunRecord, style: Style, in_full: bool) {
    write_not_applicable(text, record, in_full || record.overrides.require_all);
    for (name, counts) in [
        ("scenario", format::VerdictCounts::of_scenarios(record)),
        ("expectation", format::VerdictCounts::of_expectations(record)),
    ] {
        let _ = writeln!(text, "{}: {counts}", format::count(counts.total(), name));
    }
    if let Some(duration) = record.wall_ms {
        let _ = writeln!(text, "duration: {}", format::duration(duration));
    }
    if let Some((scenario, wall_ms)) = record_queries::slowest_scenario(record) {
        let trials = format::count(scenario.trials.len(), "trial");
        let slowest = format!("{}, {} in {trials}", scenario.file, format::duration(wall_ms));
        write_wrapped(text, "slowest scenario: ", "  ", &slowest);
    }
    if let Some((scenario, expectation, margin)) = record_queries::smallest_margin(record) {
        let result = format!("{}: {}", scenario.file, result(expectation));
        let margin = format!("smallest margin: {} %, ", format::number(margin * 100.0));
        write_wrapped(text, &margin, "  ", &result);
    }
    write_cost(text, &record.cost, in_full);
    write_tight_steps(text, record, in_full);
    if let Some(overrides) = format::overrides(record) {
        write_wrapped(text, "", "  ", &format!("overridden: {overrides}"));
    }
    write_verdict(text, record, style);
    write_list_of_not_passed(text, record, style);
}

pub(super) fn verdict_reason(record: &RunRecord) -> String {
    let lost = record.scenarios.iter().flat_map(|scenario| &scenario.trials).find_map(|trial| {
        let ended = trial.telemetry.ended.as_ref().filter(|_| trial.cause == Some(Cause::Rig))?;
        Some(format!("the controller was lost: {ended}"))
    });
    let reasons = record_queries::expectations_not_passed(record).into_iter().filter_map(|(scenario, index)| {
        let expectation = scenario.expectations.get(index)?;
        let reason = format::remaining_reason(expectation).map_or_else(String::new, |reason| format!(" ({reason})"));
        Some(format!("{}{reason}", result(expectation)))
    });
    let not_applicable = record.not_applicable.iter().map(|scenario| format!("not applicable: {}", scenario.reason));
    let unsafe_end = record.unsafe_end().map(str::to_owned);
    let unfinished = (!record.complete).then(|| "the run was not finished".to_owned());
    let all: Vec<String> =
        lost.into_iter().chain(unsafe_end).chain(reasons).chain(not_applicable).chain(unfinished).collect();
    if all.is_empty() { "every expectation is met".to_owned() } else { all.join("; ") }
}

pub(super) fn write_not_passed(text: &mut String, record: &RunRecord, style: Style) {
    if record.overrides.require_all || record.scenarios.is_empty() {
        write_not_applicable(text, record, true);
    }
    write_verdict(text, record, style);
    write_list_of_not_passed(text, record, style);
}

fn write_not_applicable(text: &mut String, record: &RunRecord, in_full: bool) {
    if !in_full && record.not_applicable.len() > MAX_LISTED {
        let count = format::count(record.not_applicable.len(), "scenario");
        let _ = writeln!(text, "not applicable: {count}, listed with -v");
        return;
    }
    for scenario in &record.not_applicable {
        write_wrapped(text, "not applicable: ", "  ", &format!("{}: {}", scenario.file, scenario.reason));
    }
}

/// Unless `in_full`, lists the laws whose cost changed, or else the law with the highest cost.
fn write_cost(text: &mut String, trends: &[CostTrend], in_full: bool) {
    let changed = |trend: &&CostTrend| in_full || cost::describe_change(trend).is_some();
    let mut listed: Vec<_> = trends.iter().filter(changed).collect();
    if listed.is_empty() {
        listed.extend(trends.iter().max_by(|a, b| a.cost.worst.total_cmp(&b.cost.worst)));
    }
    let further = if in_full { 0 } else { listed.len().saturating_sub(MAX_LISTED) };
    listed.truncate(listed.len() - further);
    for trend in listed {
        let _ = writeln!(text, "instructions per step: {}", cost::format_worst(trend));
        if let Some(change) = cost::describe_change(trend) {
            write_wrapped(text, "  ↳ ", "    ", &change);
        }
    }
    if further > 0 {
        let laws = format::count(further, "more law");
        let _ = writeln!(text, "instructions per step: {laws} with a change, listed with -v");
    }
}

fn write_tight_steps(text: &mut String, record: &RunRecord, in_full: bool) {
    let tight = record_queries::tight_steps(record);
    let listed = if in_full { tight.len() } else { MAX_LISTED };
    for (scenario, percent) in tight.iter().take(listed) {
        write_wrapped(text, "warning: ", "  ", &cost::describe_tight_step(scenario, *percent));
    }
    if tight.len() > listed {
        let further = format::count(tight.len() - listed, "more scenario");
        let _ = writeln!(text, "warning: {further} with a long control step, listed with -v");
    }
}

fn write_verdict(text: &mut String, record: &RunRecord, style: Style) {
    if !record.complete {
        text.push_str("the run was not finished\n");
    }
    let verdict = format!("{} {}", format::sign(record.verdict), record.verdict);
    let _ = writeln!(text, "verdict: {}", style.paint_verdict(record.verdict, &verdict));
}

fn write_list_of_not_passed(text: &mut String, record: &RunRecord, style: Style) {
    let unplayed = record_queries::unplayed_scenarios(record);
    if !unplayed.is_empty() {
        let _ = writeln!(text, "not played after the first failure: {}", format::count(unplayed.len(), "scenario"));
    }
    let mut not_passed = record_queries::expectations_not_passed(record);
    not_passed.retain(|(scenario, _)| !unplayed.contains(&scenario.file.as_str()));
    if !not_passed.is_empty() {
        text.push_str("\nnot passed:\n");
    }
    for (scenario, index) in not_passed {
        if let Some(expectation) = scenario.expectations.get(index) {
            write_result(text, scenario, index, expectation, style);
        }
    }
}

fn write_result(
    text: &mut String,
    scenario: &ScenarioRecord,
    index: usize,
    expectation: &ExpectationRecord,
    style: Style,
) {
    let mut lines = String::new();
    let (file, sign) = (&scenario.file, format::sign(expectation.verdict));
    write_wrapped(&mut lines, &format!("  {sign} "), "    ", &format!("{file}: {}", result(expectation)));
    text.push_str(&lines.replacen(sign, &style.paint_verdict(expectation.verdict, sign), 1));
    let verdict = (expectation.verdict == Verdict::Inconclusive).then(|| format::verdict(expectation));
    let reason: Vec<_> = verdict.into_iter().chain(format::remaining_reason(expectation)).collect();
    if !reason.is_empty() {
        write_wrapped(text, "    ↳ ", "      ", &reason.join(": "));
    }
    let trace = record_queries::trial_to_inspect(scenario, index).map_or("none", |trial| trial.trace.as_str());
    write_wrapped(text, "    trace: ", "      ", trace);
}

fn result(expectation: &ExpectationRecord) -> String {
    let unit = format::unit(expectation.metric);
    let value = match format::value(expectation) {
        Some(value) => format!("{value} {unit}"),
        None => format::value_or_not_reached(expectation).unwrap_or_else(|| "no value".to_owned()),
    };
    let window = format::in_window(expectation).map_or_else(String::new, |window| format!(", {window}"));
    format!("{}: {}, limit {}{window}", expectation.name, value.trim_end(), format::limit(expectation))
}
