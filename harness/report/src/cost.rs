//! What a control step costs, in words; the same in the console and on the page.
//!
//! Neighbours: the numbers and what they are compared with stand in the record.

use crate::shown;
use platebench_verdict::record::CostTrend;

/// Instructions of an STM32F4 in a period of 1 ms at 168 MHz, one a cycle.
const OF_A_MILLISECOND: f64 = 168_000.0;

/// `3 332 worst (dq-pi), 2.0 % of the 168 000 of a 1 ms period`
pub(crate) fn worst(trend: &CostTrend) -> String {
    format!("{} worst ({}), {} of the 168 000 of a 1 ms period", whole(trend.cost.worst), trend.law, share(trend))
}

/// The worst step's part of a period of 1 ms at 168 MHz.
pub(crate) fn share(trend: &CostTrend) -> String {
    format!("{:.1} %", trend.cost.worst / OF_A_MILLISECOND * 100.0)
}

/// `30 % more than 2 563 of build 1a2b3c4d`, where there is a change that is worth a word.
pub(crate) fn change(trend: &CostTrend) -> Option<String> {
    let change = trend.change()?;
    let direction = if change.percent > 0.0 { "more" } else { "less" };
    // Where the run played more than both did, or the mean is what changed, the number that is meant stands before.
    let subject = if change.what == "worst" && change.now == trend.cost.worst {
        String::new()
    } else {
        let trials = shown::count(change.against.trials, "trial");
        format!("{} {} over the {trials} that both played: ", change.what, whole(change.now))
    };
    let build = match &change.against.run {
        Some(run) => format!("build {} (run {run})", short(&change.against.build)),
        None => format!("build {} (the image that comes with the bench)", short(&change.against.build)),
    };
    Some(format!("{subject}{} % {direction} than {} of {build}", shown::percent(change.percent), whole(change.then)))
}

/// The first eight digits of a build's identity.
pub(crate) fn short(build: &str) -> &str {
    build.get(..8).unwrap_or(build)
}

/// To the whole instruction, in groups of three digits.
pub(crate) fn whole(value: f64) -> String {
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
    fn digits_come_in_threes(#[case] value: f64, #[case] expected: &str) {
        assert_eq!(whole(value), expected);
    }

    #[rstest]
    #[case("1a2b3c4d5e6f7a8b", "1a2b3c4d")]
    #[case("1a2b", "1a2b")]
    #[case("", "")]
    fn a_build_is_told_by_eight_digits(#[case] build: &str, #[case] expected: &str) {
        assert_eq!(short(build), expected);
    }
}
