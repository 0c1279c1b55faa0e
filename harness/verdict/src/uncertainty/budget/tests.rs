use super::*;
use crate::uncertainty::{EvaluationError, TypeA};
use rstest::rstest;

const GOOD: &str = "\
title = \"Lab 2\"
[[instrument]]
name = \"vibrometer\"
serial = \"LV-1\"
calibrated = \"2026-03-01\"
due = \"2027-02-28\"
[[budget]]
quantity = \"static_error_percent\"
[[budget.component]]
kind = \"sensor-gain\"
distribution = \"normal\"
expanded = 0.6
instrument = \"vibrometer\"
source = \"certificate 17, page 2\"
date = \"2026-03-01\"
[[budget.component]]
kind = \"temperature\"
distribution = \"rectangular\"
half_width = 2.0
sensitivity = -0.1
degrees_of_freedom = 12
source = \"thermometer\"
date = \"2026-04-01\"
[[budget.component]]
kind = \"repeatability\"
distribution = \"normal\"
source = \"trials\"
date = \"2026-04-01\"
";

fn load(text: &str) -> Result<Budget, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("budget.toml");
    std::fs::write(&path, text).unwrap();
    let loaded = Budget::load(&path, &["static_error_percent", "resonance_hz"]);
    let place = format!("{}/", folder.path().display());
    loaded.map_err(|faults| {
        faults.iter().map(|fault| fault.to_string().replace(&place, "")).collect::<Vec<_>>().join("\n")
    })
}

#[test]
fn a_budget_states_standard_uncertainties() {
    let budget = load(GOOD).unwrap();
    let quantity = budget.quantity("static_error_percent").unwrap();
    let standards: Vec<_> = quantity.components.iter().map(|component| component.standard).collect();
    assert_eq!(standards, [Some(0.3), Some(2.0 / 3.0_f64.sqrt() * 0.1), None]);
    let observed = TypeA { standard: 0.4, degrees_of_freedom: 9.0 };
    let whole = quantity.combine(1.0, Some(observed), budget.coverage).unwrap();
    assert!((whole.standard - (0.09 + 0.04 / 3.0 + 0.16_f64).sqrt()).abs() < 1e-12);
    assert_eq!(quantity.combine(1.0, None, 0.95), Err(EvaluationError::NoRepeatability));
    assert_eq!(quantity.combine(f64::NAN, Some(observed), 0.95), Err(EvaluationError::NoValue));
}

#[test]
fn a_percentage_counts_from_the_value() {
    let text = GOOD
        .replace("expanded = 0.6", "expanded = 0.6\npercent_of_value = true")
        .replace("half_width = 2.0", "half_width = 0.0");
    let budget = load(&text).unwrap();
    let observed = TypeA { standard: 0.0, degrees_of_freedom: 9.0 };
    let whole = budget.quantities[0].combine(-200.0, Some(observed), 0.95).unwrap();
    assert!((whole.standard - 0.6).abs() < 1e-12, "{whole:?}");
}

#[test]
fn a_calibration_is_valid_through_its_last_day() {
    let budget = load(GOOD).unwrap();
    let expired = |day: &str| budget.expired_on(day.parse().unwrap()).count();
    assert_eq!(["2026-02-28", "2026-03-01", "2027-02-28", "2027-03-01"].map(expired), [1, 0, 0, 1]);
}

#[rstest]
#[case::unknown_key("serial =", "seriel =", "budget.toml:4:1")]
#[case::no_serial("\"LV-1\"", "\" \"", "budget.toml:4:10: `serial`: empty, expected a text")]
#[case::date("2026-03-01", "1.3.2026", "budget.toml:5:14: `calibrated`: `1.3.2026`, expected a date")]
#[case::due("2027-02-28", "2025-02-28", "budget.toml:6:7: `due`: 2025-02-28 is before the calibration")]
#[case::quantity(
    "\"static_error_percent\"",
    "\"static_error\"",
    "budget.toml:8:12: `quantity`: `static_error`, expected one of"
)]
#[case::instrument("instrument = \"vibrometer\"", "instrument = \"laser\"", "no [[instrument]] with the name `laser`")]
#[case::both("expanded = 0.6", "expanded = 0.6\nstandard = 0.3", "expected exactly one of")]
#[case::none("expanded = 0.6\n", "", "expected exactly one of")]
#[case::normal_width("expanded = 0.6", "half_width = 0.6", "a normal distribution has no half width")]
#[case::wide_normal("half_width = 2.0", "expanded = 2.0", "only for a normal distribution")]
#[case::negative("expanded = 0.6", "expanded = -0.6", "budget.toml:12:12: `expanded`: -0.6, expected 0 or more")]
#[case::sensitivity("-0.1", "0.0", "expected a finite number other than 0")]
#[case::freedom("= 12", "= 0.5", "0.5, expected 1 to 1e9")]
#[case::factor("half_width = 2.0", "half_width = 2.0\ncoverage_factor = 2.0", "belongs to `expanded`")]
#[case::distribution("\"rectangular\"", "\"round\"", "budget.toml:18:16")]
#[case::coverage("[[instrument]]", "coverage_percent = 100.0\n[[instrument]]", "expected 50 to 99.9")]
#[case::twice(
    "[[budget]]",
    "[[instrument]]\nname = \"vibrometer\"\nserial = \"2\"\ncalibrated = \"2026-03-01\"\n\
     due = \"2026-03-01\"\n[[budget]]",
    "two instruments have the name `vibrometer`"
)]
fn an_invalid_budget_is_reported_with_its_line(#[case] good: &str, #[case] bad: &str, #[case] message: &str) {
    assert!(GOOD.contains(good));
    let error = load(&GOOD.replacen(good, bad, 1)).unwrap_err();
    assert!(error.contains(message), "{error}");
}
