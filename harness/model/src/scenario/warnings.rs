//! Warns of implausible plates, of profiles that change only after the end, and of disturbances that
//! no expectation judges.

use crate::metrics::{Metric, Subject};
use crate::scenario::definition::Scenario;
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::window::{ChangingProfile, ProfileChanges, Window};
use platebench_plate::{Profile, Time};

/// Returns the warnings of scenarios, each once. If the file has a `[matrix]`, the message names the
/// cases.
pub fn scenario_warnings(scenarios: &[Scenario]) -> Vec<Diagnostic> {
    let mut warnings: Vec<(Diagnostic, Vec<&str>)> = Vec::new();
    for scenario in scenarios {
        let found = [plate_warnings(scenario), changes_after_the_end(scenario), unjudged_changes(scenario)];
        for warning in found.into_iter().flatten().chain(unreachable_setpoint(scenario)) {
            let case = scenario.case.as_deref();
            match warnings.iter_mut().find(|(known, _)| *known == warning) {
                Some((_, cases)) => cases.extend(case),
                None => warnings.push((warning, case.into_iter().collect())),
            }
        }
    }
    let with_cases = |(mut warning, cases): (Diagnostic, Vec<&str>)| {
        let list = cases.iter().take(MAX_LISTED).copied().collect::<Vec<_>>().join(", ");
        let suffix = match cases.len() {
            0 => String::new(),
            1 => format!(" (case {list})"),
            count => format!(" ({count} cases: {list}{})", and_more(count)),
        };
        warning.message.push_str(&suffix);
        warning
    };
    warnings.into_iter().map(with_cases).collect()
}

/// Warns of implausible values of the plate, and of a force that changes nothing.
pub fn plate_warnings(scenario: &Scenario) -> Vec<Diagnostic> {
    let at = |key: &'static str| move |value: platebench_plate::ImplausibleValue| (key, value);
    let design = scenario.controller.design_plate.iter().flat_map(platebench_plate::Plate::implausible_values);
    let plates = scenario.plate.implausible_values().into_iter().map(at("plate"));
    let plates = plates.chain(design.map(at("controller.design_plate")));
    let mut warnings: Vec<Diagnostic> = plates
        .map(|(key, value)| scenario.diagnostic(key, format!("`{}` of the plate file: {value}", value.range.key)))
        .collect();
    if scenario.conditions.finger_force_n.range().1 > 0.0 && !scenario.plate.depends_on_force() {
        let message = "the plate file has no [finger], so this force changes nothing";
        warnings.push(scenario.diagnostic("profile.finger_force_n", message));
    }
    warnings
}

/// Warns of a setpoint that needs more than the amplifier's limit at resonance, without a finger:
/// W/K1. A scenario that expects a saturated drive is meant so.
fn unreachable_setpoint(scenario: &Scenario) -> Option<Diagnostic> {
    let (_, highest_um) = scenario.setpoint.range();
    let (needed_vpp, limit_vpp) = (highest_um / scenario.plate.gain, scenario.plate.drive_limit_vpp);
    (needed_vpp > limit_vpp && !scenario.expects(Metric::Saturated)).then(|| {
        let message = format!(
            "{highest_um} µm needs {needed_vpp:.0} Vpp at resonance without a finger, the limit of the plate file is \
             {limit_vpp:.0} Vpp; lower the setpoint, or expect it with {}",
            Metric::Saturated
        );
        scenario.diagnostic("profile.setpoint_um", message)
    })
}

/// Warns of a profile whose changes are all at or after the end of the trial.
fn changes_after_the_end(scenario: &Scenario) -> Vec<Diagnostic> {
    let conditions = &scenario.conditions;
    let profiles = [
        ("profile.setpoint_um", &scenario.setpoint),
        ("profile.finger_force_n", &conditions.finger_force_n),
        ("profile.temperature_offset_k", &conditions.temperature_offset_k),
    ];
    let end = scenario.duration;
    let warning = |(key, profile): (&str, &Profile)| {
        let first = match profile {
            Profile::Hold(points) => points.get(1),
            Profile::Linear(points) if points.len() > 1 => points.first(),
            Profile::Linear(_) | Profile::Sine { .. } => None,
        };
        let (time, _) = first.filter(|(time, _)| *time >= end)?;
        let message = format!("the profile changes at {time} for the first time, the trial ends at {end}");
        Some(scenario.diagnostic(key, message))
    };
    profiles.into_iter().filter_map(warning).collect()
}

/// A message lists this many changes or cases and counts the others.
const MAX_LISTED: usize = 5;

fn and_more(count: usize) -> String {
    match count.saturating_sub(MAX_LISTED) {
        0 => String::new(),
        more => format!(" and {more} more"),
    }
}

/// Warns if force or temperature changes outside the windows of all expectations about the plate. The
/// comparison with the reference judges each command, so it judges each change.
fn unjudged_changes(scenario: &Scenario) -> Vec<Diagnostic> {
    let conditions = &scenario.conditions;
    let changes = ProfileChanges::new(
        &scenario.setpoint,
        &conditions.finger_force_n,
        &conditions.temperature_offset_k,
        scenario.duration,
    );
    let judged = judged_intervals(scenario);
    let is_judged = |time: &Time| {
        let passed = judged.partition_point(|window| window.from <= *time);
        passed.checked_sub(1).and_then(|last| judged.get(last)).is_some_and(|window| window.contains(*time))
    };
    let profiles = [
        (ChangingProfile::Force, "profile.finger_force_n"),
        (ChangingProfile::Temperature, "profile.temperature_offset_k"),
    ];
    let warning = |(profile, key): (ChangingProfile, &str)| {
        let missed: Vec<&Time> = changes.starts(profile).iter().filter(|time| !is_judged(time)).collect();
        let times: Vec<String> = missed.iter().take(MAX_LISTED).map(ToString::to_string).collect();
        let more = and_more(missed.len());
        (!missed.is_empty()).then(|| {
            let message = format!(
                "no expectation judges the change of the {} at {}{more}; add `after = \"{0}\"` or `from_ms` to one",
                profile.name(),
                times.join(", "),
            );
            scenario.diagnostic(key, message)
        })
    };
    profiles.into_iter().filter_map(warning).collect()
}

fn judged_intervals(scenario: &Scenario) -> Vec<Window> {
    let judges_changes =
        |metric: Metric| metric.spec().subject == Subject::Plate || metric == Metric::ReferenceDifference;
    let plate = scenario.expectations.iter().filter(|expectation| judges_changes(expectation.metric));
    let mut windows: Vec<Window> = plate.flat_map(|expectation| expectation.windows.iter().copied()).collect();
    windows.sort_unstable_by_key(|window| window.from);
    let mut union: Vec<Window> = Vec::new();
    for window in windows {
        match union.last_mut() {
            Some(last) if window.from <= last.to => last.to = last.to.max(window.to),
            _ => union.push(window),
        }
    }
    union
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warns_of_an_impossible_gain_and_an_ignored_force() {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios");
        let paper = std::fs::read_to_string(root.join("plates/aluminium-198x138.toml")).unwrap();
        let scenario = "title = \"a\"\nplate = \"plate.toml\"\nduration_ms = 60.0\n[profile]\nsetpoint_um = 2.0\n\
                        finger_force_n = 1.0\n[[expect]]\nmetric = \"static_error_percent\"\nat_most = 1.0\n";
        let messages = |plate: &str| -> Vec<String> {
            let folder = tempfile::tempdir().unwrap();
            std::fs::write(folder.path().join("plate.toml"), plate).unwrap();
            let path = folder.path().join("s.toml");
            std::fs::write(&path, scenario).unwrap();
            plate_warnings(&crate::scenario::load(&path, "s.toml").unwrap())
                .into_iter()
                .map(|warning| warning.message)
                .collect()
        };
        assert_eq!(messages(&paper), Vec::<String>::new());
        let nm = paper.replacen("gain_um_per_vpp = 0.00698", "gain_um_per_vpp = 6.98", 1);
        assert!(messages(&nm)[0].starts_with("`mode.gain_um_per_vpp` of the plate file: gain K1 of 6.98 µm/Vpp"));
        let start = paper.find("[finger]").unwrap();
        let end = start + paper[start..].find("[drive]").unwrap();
        let without = format!("{}{}", &paper[..start], &paper[end..]);
        let ignored = "`finger_force_n`: the plate file has no [finger], so this force changes nothing";
        assert_eq!(messages(&without), [ignored]);
    }
}

#[cfg(test)]
mod profile_tests {
    use super::*;
    use rstest::rstest;

    const PLATE: &str = include_str!("../../../../scenarios/plates/aluminium-198x138.toml");

    fn scenario_with(force: &str, expectation: &str) -> Scenario {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("plate.toml"), PLATE).unwrap();
        let path = folder.path().join("s.toml");
        let text = format!(
            "title = \"s\"\nplate = \"plate.toml\"\nduration_ms = 60.0\n[profile]\nsetpoint_um = 2.0\n\
             finger_force_n = {force}\n[[expect]]\nmetric = {expectation}\nat_most = 2.0\n"
        );
        std::fs::write(&path, text).unwrap();
        crate::scenario::load(&path, "s.toml").unwrap()
    }

    #[rstest]
    #[case::square("{ square = { low = 1.0, high = 2.0, period_ms = 9.0, from_ms = 100.0 } }", "100 ms")]
    #[case::repeat("{ repeat = { period_ms = 9.0, from_ms = 70.0, hold = [[0.0, 1.0], [1.0, 2.0]] } }", "70 ms")]
    #[case::hold("{ hold = [[0.0, 1.0], [60.0, 2.0]] }", "60 ms")]
    #[case::linear("{ linear = [[60.0, 1.0], [61.0, 2.0]] }", "60 ms")]
    #[case::one_point("{ linear = [[60.0, 1.0]] }", "")]
    #[case::slope("{ linear = [[0.0, 1.0], [61.0, 2.0]] }", "")]
    #[case::in_time("{ square = { low = 1.0, high = 2.0, period_ms = 90.0, from_ms = 10.0 } }", "")]
    fn warns_of_a_profile_that_changes_after_the_end(#[case] force: &str, #[case] time: &str) {
        let warnings = changes_after_the_end(&scenario_with(force, "\"overruns\""));
        let messages: Vec<_> = warnings.iter().map(|warning| warning.message.as_str()).collect();
        let message = "`finger_force_n`: the profile changes at TIME for the first time, the trial ends at 60 ms";
        let expected = [message.replace("TIME", time)];
        assert_eq!(messages, if time.is_empty() { &[][..] } else { &expected[..] });
    }

    #[rstest]
    #[case::covered("\"peak_deviation_percent\"\nfrom_ms = 10.0", "")]
    #[case::starts_later(
        "\"peak_deviation_percent\"\nfrom_ms = 11.0",
        "`finger_force_n`: no expectation judges the change of the force at 10 ms;"
    )]
    #[case::ends_before(
        "\"peak_deviation_percent\"\nuntil_ms = 20.0",
        "`finger_force_n`: no expectation judges the change of the force at 20 ms;"
    )]
    #[case::steady_state_only(
        "\"static_error_percent\"",
        "`finger_force_n`: no expectation judges the change of the force at 10 ms, 20 ms;"
    )]
    #[case::each_command("\"reference_difference_percent\"", "")]
    #[case::not_about_the_plate(
        "\"overruns\"",
        "`finger_force_n`: no expectation judges the change of the force at 10 ms, 20 ms;"
    )]
    #[case::reported_for_the_whole_trial(
        "\"loop_delay_us\"",
        "`finger_force_n`: no expectation judges the change of the force at 10 ms, 20 ms;"
    )]
    fn warns_of_a_disturbance_outside_all_windows(#[case] expectation: &str, #[case] message: &str) {
        let force = "{ hold = [[0.0, 0.0], [10.0, 1.0], [20.0, 0.0]] }";
        let warnings = unjudged_changes(&scenario_with(force, expectation));
        let messages: Vec<_> = warnings.iter().map(|warning| warning.message.as_str()).collect();
        match message {
            "" => assert!(messages.is_empty(), "{messages:?}"),
            start => assert!(matches!(messages[..], [only] if only.starts_with(start)), "{messages:?}"),
        }
    }

    #[test]
    fn a_warning_of_several_cases_is_one_warning() {
        let force = "{ hold = [[0.0, 0.0], [10.0, 1.0]] }";
        let case = |name: &str| Scenario { case: Some(name.to_owned()), ..scenario_with(force, "\"overruns\"") };
        let messages = |cases: &[Scenario]| -> Vec<String> {
            scenario_warnings(cases).into_iter().map(|warning| warning.message).collect()
        };
        let first = case("a");
        let of_the_same_file = |name: &str| Scenario { inputs: first.inputs.clone(), ..case(name) };
        let names = ["b", "c", "d", "e", "f"];
        let all: Vec<_> = std::iter::once(first.clone()).chain(names.map(of_the_same_file)).collect();
        let text = "`finger_force_n`: no expectation judges the change of the force at 10 ms; add `after = \"force\"` or \
                    `from_ms` to one";
        assert_eq!(messages(&[Scenario { case: None, ..first.clone() }]), [text]);
        assert_eq!(messages(&all[..1]), [format!("{text} (case a)")]);
        assert_eq!(messages(&all[..5]), [format!("{text} (5 cases: a, b, c, d, e)")]);
        assert_eq!(messages(&all), [format!("{text} (6 cases: a, b, c, d, e and 1 more)")]);
        let judging = scenario_with(force, "\"peak_deviation_percent\"\nafter = \"force\"");
        let judged = Scenario { expectations: judging.expectations, ..first };
        assert_eq!(messages(&[judged, all[1].clone()]), [format!("{text} (case b)")]);
    }
}
