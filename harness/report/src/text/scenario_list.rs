//! Lists scenarios and their expectations without playing them.

use crate::format;
use platebench_document::{Block, Document, Table};
use platebench_model::printable::printable;
use platebench_model::record::Metric;
use platebench_model::scenario::{Aggregation, Expectation, Limit, Scenario};
use schemars::JsonSchema;
use serde::Serialize;

const FORMAT: u32 = 1;

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct ScenarioList<'a> {
    format: u32,
    scenarios: Vec<ListedScenario<'a>>,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct ListedScenario<'a> {
    file: &'a str,
    title: &'a str,
    source: Option<&'a str>,
    tags: &'a [String],
    law: &'a str,
    duration_ms: f64,
    trials: u32,
    expected_exit: Option<u8>,
    expectations: Vec<ListedExpectation<'a>>,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct ListedExpectation<'a> {
    name: &'a str,
    metric: Metric,
    limit: Limit,
    tolerance_percent: Option<f64>,
    windows_ms: Vec<[f64; 2]>,
    requirement: Option<&'a str>,
}

impl<'a> ScenarioList<'a> {
    pub fn new(scenarios: &'a [Scenario]) -> Self {
        Self { format: FORMAT, scenarios: scenarios.iter().map(ListedScenario::new).collect() }
    }

    pub fn document(&self) -> Document {
        let mut blocks = Vec::new();
        for scenario in &self.scenarios {
            let ListedScenario { file, tags, law, .. } = scenario;
            let tags = if tags.is_empty() { String::new() } else { format!("  [{}]", tags.join(", ")) };
            let trials = format::count(scenario.trials as usize, "trial");
            blocks.push(Block::Heading(format!("{file}  (law {law}, {trials}){tags}")));
            blocks.push(Block::paragraph(scenario.title));
            let mut table = Table::new(["metric", "limit", "unit", "window"]);
            table.extend(scenario.expectations.iter().map(ListedExpectation::row));
            blocks.push(Block::Table(table));
        }
        let expectations = self.scenarios.iter().map(|scenario| scenario.expectations.len()).sum();
        let counts = [format::count(self.scenarios.len(), "scenario"), format::count(expectations, "expectation")];
        blocks.push(Block::Paragraph(counts.join(", ")));
        Document::new("Scenarios", blocks)
    }

    /// Returns one name per line.
    pub fn names(&self) -> String {
        self.scenarios.iter().map(|scenario| printable(scenario.file) + "\n").collect()
    }
}

impl<'a> ListedScenario<'a> {
    fn new(scenario: &'a Scenario) -> Self {
        Self {
            file: &scenario.file,
            title: &scenario.title,
            source: scenario.source.as_deref(),
            tags: &scenario.tags,
            law: &scenario.controller.law,
            duration_ms: scenario.duration.ms(),
            trials: scenario.trials.count,
            expected_exit: scenario.expected_exit,
            expectations: scenario.expectations.iter().map(ListedExpectation::new).collect(),
        }
    }
}

impl<'a> ListedExpectation<'a> {
    fn new(expectation: &'a Expectation) -> Self {
        let applies = matches!(expectation.limit, Limit::About(_));
        let is_compared = expectation.aggregation != Aggregation::StandardDeviation;
        Self {
            name: &expectation.name,
            metric: expectation.metric,
            limit: expectation.limit,
            tolerance_percent: (applies && is_compared).then_some(expectation.tolerance_percent),
            windows_ms: expectation.windows.iter().map(|window| [window.from.ms(), window.to.ms()]).collect(),
            requirement: expectation.requirement.as_deref(),
        }
    }

    fn row(&self) -> [String; 4] {
        let limit = format::limit_text(self.limit);
        let limit = match self.tolerance_percent {
            Some(percent) => format!("{limit} ± {} %", format::number(percent)),
            None => limit,
        };
        let window = format::window_list(&self.windows_ms).unwrap_or_default();
        [self.name.to_owned(), limit, format::unit(self.metric).to_owned(), window]
    }
}
