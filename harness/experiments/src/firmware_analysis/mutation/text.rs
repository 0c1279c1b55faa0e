//! Formats the results of mutation testing as text.

use super::mutant::Operator;
use super::result::{MutantResult, MutationReport, Score, Status};
use std::fmt::{self, Write};

pub fn summary(report: &MutationReport) -> String {
    let mut text = String::new();
    let _ = write_summary(&mut text, report);
    text
}

fn write_summary(text: &mut String, report: &MutationReport) -> fmt::Result {
    writeln!(text, "{:<22} {:>8} {:>8} {:>8}  {:>7}", "operator", "detected", "survived", "not run", "score")?;
    for &operator in Operator::ALL {
        let of_operator = || report.results.iter().filter(|result| result.mutant.operator == operator);
        let statuses = || of_operator().map(|result| &result.status);
        let score = Score::of(statuses());
        let survived = statuses().filter(|status| matches!(status, Status::Survived { .. })).count();
        let not_run = statuses().filter(|status| **status == Status::NoCoverage).count();
        let name = operator.name();
        let (detected, percent) = (score.detected, score.percent());
        writeln!(text, "{name:<22} {detected:>8} {survived:>8} {not_run:>8}  {percent:>5.1} %")?;
    }
    for result in &report.results {
        if let Status::Survived { .. } = result.status {
            write_survivor(text, result)?;
        }
    }
    for result in &report.results {
        if let Status::RuntimeError { reason, .. } = &result.status {
            writeln!(text, "\nemulator failed: {:#010x} {}: {reason}", result.mutant.instruction, result.mutant.after)?;
        }
    }
    writeln!(text, "\n{} of {} mutants", report.results.len(), report.population)?;
    let [survivors, unchanged] = report.survivors();
    writeln!(text, "{survivors} survived, {unchanged} of them without a change of any drive or frequency")?;
    writeln!(text, "mutation score: {}", format_score(report.score()))?;
    writeln!(text, "of executed mutants: {}", format_score(report.score_of_executed()))?;
    writeln!(text, "of mutants in the control step: {}", format_score(report.score_of_control_step()))?;
    let changed = format_score(report.score_of_changed_control_step());
    writeln!(text, "of these, without survivors that change no drive and no frequency: {changed}")
}

fn write_survivor(text: &mut String, result: &MutantResult) -> fmt::Result {
    let mutant = &result.mutant;
    let line = mutant.line.as_ref().map_or_else(|| "no line".to_owned(), |line| format!("{}:{}", line.file, line.line));
    let place = if mutant.in_control_step { ", control step" } else { "" };
    writeln!(text, "\nsurvived: {:#010x} {line} in {}{place}", mutant.instruction, mutant.function)?;
    writeln!(text, "    {}: {} -> {}", mutant.operator, mutant.before, mutant.after)?;
    match &result.status {
        Status::Survived { same_commands: true, .. } => {
            writeln!(text, "    {} scenarios; no drive and no frequency changed", result.covered_by.len())
        }
        Status::Survived { closest: Some(closest), .. } => writeln!(
            text,
            "    {} scenarios; closest margin {:.3}: {} {}",
            result.covered_by.len(),
            closest.margin,
            closest.scenario,
            closest.expectation
        ),
        _ => writeln!(text, "    {} scenarios", result.covered_by.len()),
    }
}

fn format_score(score: Score) -> String {
    let interval = score.interval().map_or_else(String::new, |[low, high]| format!(" (95 %: {low:.1} to {high:.1} %)"));
    format!("{} of {}, {:.1} %{interval}", score.detected, score.valid, score.percent())
}
