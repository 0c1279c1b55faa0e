use crate::scenario::Scenario;
use platebench_plate::Tier;
use rstest::rstest;
use std::fs;

const PLATE: &str = include_str!("../../../../scenarios/plates/aluminium-198x138.toml");
const STEP: &str = "setpoint_um = 2.0";

/// A scenario of 30 ms: what stands in `[controller]`, in `[profile]` and behind it, and in `[[expect]]`.
fn scenario(plate: &str, controller: &str, profile: &str, expect: &str) -> Scenario {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("plate.toml"), plate).unwrap();
    let path = folder.path().join("s.toml");
    let text = format!(
        "title = \"s\"\nplate = \"plate.toml\"\nduration_ms = 30.0\n[controller]\n{controller}\n[profile]\n{profile}\n[[expect]]\nmetric = {expect}\n"
    );
    fs::write(&path, text).unwrap();
    crate::load(&path, "s.toml").unwrap_or_else(|fault| panic!("{fault}"))
}

#[rstest]
// A tenth of 0.1 of 2 µm, 5 % where it is on one side.
#[case("\"final_amplitude_um\"\nwithin = [1.9, 2.1]", 5e-3)]
#[case("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 1.0", 1e-3)]
#[case("\"static_error_percent\"\nat_most = 0.01", 5e-7)]
#[case("\"static_error_percent\"\nwithin = [11.1, 11.12]", 1e-5)]
// No error lies below 0.
#[case("\"static_error_percent\"\nwithin = [0.0, 0.01]", 5e-7)]
#[case("\"peak_deviation_percent\"\nwithin = [35.0, 45.0]", 5e-3)]
#[case("\"overshoot_percent\"\nat_most = 5.0", 2.5e-4)]
#[case("\"overshoot_percent\"\nat_most = 0.0", 0.0)]
// 0.05 of the time, 0.05 of the setpoint, ln 20.
#[case("\"settling_time_ms\"\nat_most = 2.0", 7.489e-4)]
#[case("\"frequency_error_hz\"\nat_most = 0.1", 5.906e-6)]
#[case("\"quadrature_ratio\"\nat_most = 0.001", 4.995e-6)]
// Kp is 274 Vpp/µm, and twice that is allowed for.
#[case("\"drive_peak_vpp\"\nwithin = [490.0, 600.0]", 4.99e-3)]
#[case("\"saturated_percent\"\nwithin = [40.0, 56.0]", 0.0)]
// What does not look at W leaves the curves in the report.
#[case("\"missed_replies\"\nwithin = [0.0, 0.0]", 5e-3)]
#[case("\"overruns\"\nat_most = 3.0\n[[expect]]\nmetric = \"final_amplitude_um\"\nwithin = [1.0, 3.0]", 5e-2)]
// The tightest counts.
#[case("\"static_error_percent\"\nat_most = 10.0\n[[expect]]\nmetric = \"static_error_percent\"\nat_most = 1.0", 5e-5)]
fn the_budget_is_a_tenth_of_the_tolerance(#[case] expect: &str, #[case] budget: f64) {
    let found = scenario(PLATE, "law = \"dq-pi\"", STEP, expect).model.budget;
    assert!((found - budget).abs() <= 2e-3 * budget, "{found:e}");
}

#[test]
fn who_expects_nothing_gets_the_exact_plate() {
    let mut scenario = scenario(PLATE, "law = \"open-loop\"", STEP, "\"overruns\"\nat_most = 3.0");
    assert_eq!(scenario.tier, Tier::Linear);
    scenario.expectations.clear();
    scenario.choose_model(true);
    assert_eq!((scenario.tier, scenario.model.budget), (Tier::Modal, 0.0));
}

const COARSE: &str = "\"final_amplitude_um\"\nwithin = [0.5, 3.5]";

/// Last that is claimed, first that is not.
#[rstest]
#[case::law("law = \"dq-pi\"", "law = \"deadbeat\"")]
#[case::law_without_loop("law = \"open-loop\"", "law = \"bang-bang\"")]
#[case::no_firmware_of_ours("law = \"dq-pi\"", "law = \"somebody-else's\"")]
#[case::delay("law = \"dq-pi\"", "law = \"dq-pi\"\nloop_delay_ms = 0.001")]
#[case::one_period("law = \"dq-pi-fixed\"\nloop_delay_ms = 0.3", "law = \"dq-pi-fixed\"\nloop_delay_ms = 1.0")]
#[case::unstable("law = \"dq-pi-euler\"", "law = \"dq-pi-euler\"\nloop_delay_ms = 0.9")]
#[case::far_off("law = \"dq-pi\"\nstart_frequency_hz = 32182.0", "law = \"dq-pi\"\nstart_frequency_hz = 32180.0")]
#[case::narrow(
    "law = \"dq-pi\"\nstart_frequency_hz = 32300.0\nfrequency_range_hz = 7.7",
    "law = \"dq-pi\"\nstart_frequency_hz = 32300.0\nfrequency_range_hz = 7.5"
)]
fn a_loop_is_claimed_only_where_it_is_known(#[case] known: &str, #[case] unknown: &str) {
    let bound = |controller| scenario(PLATE, controller, "setpoint_um = 1.0", COARSE).bound(Tier::Envelope, true);
    assert!(bound(known).is_finite(), "{known}");
    assert!(bound(unknown).is_infinite(), "{unknown}");
}

#[rstest]
#[case::finger("finger_force_n = 0.14\nsetpoint_um = 2.0", "finger_force_n = 0.16\nsetpoint_um = 2.0")]
#[case::through_zero(
    "setpoint_um = { linear = [[0.0, 0.5], [20.0, 2.0]] }",
    "setpoint_um = { linear = [[0.0, 0.0], [20.0, 2.0]] }"
)]
#[case::back_to_zero(
    "setpoint_um = { hold = [[0.0, 0.0], [1.0, 2.0], [9.0, 1.0]] }",
    "setpoint_um = { hold = [[0.0, 0.0], [1.0, 2.0], [9.0, 0.0]] }"
)]
#[case::far_apart(
    "setpoint_um = { hold = [[0.0, 0.25], [9.0, 2.0]] }",
    "setpoint_um = { hold = [[0.0, 0.24], [9.0, 2.0]] }"
)]
#[case::saturated("setpoint_um = 2.2", "setpoint_um = 3.3")]
#[case::faults("setpoint_um = 2.0", "setpoint_um = 2.0\n[[fault]]\nkind = \"drop\"\nfrom_ms = 10.0\nuntil_ms = 12.0")]
fn a_loop_is_claimed_only_while_it_decides_nothing(#[case] known: &str, #[case] unknown: &str) {
    let bound = |profile| scenario(PLATE, "law = \"dq-pi\"", profile, COARSE).bound(Tier::Envelope, true);
    assert!(bound(known).is_finite(), "{known}");
    assert!(bound(unknown).is_infinite(), "{unknown}");
}

#[test]
fn nothing_is_claimed_of_a_loop_with_a_line_that_adds_its_own_delay() {
    let mut scenario = scenario(PLATE, "law = \"dq-pi\"", STEP, COARSE);
    assert!(scenario.tier < Tier::Modal && scenario.model.bound <= scenario.model.budget);
    scenario.choose_model(false);
    assert_eq!(scenario.tier, Tier::Modal);
}

#[test]
fn a_demodulator_asks_for_the_carrier_and_a_coarse_scene_does_not() {
    let lockin = PLATE.replacen("[sensor]", "[sensor]\ndemodulator_periods = 1\nconverter_hz = 1e6", 1);
    let tier = |plate: &str, expect| scenario(plate, "law = \"open-loop\"", STEP, expect).tier;
    let fine = "\"final_amplitude_um\"\nwithin = [1.98, 2.02]";
    assert_eq!((tier(PLATE, fine), tier(&lockin, fine)), (Tier::Modal, Tier::Carrier));
    let wide = "\"final_amplitude_um\"\nwithin = [1.2, 2.8]";
    assert_eq!((tier(PLATE, wide), tier(&lockin, wide)), (Tier::Linear, Tier::Linear));
}

#[test]
fn who_names_a_tier_gets_it_and_is_told_what_it_is_worth() {
    let controller = "law = \"dq-pi\"";
    let text = |model: &str| {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("plate.toml"), PLATE).unwrap();
        let path = folder.path().join("s.toml");
        let text = format!(
            "title = \"s\"\nplate = \"plate.toml\"\nmodel = \"{model}\"\nduration_ms = 30.0\n[controller]\n{controller}\n[profile]\n{STEP}\n[[expect]]\nmetric = \"settling_time_ms\"\nat_most = 2.0\n"
        );
        fs::write(&path, text).unwrap();
        crate::load(&path, "s.toml").unwrap()
    };
    let (named, auto) = (text("envelope"), text("auto"));
    assert_eq!((named.tier, auto.tier), (Tier::Envelope, Tier::Modal));
    assert_eq!((named.model.asked, auto.model.asked), (Some(Tier::Envelope), None));
    assert!(named.model.bound > named.model.budget && auto.model.bound < auto.model.budget);
}
