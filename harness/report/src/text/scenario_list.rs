//! Lists scenarios and their expectations without playing them.

use crate::document::Table;
use crate::escape::printable;
use crate::format;
use platebench_model::scenario::{Aggregation, Expectation, Limit, Scenario};
use serde_json::{Value, json};
use std::fmt::Write as _;

const FORMAT: u32 = 1;

pub fn text(scenarios: &[Scenario]) -> String {
    let mut text = String::new();
    for scenario in scenarios {
        let tags = if scenario.tags.is_empty() { String::new() } else { format!("  [{}]", scenario.tags.join(", ")) };
        let trials = format::count(scenario.trials.count as usize, "trial");
        let law = &scenario.controller.law;
        let heading = format!("{}  (law {law}, {trials}){tags}", scenario.file);
        let _ = writeln!(text, "{}\n  {}\n", printable(&heading), printable(&scenario.title));
        let mut table = Table::new(["metric", "limit", "unit", "window"]);
        table.extend(scenario.expectations.iter().map(|expectation| {
            vec![
                expectation.name.clone(),
                limit(expectation),
                format::unit(expectation.metric).to_owned(),
                format::window_list(&windows_ms(expectation)).unwrap_or_default(),
            ]
        }));
        for line in table.lines() {
            let _ = writeln!(text, "  {line}");
        }
        text.push('\n');
    }
    let expectations = scenarios.iter().map(|scenario| scenario.expectations.len()).sum();
    let counts = [format::count(scenarios.len(), "scenario"), format::count(expectations, "expectation")];
    let _ = writeln!(text, "{}", counts.join(", "));
    text
}

/// Returns one name per line.
pub fn names(scenarios: &[Scenario]) -> String {
    scenarios.iter().fold(String::new(), |names, scenario| names + &printable(&scenario.file) + "\n")
}

pub fn json(scenarios: &[Scenario]) -> Value {
    let expectation = |expectation: &Expectation| {
        json!({
            "name": expectation.name, "metric": expectation.metric, "limit": expectation.limit,
            "tolerance_percent": tolerance_percent(expectation), "windows_ms": windows_ms(expectation),
            "requirement": expectation.requirement,
        })
    };
    let scenario = |scenario: &Scenario| {
        json!({
            "file": scenario.file, "title": scenario.title, "source": scenario.source, "tags": scenario.tags,
            "law": scenario.controller.law, "duration_ms": scenario.duration.ms(), "trials": scenario.trials.count,
            "expectations": scenario.expectations.iter().map(expectation).collect::<Vec<_>>(),
        })
    };
    json!({ "format": FORMAT, "scenarios": scenarios.iter().map(scenario).collect::<Vec<_>>() })
}

fn limit(expectation: &Expectation) -> String {
    let limit = format::limit_text(expectation.limit);
    match tolerance_percent(expectation) {
        Some(percent) => format!("{limit} ± {} %", format::number(percent)),
        None => limit,
    }
}

fn tolerance_percent(expectation: &Expectation) -> Option<f64> {
    let applies = matches!(expectation.limit, Limit::About(_));
    let is_compared = expectation.aggregation != Aggregation::StandardDeviation;
    (applies && is_compared).then_some(expectation.tolerance_percent)
}

fn windows_ms(expectation: &Expectation) -> Vec<[f64; 2]> {
    expectation.windows.iter().map(|window| [window.from.ms(), window.to.ms()]).collect()
}
