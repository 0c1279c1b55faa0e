//! `traceability.csv`: from each requirement to the expectations that hold it, what came of them and where to look.
//!
//! Neighbours: the report shows the same rows. Everything stands in the record.

use crate::error::ReportError;
use crate::{evidence, shown};
use platebench_verdict::{RunRecord, Verdict};
use std::fs;
use std::path::Path;

/// The file's name in a run folder.
pub const FILE: &str = "traceability.csv";

/// One expectation that holds a requirement.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Link {
    pub(crate) requirement: String,
    pub(crate) expectation: String,
    pub(crate) limit: String,
    pub(crate) scenario: String,
    /// Number of the scenario in the record.
    pub(crate) number: usize,
    pub(crate) verdict: Verdict,
    pub(crate) value: String,
    /// The trial that decided, or the first.
    pub(crate) trace: String,
}

/// Every expectation with a requirement, by requirement and then as they were played.
pub(crate) fn links(record: &RunRecord) -> Vec<Link> {
    let mut links = Vec::new();
    for (number, scenario) in record.scenarios.iter().enumerate() {
        for (index, expectation) in scenario.expectations.iter().enumerate() {
            let Some(requirement) = &expectation.requirement else { continue };
            let trial = evidence::trial(scenario, index).or_else(|| scenario.trials.first());
            links.push(Link {
                requirement: requirement.clone(),
                expectation: evidence::key(scenario, index),
                limit: shown::limit(expectation),
                scenario: scenario.file.clone(),
                number,
                verdict: expectation.verdict,
                value: shown::value(expectation).unwrap_or_default(),
                trace: trial.map(|trial| trial.trace.clone()).unwrap_or_default(),
            });
        }
    }
    links.sort_by(|a, b| a.requirement.cmp(&b.requirement));
    links
}

/// Writes the table into the run folder.
///
/// # Errors
/// [`ReportError`] where the file cannot be written.
pub fn write(record: &RunRecord, folder: &Path) -> Result<(), ReportError> {
    let path = folder.join(FILE);
    fs::write(&path, text(record)).map_err(ReportError::io(&path))
}

fn text(record: &RunRecord) -> String {
    let mut text = "requirement,expectation,limit,scenario,verdict,value,trace\n".to_owned();
    for link in links(record) {
        let verdict = link.verdict.to_string();
        let fields =
            [&link.requirement, &link.expectation, &link.limit, &link.scenario, &verdict, &link.value, &link.trace];
        text.push_str(&fields.map(|field| quoted(field)).join(","));
        text.push('\n');
    }
    text
}

/// A field as RFC 4180 wants it.
fn quoted(field: &str) -> String {
    if field.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", field.replace('"', "\"\""))
    } else {
        field.to_owned()
    }
}
