//! Defines the report of `platebench suite trust` (`trust.json`), and its text and Markdown tables.

use platebench_document::{Block, Column, Document, Table};
use platebench_model::record::Verdict;
use platebench_verdict::statistics::clopper_pearson;
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::{self, Write};

/// Confidence of each one-sided bound.
pub const CONFIDENCE: f64 = 0.95;

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct TrustReport {
    pub format: u32,
    /// `pass` if every mutant is caught for a right reason and there is no false alarm, else
    /// `fail`.
    pub verdict: Verdict,
    pub confidence: f64,
    pub kill_rate: Rate,
    pub scenarios: Vec<ScenarioRate>,
    pub faults: Vec<MutantResult>,
    pub protocol_faults: ProtocolFaultResult,
    pub clean: FalseAlarmResult,
}

/// Faults that were written independently of the suite. They do not change the verdict.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct ProtocolFaultResult {
    pub kill_rate: Rate,
    pub faults: Vec<MutantResult>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct Rate {
    pub seen: u32,
    pub count: u32,
    /// Bounds of the true probability by Clopper and Pearson. `null` if `count` is 0.
    pub bounds: Option<[f64; 2]>,
}

impl Rate {
    pub fn new(seen: usize, count: usize) -> Self {
        let (seen, count) = (seen as u32, count as u32);
        Self { seen, count, bounds: clopper_pearson(seen, count, CONFIDENCE) }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct ScenarioRate {
    pub file: String,
    pub kill_rate: Rate,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct MutantResult {
    pub name: String,
    pub mistake: String,
    pub should_be_caught_by: Vec<String>,
    pub outcome: MutantOutcome,
    /// Failures that should catch the mutant. The reference passes these expectations.
    pub right: Vec<FailedExpectation>,
    /// Failures of other metrics or rules. The reference passes these expectations too.
    pub wrong: Vec<FailedExpectation>,
}

impl MutantResult {
    pub fn is_caught_by(&self, scenario: &str) -> bool {
        self.right.iter().any(|cell| cell.scenario == scenario)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum MutantOutcome {
    Caught,
    /// Only other metrics or rules fail. The mutant then counts as survived.
    WrongReason,
    Survived,
}

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, JsonSchema)]
pub struct FailedExpectation {
    pub scenario: String,
    /// Number of the expectation, from 1. It is 0 for a violation of the protocol.
    pub expectation: usize,
    pub metric: String,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct FalseAlarmResult {
    /// Share of clean runs that fail. Each plays one scenario with another plate and noise.
    pub false_alarm_rate: Rate,
    pub inconclusive: u32,
    pub scenarios: u32,
    pub seed: u64,
    /// Failures of correct controllers in the clean runs and in the unmodified scenarios.
    pub alarms: Vec<FalseAlarm>,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct FalseAlarm {
    /// `reference` or the name of a clean variant.
    pub controller: String,
    /// Number of the clean run, from 0. `null` for an alarm in the unmodified scenarios.
    pub run: Option<u32>,
    pub seed: u64,
    pub cell: FailedExpectation,
}

const MAX_LISTED: usize = 6;

pub fn document(report: &TrustReport) -> Document {
    let mut scenarios = Table::new([Column::number("mutants caught", ""), Column::from("scenario")]);
    scenarios.extend(
        report.scenarios.iter().map(|ScenarioRate { file, kill_rate }| {
            [format!("{} of {}", kill_rate.seen, kill_rate.count), file.clone()]
        }),
    );
    let mut failures = Vec::new();
    for fault in report.faults.iter().chain(&report.protocol_faults.faults) {
        let word = match fault.outcome {
            MutantOutcome::Caught => continue,
            MutantOutcome::WrongReason => "caught for a wrong reason only",
            MutantOutcome::Survived => "survived",
        };
        failures.push(format!("{word}: {}, {}", fault.name, fault.mistake));
        let wrong = fault.wrong.iter().take(MAX_LISTED);
        failures.extend(wrong.map(|cell| format!("    {} {}", cell.scenario, cell.metric)));
    }
    failures.extend(report.clean.alarms.iter().map(|FalseAlarm { controller, run, seed, cell }| {
        let run = run.map_or_else(|| "unmodified suite".to_owned(), |run| format!("clean run {run}"));
        format!("false alarm: {controller}, {run}, seed {seed}: {} {}", cell.scenario, cell.metric)
    }));
    let FalseAlarmResult { false_alarm_rate, inconclusive, scenarios: played, seed, .. } = &report.clean;
    let rates = [
        format!("kill rate: {}", format_rate(report.kill_rate)),
        format!("protocol faults: {}", format_rate(report.protocol_faults.kill_rate)),
        format!(
            "false alarms: {}; {inconclusive} inconclusive clean runs; {played} scenarios, first seed {seed}",
            format_rate(*false_alarm_rate)
        ),
    ];
    let mut blocks = vec![Block::Table(scenarios)];
    blocks.extend((!failures.is_empty()).then(|| Block::lines(failures)));
    blocks.push(Block::lines(rates));
    Document::new("Kill rate and false-alarm rate", blocks)
}

/// Example: `33 of 33, 100 % (each bound at 95 %: at least 91.32 %, at most 100 %)`.
pub fn format_rate(rate: Rate) -> String {
    let Rate { seen, count, bounds } = rate;
    match bounds {
        Some([low, high]) => format!(
            "{seen} of {count}, {:.4} % (each bound at 95 %: at least {:.4} %, at most {:.4} %)",
            f64::from(seen) / f64::from(count) * 100.0,
            low * 100.0,
            high * 100.0
        ),
        None => format!("{seen} of {count}"),
    }
}

pub fn matrix(report: &TrustReport) -> String {
    let mut text = String::new();
    let _ = write_matrix(&mut text, report);
    text
}

fn write_matrix(text: &mut String, report: &TrustReport) -> fmt::Result {
    writeln!(text, "| mutant | mistake | caught by (expectations of the suite) | other failures |")?;
    writeln!(text, "|---|---|---|---|")?;
    for fault in &report.faults {
        let MutantResult { name, mistake, right, wrong, .. } = fault;
        let metrics = |cells: &[FailedExpectation]| {
            let mut counts: BTreeMap<&str, u32> = BTreeMap::new();
            for cell in cells {
                *counts.entry(&cell.metric).or_default() += 1;
            }
            let counts: Vec<_> = counts.iter().map(|(metric, count)| format!("`{metric}` {count}")).collect();
            if counts.is_empty() { "-".to_owned() } else { counts.join(", ") }
        };
        writeln!(text, "| {name} | {mistake} | {} | {} |", metrics(right), metrics(wrong))?;
    }
    writeln!(text, "\n| protocol fault | mistake | failed scenarios |\n|---|---|---|")?;
    for MutantResult { name, mistake, right, .. } in &report.protocol_faults.faults {
        let scenarios: BTreeSet<&str> = right.iter().map(|cell| cell.scenario.as_str()).collect();
        let scenarios = scenarios.into_iter().collect::<Vec<_>>().join(", ");
        writeln!(text, "| {name} | {mistake} | {} |", if scenarios.is_empty() { "-" } else { &scenarios })?;
    }
    writeln!(text, "\n| scenario | mutants caught | which |\n|---|---|---|")?;
    for scenario in &report.scenarios {
        let catching = report.faults.iter().filter(|fault| fault.is_caught_by(&scenario.file));
        let names: BTreeSet<&str> = catching.map(|fault| fault.name.as_str()).collect();
        let names = names.into_iter().collect::<Vec<_>>().join(", ");
        let Rate { seen, count, .. } = scenario.kill_rate;
        writeln!(text, "| {} | {seen} of {count} | {names} |", scenario.file)?;
    }
    Ok(())
}
