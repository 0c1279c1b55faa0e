//! Formats what a record contains (limits, values, reasons, overrides), without layout or markup.

use crate::record_queries::{CauseGroup, NotApplicableGroup};
pub(crate) use platebench_document::format::{count, duration, number, percent, sign, significant_digits};
use platebench_model::metrics::Unit;
use platebench_model::quoted;
use platebench_model::record::{
    ExpectationRecord, Limit, LoopSymptom, Metric, NotApplicable, Reason, RigRecord, RunRecord, ScenarioRecord,
    Statistic, TrialFinding, Verdict,
};
use platebench_verdict::tube::{Exceedance, TubeSignal};

/// Longest list of names in [`tested`].
const MAX_NAMES: usize = 3;

/// Key to sort scenarios: failed ones first.
pub(crate) const fn display_order(verdict: Verdict) -> u8 {
    match verdict {
        Verdict::Fail => 0,
        Verdict::Inconclusive => 1,
        Verdict::Pass => 2,
    }
}

/// One line: firmware, rig, clock, laws, plates and models of the run. Text from outside is quoted.
pub(crate) fn tested(record: &RunRecord) -> String {
    let firmware: Vec<_> = record
        .controllers()
        .into_iter()
        .map(|rig| firmware_of_rig(rig) + if rig.bench_firmware { " (the bench's own firmware)" } else { "" })
        .collect();
    let firmware = distinct(firmware.iter().map(String::as_str)).join(", ");
    let scenarios = || record.scenarios.iter();
    let lists = [
        names("law", scenarios().map(|scenario| scenario.law.as_str())),
        names("plate", scenarios().filter_map(ScenarioRecord::plate)),
        names("model", scenarios().map(|scenario| scenario.model.as_str())),
    ];
    let setting = [format!("rig {}", quoted(&record.rig.name)), format!("clock {}", record.clock)];
    let parts: Vec<_> = [firmware].into_iter().chain(setting).chain(lists.into_iter().flatten()).collect();
    parts.join("; ")
}

/// Different names in the order of the scenarios, or their number.
fn names<'a>(noun: &str, all: impl Iterator<Item = &'a str>) -> Option<String> {
    let different = distinct(all);
    match different.len() {
        0 => None,
        1..=MAX_NAMES => {
            let names: Vec<_> = different.iter().map(|name| quoted(name)).collect();
            Some(format!("{noun}{} {}", if names.len() == 1 { "" } else { "s" }, names.join(", ")))
        }
        several => Some(count(several, noun)),
    }
}

/// Values without repetition, in their order.
pub(crate) fn distinct<'a>(all: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let mut found = Vec::new();
    for value in all {
        if !found.contains(&value) {
            found.push(value);
        }
    }
    found
}

pub(crate) fn firmware_build(record: &RunRecord) -> String {
    firmware_of_rig(&record.rig)
}

fn firmware_of_rig(rig: &RigRecord) -> String {
    let Some(firmware) = &rig.firmware else { return "firmware unknown".to_owned() };
    let is_known = firmware.build.contains(|digit| digit != '0');
    let build = if is_known { short_build_id(&firmware.build) } else { "unknown" };
    format!("{} {}, build {}", quoted(&firmware.name), quoted(&firmware.version), quoted(build))
}

pub(crate) fn short_build_id(build: &str) -> &str {
    build.get(..8).unwrap_or(build)
}

/// Follows the verdict of a run that tests no firmware of the user.
pub(crate) fn bench_firmware_note(record: &RunRecord) -> String {
    let of_bench = record.controllers().into_iter().find(|rig| rig.bench_firmware);
    of_bench.map_or_else(String::new, |rig| {
        format!(" (the bench's own firmware on the rig {}; name yours with --rig)", quoted(&rig.name))
    })
}

/// Settings that the command line or the environment overrides, as `law = dq-pi, trials = 1`.
pub(crate) fn overrides(record: &RunRecord) -> Option<String> {
    let overrides = &record.overrides;
    let changed = [
        ("law", overrides.law.as_deref().map(|law| quoted(law).into_owned())),
        ("model", overrides.model.as_deref().map(|model| quoted(model).into_owned())),
        ("trials", overrides.trials.map(|trials| trials.to_string())),
        ("seed", overrides.seed.map(|seed| seed.to_string())),
        ("timeout", overrides.timeout_s.map(|seconds| format!("{seconds} s"))),
        ("wire-time", overrides.wire_time.then(|| "on".to_owned())),
    ];
    let changed: Vec<_> =
        changed.into_iter().filter_map(|(name, value)| Some(format!("{name} = {}", value?))).collect();
    (!changed.is_empty()).then(|| changed.join(", "))
}

/// A plate at rest keeps every limit on overshoot and drive, so the number of passes is stated too.
pub(crate) fn symptom(scenario: &ScenarioRecord, trial: u32, symptom: LoopSymptom) -> String {
    let passed = scenario.expectations.iter().filter(|found| found.verdict == Verdict::Pass).count();
    let doubt = match symptom {
        LoopSymptom::NoDrive if passed > 0 => {
            format!(" The plate was at rest, so this proves nothing: {}.", count(passed, "passed expectation"))
        }
        _ => String::new(),
    };
    format!("trial {trial}: {symptom}{doubt}")
}

/// `12 expectations, 3 scenarios not played: REASON`.
pub(crate) fn not_applicable_group(group: &NotApplicableGroup<'_>) -> String {
    let unplayed = match group.unplayed {
        0 => String::new(),
        number => format!(", {} not played", count(number, "scenario")),
    };
    format!("{}{unplayed}: {}", count(group.expectations, "expectation"), group.reason)
}

/// Follows the name of a scenario that is not applicable.
pub(crate) fn not_applicable(scenario: &NotApplicable) -> String {
    format!("not applicable: {}", scenario.reason)
}

pub(crate) fn verdict(expectation: &ExpectationRecord) -> String {
    match expectation.cause {
        Some(cause) if expectation.verdict == Verdict::Inconclusive => format!("{}: {cause}", expectation.verdict),
        _ => expectation.verdict.to_string(),
    }
}

/// The value, with enough digits to lie on the correct side of its limit.
pub fn value(expectation: &ExpectationRecord) -> Option<String> {
    let value = expectation.value?;
    let ends = limit_ends(expectation.limit);
    let same_side = |text: &str| {
        let rounded: f64 = text.parse().unwrap_or(f64::NAN);
        ends.iter().all(|end| rounded.partial_cmp(end) == value.partial_cmp(end))
    };
    (4..=12)
        .map(|significant| significant_digits(value, significant))
        .find(|text| same_side(text))
        .or_else(|| Some(number(value)))
}

pub fn limit(expectation: &ExpectationRecord) -> String {
    limit_text(expectation.limit)
}

pub(crate) fn limit_text(limit: Limit) -> String {
    match limit {
        Limit::AtMost(value) => format!("≤ {}", number(value)),
        Limit::AtLeast(value) => format!("≥ {}", number(value)),
        Limit::About(value) => format!("≈ {}", number(value)),
        Limit::Within(low, high) => format!("{} … {}", number(low), number(high)),
    }
}

pub(crate) fn limit_ends(limit: Limit) -> Vec<f64> {
    match limit {
        Limit::AtMost(end) | Limit::AtLeast(end) | Limit::About(end) => vec![end],
        Limit::Within(low, high) => vec![low, high],
    }
}

/// From this number on, windows are counted instead of listed.
const COUNTED_WINDOWS: usize = 4;

/// The judged windows, as `1 … 60 ms`, `1 … 10, 30 … 40 ms` or `12 windows, 1 … 190 ms`.
pub(crate) fn windows(expectation: &ExpectationRecord) -> Option<String> {
    window_list(&expectation.windows_ms)
}

pub(crate) fn in_window(expectation: &ExpectationRecord) -> Option<String> {
    let list = windows(expectation)?;
    Some(if expectation.windows_ms.len() < COUNTED_WINDOWS { format!("window {list}") } else { list })
}

/// Metric with value, unit, limit and window, for a message without a table around it.
pub(crate) fn summary(expectation: &ExpectationRecord) -> String {
    let metric = expectation.metric.name();
    let name = match &expectation.name {
        name if name.starts_with(metric) => name.clone(),
        name => format!("{name} ({metric})"),
    };
    let unit = unit(expectation.metric);
    let with_unit = |text: String| if unit.is_empty() { text } else { format!("{text} {unit}") };
    let value = value(expectation).map_or_else(|| "no value".to_owned(), with_unit);
    let window = in_window(expectation).map_or_else(String::new, |window| format!(", {window}"));
    format!("{name}: {value}, limit {}{window}", with_unit(limit(expectation)))
}

pub(crate) fn window_list(windows_ms: &[[f64; 2]]) -> Option<String> {
    let range = |from: f64, until: f64| format!("{} … {}", number(from), number(until));
    match (windows_ms, windows_ms.len()) {
        ([], _) => None,
        ([[from, _], .., [_, until]], count @ COUNTED_WINDOWS..) => {
            Some(format!("{count} windows, {} ms", range(*from, *until)))
        }
        (few, _) => {
            let few: Vec<String> = few.iter().map(|[from, until]| range(*from, *until)).collect();
            Some(format!("{} ms", few.join(", ")))
        }
    }
}

/// The value, or `never` if the event that the metric times did not happen.
pub(crate) fn value_or_not_reached(expectation: &ExpectationRecord) -> Option<String> {
    let is_time = expectation.metric.spec().unit == Unit::Milliseconds;
    let missing = match &expectation.reason {
        Some(Reason::Trial { finding: TrialFinding::Missing(missing), .. }) => Some(missing),
        _ => None,
    };
    let never = is_time && missing.is_some_and(|missing| missing.is_not_reached());
    value(expectation).or_else(|| never.then(|| "never".to_owned()))
}

/// Size of a group, as `3 scenarios, 5 expectations, 8 trials with one cause`.
pub(crate) fn group_size(group: &CauseGroup<'_>) -> String {
    let sizes = [(Some(group.scenarios().len()), "scenario"), (Some(group.members.len()), "expectation")];
    let sizes = sizes.into_iter().chain([(group.lost_trials(), "trial")]);
    let sizes: Vec<String> = sizes.filter_map(|(size, name)| Some(count(size?, name))).collect();
    format!("{} with one cause", sizes.join(", "))
}

/// The reason without the value and the limit, which the report shows next to it.
pub(crate) fn remaining_reason(expectation: &ExpectationRecord) -> Option<String> {
    match expectation.reason.as_ref()? {
        Reason::Trial { trial, divergence, finding: TrialFinding::Outside { .. }, ended: None, stopped } => {
            let divergence = divergence.map(|divergence| divergence.to_string());
            let stopped = stopped.as_ref().map(|why| format!("the controller stopped: {why}"));
            let parts: Vec<_> = divergence.into_iter().chain(stopped).collect();
            (!parts.is_empty()).then(|| format!("trial {trial}: {}", parts.join("; ")))
        }
        Reason::Trial {
            trial,
            divergence,
            finding: TrialFinding::IntervalOutside { bounds, .. },
            ended: None,
            stopped,
        } => {
            let divergence = divergence.map_or_else(String::new, |divergence| format!("{divergence}: "));
            let stopped = stopped.as_ref().map_or_else(String::new, |why| format!("; the controller stopped: {why}"));
            Some(format!("trial {trial}: {divergence}{bounds}{stopped}"))
        }
        other => Some(other.to_string()),
    }
}

pub(crate) fn statistic(expectation: &ExpectationRecord) -> String {
    let name = match (expectation.statistic, expectation.evidence.quantile) {
        (Statistic::Worst, _) => "worst trial",
        (Statistic::Mean, _) => "mean of trials",
        (Statistic::Deviation, _) => "deviation over trials",
        (Statistic::Quantile, Some(share)) => return format!("{} % quantile", number(share * 100.0)),
        (Statistic::Quantile, None) => "quantile of trials",
    };
    name.to_owned()
}

/// The interval, as `1.9 … 1.96 (95 %)`. The range from best to worst trial has no confidence.
pub(crate) fn interval(expectation: &ExpectationRecord) -> Option<String> {
    let [low, high] = expectation.interval?;
    let confidence = expectation
        .confidence
        .filter(|_| expectation.statistic != Statistic::Worst)
        .map(|confidence| format!(" ({} %)", number(confidence * 100.0)));
    Some(format!("{} … {}{}", number(low), number(high), confidence.unwrap_or_default()))
}

pub(crate) fn evidence(expectation: &ExpectationRecord) -> Option<String> {
    let evidence = &expectation.evidence;
    let look = evidence.look.map(|[number, of]| format!("decided at evaluation {number} of {of}"));
    let parts: Vec<String> = evidence.says.iter().cloned().chain(look).collect();
    (!parts.is_empty()).then(|| parts.join("; "))
}

pub fn exceedance(trial: u32, worst: &Exceedance) -> String {
    format!("trial {trial}: {}", outside_tube(worst))
}

pub(crate) fn outside_tube(worst: &Exceedance) -> String {
    let unit = TubeSignal::from_name(&worst.signal).map_or("", |signal| signal.unit);
    format!(
        "{} is {} {unit} at {} ms, {} {unit} outside ± {} {unit} around {} {unit}",
        worst.signal,
        number(worst.value),
        number(worst.t_ms),
        number(worst.distance),
        number(worst.allowed),
        number(worst.golden)
    )
}

/// Empty without a value, which has no unit.
pub(crate) fn unit_of_value(expectation: &ExpectationRecord) -> &'static str {
    expectation.value.map_or("", |_| unit(expectation.metric))
}

/// Empty for a ratio or a count.
pub const fn unit(metric: Metric) -> &'static str {
    metric.spec().unit.symbol()
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_model::record::{Bounds, Divergence, Evidence, MetricDefinition, MissingValue};
    use rstest::rstest;

    fn failed_settling_time() -> ExpectationRecord {
        ExpectationRecord {
            name: String::new(),
            windows_ms: Vec::new(),
            worst: None,
            metric: Metric::SettlingTime,
            verdict: Verdict::Fail,
            value: Some(2.000_04),
            statistic: Statistic::Worst,
            limit: Limit::AtMost(2.0),
            margin: None,
            bench_error: None,
            interval: None,
            confidence: None,
            cause: None,
            reason: None,
            paper: None,
            requirement: None,
            definition: MetricDefinition::default(),
            evidence: Evidence::default(),
        }
    }

    #[rstest]
    #[case(&[], None)]
    #[case(&[[0.0, 60.0]], Some("0 … 60 ms"))]
    #[case(&[[1.0, 10.0], [10.0, 20.5]], Some("1 … 10, 10 … 20.5 ms"))]
    #[case(&[[1.0, 2.0], [2.0, 3.0], [3.0, 4.0]], Some("1 … 2, 2 … 3, 3 … 4 ms"))]
    #[case(&[[1.0, 2.0], [2.0, 3.0], [3.0, 4.0], [4.0, 9.0]], Some("4 windows, 1 … 9 ms"))]
    fn windows_are_listed_up_to_three(#[case] windows_ms: &[[f64; 2]], #[case] expected: Option<&str>) {
        let expectation = ExpectationRecord { windows_ms: windows_ms.to_vec(), ..failed_settling_time() };
        assert_eq!(windows(&expectation).as_deref(), expected);
        let with_word =
            expected.map(|text| if text.contains("windows") { text.to_owned() } else { format!("window {text}") });
        assert_eq!(in_window(&expectation), with_word);
    }

    #[test]
    fn a_value_never_rounds_onto_its_limit() {
        let mut expectation = failed_settling_time();
        assert_eq!(value(&expectation).unwrap(), "2.00004");
        expectation.value = Some(2.0);
        assert_eq!(value(&expectation).unwrap(), "2");
    }

    const OUTSIDE: TrialFinding = TrialFinding::Outside { value: Some(5.632), limit: Limit::AtMost(2.0) };
    const INTERVAL_OUTSIDE: TrialFinding = TrialFinding::IntervalOutside {
        bounds: Bounds { low: Some(5.6), high: Some(5.632) },
        limit: Limit::AtMost(2.0),
    };
    const DIVERGED: Option<Divergence> = Some(Divergence { at_s: 0.0125, is_non_finite: false });

    #[rstest]
    #[case(OUTSIDE, None, None)]
    #[case(INTERVAL_OUTSIDE, None, Some("trial 1: between 5.6000 and 5.6320"))]
    #[case(OUTSIDE, DIVERGED, Some("trial 1: diverged at t = 12.5 ms"))]
    #[case(TrialFinding::Missing(MissingValue::NeverSettles), None, Some("trial 1: never stays inside the band"))]
    fn the_remaining_reason_omits_value_and_limit(
        #[case] finding: TrialFinding,
        #[case] divergence: Option<Divergence>,
        #[case] expected: Option<&str>,
    ) {
        let reason = Some(Reason::Trial { trial: 1, divergence, finding, ended: None, stopped: None });
        let expectation = ExpectationRecord { reason, ..failed_settling_time() };
        assert_eq!(remaining_reason(&expectation).as_deref(), expected);
    }

    #[rstest]
    #[case(Metric::SettlingTime, "ms")]
    #[case(Metric::StaticError, "%")]
    #[case(Metric::Overruns, "")]
    #[case(Metric::QuadratureRatio, "")]
    fn a_metric_names_its_unit(#[case] metric: Metric, #[case] expected: &str) {
        assert_eq!(unit(metric), expected);
    }
}
