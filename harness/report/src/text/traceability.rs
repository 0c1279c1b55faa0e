//! Writes `traceability.csv`: the expectations of each requirement with verdict, value and trace.

use crate::document::{Block, Document, Table};
use crate::error::{ReportError, write_file};
use crate::{format, record_queries};
use platebench_model::record::{RunRecord, Verdict};
use std::path::Path;

pub const FILE: &str = "traceability.csv";

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct RequirementLink {
    pub(crate) requirement: String,
    pub(crate) expectation: String,
    pub(crate) limit: String,
    pub(crate) scenario: String,
    pub(crate) scenario_index: usize,
    pub(crate) verdict: Verdict,
    pub(crate) value: Option<f64>,
    pub(crate) unit: &'static str,
    pub(crate) interval: Option<[f64; 2]>,
    /// Trace of the trial that decided, or else of the first trial.
    pub(crate) trace: String,
}

pub(crate) fn requirement_links(record: &RunRecord) -> Vec<RequirementLink> {
    let mut links = Vec::new();
    for (scenario_index, scenario) in record.scenarios.iter().enumerate() {
        for (index, expectation) in scenario.expectations.iter().enumerate() {
            let Some(requirement) = &expectation.requirement else { continue };
            let trial = record_queries::trial_to_inspect(scenario, index).or_else(|| scenario.trials.first());
            links.push(RequirementLink {
                requirement: requirement.clone(),
                expectation: expectation.name.clone(),
                limit: format::limit(expectation),
                scenario: scenario.file.clone(),
                scenario_index,
                verdict: expectation.verdict,
                value: expectation.value,
                unit: format::unit(expectation.metric),
                interval: expectation.interval,
                trace: trial.map(|trial| trial.trace.clone()).unwrap_or_default(),
            });
        }
    }
    links.sort_by(|a, b| a.requirement.cmp(&b.requirement));
    links
}

pub fn write(record: &RunRecord, folder: &Path) -> Result<(), ReportError> {
    write_file(&folder.join(FILE), &document(record).to_csv())
}

pub fn document(record: &RunRecord) -> Document {
    let mut table = Table::new([
        "requirement",
        "expectation",
        "limit",
        "scenario",
        "verdict",
        "value",
        "unit",
        "interval_low",
        "interval_high",
        "trace",
    ]);
    table.extend(requirement_links(record).into_iter().map(|link| {
        let verdict = link.verdict.to_string();
        let numbers = [link.value, link.interval.map(|[low, _]| low), link.interval.map(|[_, high]| high)];
        let [value, low, high] = numbers.map(|number| number.map(|number| number.to_string()).unwrap_or_default());
        let unit = link.unit.to_owned();
        vec![link.requirement, link.expectation, link.limit, link.scenario, verdict, value, unit, low, high, link.trace]
    }));
    Document::new("Requirements", vec![Block::Table(table)])
}
