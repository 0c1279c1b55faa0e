//! Describes the timing of a scenario in real time (loop delay against the law's budget, lateness, losses) and the
//! instructions per control step.

use crate::format;
use platebench_model::record::{CostTrend, ScenarioRecord, TimingRecord};

/// States the worst value of each quantity and the sum of each count. `None` in lockstep.
pub(crate) fn summary(scenario: &ScenarioRecord) -> Option<String> {
    let trials: Vec<&TimingRecord> =
        scenario.trials.iter().filter_map(|trial| trial.telemetry.timing.as_deref()).collect();
    let first = trials.first()?;
    let worst = |figure: fn(&TimingRecord) -> f64| trials.iter().map(|timing| figure(timing)).fold(0.0, f64::max);
    let count = |figure: fn(&TimingRecord) -> u64| trials.iter().map(|timing| figure(timing)).sum::<u64>();
    let scale =
        if first.time_scale == 1.0 { String::new() } else { format!(" at a time scale of {}", first.time_scale) };
    let mut parts = vec![format!("real time{scale}, paced by the {}", first.pacing)];
    if trials.iter().any(|timing| timing.loop_delay_us.is_some()) {
        let [typical, longest] = [
            worst(|timing| timing.loop_delay_us.map_or(0.0, |delay| delay.p50)),
            worst(|timing| timing.loop_delay_us.map_or(0.0, |delay| delay.max)),
        ];
        let of_budget = first.loop_delay_budget_us.map_or_else(String::new, |budget| {
            format!(
                ", {:.0} % and {:.0} % of the {budget:.0} µs of the law's budget",
                100.0 * typical / budget,
                100.0 * longest / budget
            )
        });
        parts.push(format!("loop delay {typical:.0} µs median, {longest:.0} µs maximum{of_budget}"));
    }
    parts.push(format!(
        "samples late by {:.0} µs median, {:.0} µs maximum",
        worst(|timing| timing.lateness_us.p50),
        worst(|timing| timing.lateness_us.max)
    ));
    let counts = [
        ("overruns", count(|timing| timing.overruns)),
        ("missed replies", count(|timing| timing.missed_replies)),
        ("lost replies", count(|timing| timing.lost_replies)),
        ("rejected frames", count(|timing| timing.rejected_frames)),
        ("lost rows", count(|timing| timing.lost_rows)),
    ];
    let periods = count(|timing| timing.periods);
    let lost: Vec<String> =
        counts.iter().filter(|(_, count)| *count > 0).map(|(name, count)| format!("{count} {name}")).collect();
    let lost = if lost.is_empty() { "no losses".to_owned() } else { lost.join(", ") };
    parts.push(format!("{lost} in {periods} periods"));
    parts.extend(
        first
            .target_clock_ppm
            .zip(first.target_clock_error_ppm)
            .map(|(ppm, error)| format!("controller's clock {ppm:+.0} ± {error:.0} ppm")),
    );
    let steal_ms: f64 = trials.iter().filter_map(|timing| timing.steal_ms).sum();
    if steal_ms > 0.0 {
        parts.push(format!("the hypervisor took {steal_ms:.0} ms of processor time from this machine"));
    }
    if first.scheduling != "SCHED_FIFO" {
        parts.push(first.scheduling.clone());
    }
    if !trials.iter().all(|timing| timing.safe_confirmed) {
        parts.push("0 V was not confirmed at the end".to_owned());
    }
    Some(parts.join("; "))
}

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
        Some(run) => format!("build {} (run {run})", format::short_build_id(&change.earlier.build)),
        None => format!("build {} ({SHIPPED_IMAGE})", format::short_build_id(&change.earlier.build)),
    };
    Some(format!(
        "{subject}{} % {direction} than {} of {build}",
        format::percent(change.percent),
        format_instructions(change.then)
    ))
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
        assert_eq!(format::short_build_id(build), expected);
    }
}
