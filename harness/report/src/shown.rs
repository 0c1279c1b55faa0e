//! Numbers, limits and counts as people read them; the same words in every report.
//!
//! Neighbours: all three reports. No layout and no markup here.

use platebench_verdict::{ExpectationRecord, RunRecord, Verdict};
use serde_json::Value;
use std::fmt;

/// How many ended how.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Counts {
    pub(crate) passed: usize,
    pub(crate) failed: usize,
    pub(crate) inconclusive: usize,
}

impl Counts {
    /// Counts scenarios.
    pub(crate) fn of_scenarios(record: &RunRecord) -> Self {
        record.scenarios.iter().map(|scenario| scenario.verdict).collect()
    }

    /// Counts expectations.
    pub(crate) fn of_expectations(record: &RunRecord) -> Self {
        let expectations = record.scenarios.iter().flat_map(|scenario| &scenario.expectations);
        expectations.map(|expectation| expectation.verdict).collect()
    }

    pub(crate) fn total(self) -> usize {
        self.passed + self.failed + self.inconclusive
    }
}

impl FromIterator<Verdict> for Counts {
    fn from_iter<I: IntoIterator<Item = Verdict>>(verdicts: I) -> Self {
        verdicts.into_iter().fold(Self::default(), |mut counts, verdict| {
            match verdict {
                Verdict::Pass => counts.passed += 1,
                Verdict::Fail => counts.failed += 1,
                Verdict::Inconclusive => counts.inconclusive += 1,
            }
            counts
        })
    }
}

impl fmt::Display for Counts {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} passed, {} failed, {} inconclusive", self.passed, self.failed, self.inconclusive)
    }
}

/// What the command line, or the environment in its place, has changed in the scenarios: `law dq-pi, trials 1`.
pub(crate) fn overrides(record: &RunRecord) -> Option<String> {
    let overrides = &record.overrides;
    let changed = [
        ("law", overrides.law.clone()),
        ("model", overrides.model.clone()),
        ("trials", overrides.trials.map(|trials| trials.to_string())),
        ("seed", overrides.seed.map(|seed| seed.to_string())),
    ];
    let changed: Vec<_> = changed.into_iter().filter_map(|(name, value)| Some(format!("{name} {}", value?))).collect();
    (!changed.is_empty()).then(|| changed.join(", "))
}

/// `1 trial`, `30 trials`.
pub(crate) fn count(number: usize, one: &str) -> String {
    if number == 1 { format!("1 {one}") } else { format!("{number} {one}s") }
}

/// A sign that tells verdicts apart without colour.
pub const fn sign(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Pass => "✓",
        Verdict::Fail => "✗",
        Verdict::Inconclusive => "?",
    }
}

/// The verdict with its cause: `inconclusive: rig`.
pub(crate) fn verdict(expectation: &ExpectationRecord) -> String {
    match expectation.cause {
        Some(cause) if expectation.verdict == Verdict::Inconclusive => format!("{}: {cause}", expectation.verdict),
        _ => expectation.verdict.to_string(),
    }
}

/// A number with four significant digits, without trailing zeros.
pub(crate) fn number(value: f64) -> String {
    digits(value, 4)
}

/// How large a change is, without its sign: two digits where it is small.
pub(crate) fn percent(value: f64) -> String {
    digits(value.abs(), if value.abs() < 10.0 { 2 } else { 3 })
}

fn digits(value: f64, significant: i32) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    let magnitude = value.abs().log10().floor() as i32;
    if !(-3..=9).contains(&magnitude) {
        let text = format!("{value:.*e}", usize::try_from(significant - 1).unwrap_or(0));
        return match text.split_once('e') {
            Some((mantissa, exponent)) => format!("{}e{exponent}", trimmed(mantissa)),
            None => text,
        };
    }
    let decimals = usize::try_from(significant - 1 - magnitude).unwrap_or(0);
    trimmed(&format!("{value:.decimals$}")).to_owned()
}

/// Without zeros at the end of a fraction.
fn trimmed(text: &str) -> &str {
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { text }
}

/// The value that decided, with as many digits as it takes to see on which side of its limit it lies.
pub fn value(expectation: &ExpectationRecord) -> Option<String> {
    let value = expectation.value?;
    let bounds: Vec<f64> = expectation
        .limit
        .values()
        .flat_map(|limit| match limit {
            Value::Array(items) => items.iter().filter_map(Value::as_f64).collect(),
            other => other.as_f64().into_iter().collect::<Vec<_>>(),
        })
        .collect();
    let same_side = |text: &str| {
        let shown: f64 = text.parse().unwrap_or(f64::NAN);
        bounds.iter().all(|bound| shown.partial_cmp(bound) == value.partial_cmp(bound))
    };
    (4..=12).map(|significant| digits(value, significant)).find(|text| same_side(text)).or_else(|| Some(number(value)))
}

/// What the value was held against: `≤ 2`, `≥ 2`, `1 … 2` or `≈ 2`.
pub fn limit(expectation: &ExpectationRecord) -> String {
    limit_in(expectation, number)
}

fn limit_in(expectation: &ExpectationRecord, number: fn(f64) -> String) -> String {
    let said = |value: &Value| match value {
        Value::Array(items) => items
            .iter()
            .map(|item| item.as_f64().map_or_else(|| item.to_string(), number))
            .collect::<Vec<_>>()
            .join(" … "),
        other => other.as_f64().map_or_else(|| other.to_string(), number),
    };
    let parts = expectation.limit.iter().map(|(name, value)| match name.as_str() {
        "at_most" => format!("≤ {}", said(value)),
        "at_least" => format!("≥ {}", said(value)),
        "about" => format!("≈ {}", said(value)),
        "within" => said(value),
        other => format!("{other} {}", said(value)),
    });
    parts.collect::<Vec<_>>().join(", ")
}

/// The value that decided, or in a word that what was timed never came.
pub(crate) fn found(expectation: &ExpectationRecord) -> Option<String> {
    let reason = expectation.reason.as_deref().unwrap_or_default();
    let is_time = expectation.metric.ends_with("_time_ms");
    let never = is_time && NEVER.iter().any(|says| reason.contains(says));
    value(expectation).or_else(|| never.then(|| "never".to_owned()))
}

/// What judging says of a trial in which what was timed never came.
const NEVER: [&str; 2] = ["never stays inside the band", "does not come to rest"];

/// Why it did not pass, as far as the value and the limit beside it do not say it.
pub(crate) fn why(expectation: &ExpectationRecord) -> Option<&str> {
    let reason = expectation.reason.as_deref()?;
    let expected = format!(", expected {}", limit_in(expectation, |value| value.to_string()));
    let Some(measured) = reason.strip_suffix(&expected) else { return Some(reason) };
    let (before, last) = measured.rsplit_once(": ").unwrap_or(("", measured));
    if last.parse::<f64>().is_err() {
        return Some(measured);
    }
    let is_trial = before.strip_prefix("trial ").is_some_and(|number| number.parse::<u32>().is_ok());
    (!before.is_empty() && !is_trial).then_some(before)
}

/// What the measured value is of all trials' values.
pub(crate) fn statistic(expectation: &ExpectationRecord) -> String {
    let said = match (expectation.statistic.as_str(), expectation.evidence.quantile) {
        ("worst", _) => "worst trial",
        ("mean", _) => "mean of trials",
        ("deviation", _) => "deviation over trials",
        ("quantile", Some(share)) => return format!("{} % quantile", number(share * 100.0)),
        (other, _) => other,
    };
    said.to_owned()
}

/// `1.9 … 1.96`, with the confidence of its ends where there is one. What the worst and the best trial came to is no bound of anything.
pub(crate) fn interval(expectation: &ExpectationRecord) -> Option<String> {
    let [low, high] = expectation.interval?;
    let confidence = expectation
        .confidence
        .filter(|_| expectation.statistic != "worst")
        .map(|confidence| format!(" ({} %)", number(confidence * 100.0)));
    Some(format!("{} … {}{}", number(low), number(high), confidence.unwrap_or_default()))
}

/// What the trials show beside the verdict: the sentence of the record, and the look at which it was judged.
pub(crate) fn evidence(expectation: &ExpectationRecord) -> Option<String> {
    let evidence = &expectation.evidence;
    let look = evidence.look.map(|[number, of]| format!("judged at look {number} of {of}"));
    let parts: Vec<String> = evidence.says.iter().cloned().chain(look).collect();
    (!parts.is_empty()).then(|| parts.join("; "))
}

/// The unit that a metric's name ends in; empty where it is a ratio or a count.
pub fn unit(metric: &str) -> &'static str {
    match metric.rsplit_once('_').map(|(_, last)| last) {
        Some("ms") => "ms",
        Some("us") => "µs",
        Some("percent") => "%",
        Some("hz") => "Hz",
        Some("um") => "µm",
        Some("vpp") => "Vpp",
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_verdict::{Definition, Evidence};
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

    fn too_slow() -> ExpectationRecord {
        let limit = serde_json::Map::from_iter([("at_most".to_owned(), Value::from(2.0))]);
        ExpectationRecord {
            metric: "settling_time_ms".to_owned(),
            verdict: Verdict::Fail,
            value: Some(2.000_04),
            statistic: "worst".to_owned(),
            limit,
            interval: None,
            confidence: None,
            cause: None,
            reason: None,
            paper: None,
            requirement: None,
            definition: Definition::default(),
            evidence: Evidence::default(),
        }
    }

    #[test]
    fn a_value_never_rounds_onto_its_limit() {
        let mut expectation = too_slow();
        assert_eq!(value(&expectation).unwrap(), "2.00004");
        expectation.value = Some(2.0);
        assert_eq!(value(&expectation).unwrap(), "2");
    }

    #[rstest]
    #[case("trial 1: 5.6320, expected ≤ 2.00005", None)]
    #[case("5.6320, expected ≤ 2.00005", None)]
    #[case("trial 1: 5.6320, expected ≤ 2", Some("trial 1: 5.6320, expected ≤ 2"))]
    #[case("trial 1: between 5.6000 and 5.6320, expected ≤ 2.00005", Some("trial 1: between 5.6000 and 5.6320"))]
    #[case("trial 1: diverged at t = 12.5 ms: 9.0000, expected ≤ 2.00005", Some("trial 1: diverged at t = 12.5 ms"))]
    #[case("2 of the trials count, expected at least 3", Some("2 of the trials count, expected at least 3"))]
    fn why_leaves_out_what_stands_beside_it(#[case] reason: &str, #[case] expected: Option<&str>) {
        let limit = serde_json::Map::from_iter([("at_most".to_owned(), Value::from(2.000_05))]);
        let reason = Some(reason.to_owned());
        let expectation = ExpectationRecord { limit, reason, ..too_slow() };
        assert_eq!(why(&expectation), expected);
    }

    #[rstest]
    #[case("settling_time_ms", "ms")]
    #[case("static_error_percent", "%")]
    #[case("overruns", "")]
    #[case("quadrature_ratio", "")]
    fn a_metric_names_its_unit(#[case] metric: &str, #[case] expected: &str) {
        assert_eq!(unit(metric), expected);
    }
}
