//! Renders the result of an exploration as text.

use crate::explore::exploration::UndecidedScene;
use crate::explore::page::properties;
use crate::explore::report::{ExploreReport, format_value};
use std::fmt::Write as _;

pub fn summary(report: &ExploreReport) -> String {
    let mut text = String::new();
    let _ = write_summary(&mut text, report);
    text
}

fn write_summary(text: &mut String, report: &ExploreReport) -> std::fmt::Result {
    let ExploreReport { scenes, law, seed, .. } = report;
    writeln!(text, "{scenes} scenes of {} for {law}, seed {seed}, {:.1} s", report.envelope, report.elapsed_s)?;
    writeln!(text, "\n{}\n", properties(report).lines().join("\n"))?;
    if report.undecided > 0 {
        writeln!(text, "{} scenes undecided:", report.undecided)?;
        for UndecidedScene { scene, cause } in &report.undecided_scenes {
            writeln!(text, "  scene {scene}: {cause}")?;
        }
    }
    for regression in &report.failed_regressions {
        let properties: Vec<_> = regression.properties.iter().map(|property| property.name()).collect();
        writeln!(
            text,
            "{} (a scenario of an earlier exploration) still violates: {}",
            regression.file,
            properties.join(", ")
        )?;
    }
    for violation in &report.violations {
        let [value, limit] = [violation.minimal_value, violation.minimal_limit].map(|value| format_value(value, 6));
        let difference = violation.rule.clone().unwrap_or_else(|| format!("value {value}, limit {limit}"));
        writeln!(text, "property {} violated: {difference}; minimal scene: {}", violation.property, violation.file)?;
        if !violation.is_reproduced {
            writeln!(text, "  this scene did not fail again with a new controller")?;
        }
    }
    writeln!(text, "{}", report.conclusion())
}
