//! Formats the report as text and as Markdown tables.

use crate::trust::report::{MutantOutcome, MutantResult, Rate, TrustReport};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::{self, Write};

const MAX_LISTED: usize = 6;

pub fn summary(report: &TrustReport) -> String {
    let mut text = String::new();
    let _ = write_summary(&mut text, report);
    text
}

fn write_summary(text: &mut String, report: &TrustReport) -> fmt::Result {
    for scenario in &report.scenarios {
        writeln!(text, "{:>3} of {} mutants: {}", scenario.kill_rate.seen, scenario.kill_rate.count, scenario.file)?;
    }
    writeln!(text)?;
    for fault in &report.faults {
        let word = match fault.outcome {
            MutantOutcome::Caught => continue,
            MutantOutcome::WrongReason => "caught for a wrong reason only",
            MutantOutcome::Survived => "survived",
        };
        writeln!(text, "{word}: {}, {}", fault.name, fault.mistake)?;
        for cell in fault.wrong.iter().take(MAX_LISTED) {
            writeln!(text, "    {} {}", cell.scenario, cell.metric)?;
        }
    }
    for alarm in &report.clean.alarms {
        let run = alarm.run.map_or_else(|| "unmodified suite".to_owned(), |run| format!("clean run {run}"));
        writeln!(
            text,
            "false alarm: {}, {run}, seed {}: {} {}",
            alarm.controller, alarm.seed, alarm.cell.scenario, alarm.cell.metric
        )?;
    }
    let clean = &report.clean;
    writeln!(text, "kill rate: {}", format_rate(report.kill_rate))?;
    writeln!(
        text,
        "false alarms: {}; {} inconclusive clean runs; {} scenarios, first seed {}",
        format_rate(clean.false_alarm_rate),
        clean.inconclusive,
        clean.scenarios,
        clean.seed
    )
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
        let metrics = |cells: &[crate::trust::report::FailedExpectation]| {
            let mut counts: BTreeMap<&str, u32> = BTreeMap::new();
            for cell in cells {
                *counts.entry(&cell.metric).or_default() += 1;
            }
            let counts: Vec<_> = counts.iter().map(|(metric, count)| format!("`{metric}` {count}")).collect();
            if counts.is_empty() { "-".to_owned() } else { counts.join(", ") }
        };
        writeln!(text, "| {name} | {mistake} | {} | {} |", metrics(right), metrics(wrong))?;
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
