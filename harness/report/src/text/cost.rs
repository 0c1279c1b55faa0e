//! Describes the instructions per control step.

use crate::format;
use platebench_model::record::{CostTrend, ScenarioRecord};

pub(crate) const SHIPPED_IMAGE: &str = "the image that comes with the bench";

/// Formats as `3 332 worst (dq-pi), 2.0 % of a period of 1 ms at 168 MHz`.
pub(crate) fn format_worst(trend: &CostTrend) -> String {
    let worst = format!("{} worst ({})", format_instructions(trend.cost.worst), trend.law);
    let Some(tightest) = trend.tightest else { return worst };
    let share = format!("{:.1} % of a period of {} ms at 168 MHz", tightest.share() * 100.0, tightest.period_ms);
    if tightest.instructions == trend.cost.worst {
        format!("{worst}, {share}")
    } else {
        format!("{worst}; {} are {share}", format_instructions(tightest.instructions))
    }
}

/// Formats as `fast.toml: the longest control step takes 85.2 % of its period of 0.05 ms at one
/// instruction per cycle; a real chip takes longer`.
pub(crate) fn describe_tight_step(scenario: &ScenarioRecord, percent: f64) -> String {
    let period = scenario.period_ms.map_or_else(String::new, |period_ms| format!(" of {period_ms} ms"));
    format!(
        "{}: the longest control step takes {percent:.1} % of its period{period} at one instruction per cycle; a real \
         chip takes longer",
        scenario.file
    )
}

/// Formats as `30 % more than 2 563 of build 1a2b3c4d`. `None` if there is no significant change.
pub(crate) fn describe_change(trend: &CostTrend) -> Option<String> {
    let change = trend.significant_change()?;
    let direction = if change.percent > 0.0 { "more" } else { "less" };
    let subject = if change.statistic == "worst" && change.now == trend.cost.worst {
        String::new()
    } else {
        let trials = format::count(change.earlier.trials, "trial");
        format!("{} {} over the {trials} of both runs: ", change.statistic, format_instructions(change.now))
    };
    let build = match &change.earlier.run {
        Some(run) => format!("build {} (run {run})", short_build_id(&change.earlier.build)),
        None => format!("build {} ({SHIPPED_IMAGE})", short_build_id(&change.earlier.build)),
    };
    Some(format!(
        "{subject}{} % {direction} than {} of {build}",
        format::percent(change.percent),
        format_instructions(change.then)
    ))
}

pub(crate) fn short_build_id(build: &str) -> &str {
    build.get(..8).unwrap_or(build)
}

pub(crate) fn format_instructions(value: f64) -> String {
    let digits = format!("{value:.0}");
    let mut grouped = String::with_capacity(digits.len() + digits.len() / 3);
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            grouped.push(' ');
        }
        grouped.push(digit);
    }
    grouped
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case(0.0, "0")]
    #[case(999.4, "999")]
    #[case(999.5, "1 000")]
    #[case(12_345.0, "12 345")]
    #[case(1_234_567.0, "1 234 567")]
    fn groups_three_digits(#[case] value: f64, #[case] expected: &str) {
        assert_eq!(format_instructions(value), expected);
    }

    #[rstest]
    #[case("1a2b3c4d5e6f7a8b", "1a2b3c4d")]
    #[case("1a2b", "1a2b")]
    #[case("", "")]
    fn shortens_builds_to_eight_digits(#[case] build: &str, #[case] expected: &str) {
        assert_eq!(short_build_id(build), expected);
    }
}
