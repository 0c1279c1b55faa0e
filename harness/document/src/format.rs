//! Formats numbers, durations, counts and signs of verdicts.

use platebench_model::record::Verdict;

/// Text for a missing value.
pub const NOTHING: &str = "–";

pub fn count(number: usize, one: &str) -> String {
    if number == 1 { format!("1 {one}") } else { format!("{number} {one}s") }
}

pub const fn sign(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Pass => "✓",
        Verdict::Fail => "✗",
        Verdict::Inconclusive => "?",
    }
}

/// A number with four significant digits, without trailing zeros.
pub fn number(value: f64) -> String {
    significant_digits(value, 4)
}

/// A dash for a missing value.
pub fn with_decimals(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| NOTHING.to_owned(), |value| format!("{value:.decimals$}"))
}

/// Size of a change in percent, with two significant digits below 10, else three.
pub fn percent(value: f64) -> String {
    significant_digits(value.abs(), if value.abs() < 10.0 { 2 } else { 3 })
}

pub fn duration(ms: f64) -> String {
    match ms / 1e3 {
        seconds if seconds < 1.0 => format!("{ms:.0} ms"),
        seconds if seconds < 60.0 => format!("{seconds:.1} s"),
        seconds => format!("{} min {:.0} s", (seconds / 60.0).floor(), (seconds % 60.0).floor()),
    }
}

pub fn significant_digits(value: f64, significant: i32) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    let magnitude = value.abs().log10().floor() as i32;
    if !(-3..=9).contains(&magnitude) {
        let text = format!("{value:.*e}", usize::try_from(significant - 1).unwrap_or(0));
        return match text.split_once('e') {
            Some((mantissa, exponent)) => format!("{}e{exponent}", trim_zeros(mantissa)),
            None => text,
        };
    }
    let decimals = usize::try_from(significant - 1 - magnitude).unwrap_or(0);
    trim_zeros(&format!("{value:.decimals$}")).to_owned()
}

fn trim_zeros(text: &str) -> &str {
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case(0.0, "0")]
    #[case(2.0, "2")]
    #[case(1.948_71, "1.949")]
    #[case(32_307.61, "32308")]
    #[case(540.0, "540")]
    #[case(-0.001_234_56, "-0.001235")]
    #[case(0.000_012_3, "1.23e-5")]
    #[case(1e-12, "1e-12")]
    fn numbers_are_short(#[case] value: f64, #[case] expected: &str) {
        assert_eq!(number(value), expected);
    }

    #[rstest]
    #[case(0.4, "0 ms")]
    #[case(340.0, "340 ms")]
    #[case(2_500.0, "2.5 s")]
    #[case(725_900.0, "12 min 5 s")]
    fn durations_have_their_unit(#[case] ms: f64, #[case] expected: &str) {
        assert_eq!(duration(ms), expected);
    }
}
