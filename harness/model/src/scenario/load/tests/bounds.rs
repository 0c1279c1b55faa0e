//! Tests that values on a bound are accepted. The snapshots of `rejected` contain values beyond.

use super::{create_folder, load_with_change, load_with_changes, render};
use rstest::rstest;

#[rstest]
#[case("duration_ms = 60.0", "duration_ms = 60")]
#[case("period_ms = 1.0", "period_ms = 0.001")]
#[case("period_ms = 1.0", "period_ms = 60.0")]
#[case("duration_ms = 60.0\ntags = [\"paper\"]\ntrace_step_ms = 0.05", "duration_ms = 1e5\ntrace_step_ms = 0.05")]
#[case("loop_delay_ms = 0.0", "loop_delay_ms = 59.999999")]
#[case("design_delay_ms = 0.0", "design_delay_ms = 0.001")]
#[case("design_delay_ms = 0.0", "design_delay_ms = 1.0")]
#[case("start_frequency_hz = 32220.9", "start_frequency_hz = 16153.9")]
#[case("start_frequency_hz = 32220.9", "start_frequency_hz = 48461.3")]
#[case("frequency_range_hz = 250.0", "frequency_range_hz = 32220.8")]
#[case("expected_exit = 1", "expected_exit = 3")]
#[case("expected_exit = 1", "expected_exit = 5")]
#[case("expected_exit = 1", "timeout_s = 604800")]
#[case("from_ms = 10.0\nuntil_ms = 20.0", "from_ms = 0.0\nuntil_ms = 60.0")]
#[case("from_ms = 10.0\nuntil_ms = 11.0", "from_ms = 59.0\nuntil_ms = 59.000001")]
#[case("every = 10", "every = 1")]
#[case("delay_ms = 0.5", "delay_ms = 100.0")]
#[case("delay_ms = 0.5", "delay_ms = 1e-6")]
#[case("factor = 0.9", "factor = -1.0")]
#[case("factor = 0.9", "factor = 3.4e38")]
#[case("kind = \"disconnect\"", "kind = \"disconnect\"\nuntil_ms = 40.0\nreconfigure = true")]
#[case("expected_exit = 1\n", "")]
#[case("trace_step_ms = 0.05", "trace_step_ms = 3e-5")]
#[case("trace_step_ms = 0.05", "trace_step_ms = 1000.0")]
#[case("[1.0, 2.0]", "[1.0, 1000.0]")]
#[case("[60.0, 2.0]", "[60.0, -297.14]")]
#[case("count = 30\nmax_count = 200", "count = 1\nmax_count = 1")]
#[case("count = 30\nmax_count = 200", "count = 100000")]
#[case("max_count = 200", "max_count = 30")]
#[case("max_count = 200", "max_count = 100000")]
#[case("seed = 7", "seed = 0")]
#[case("seed = 7", "seed = 9223372036854775807")]
#[case("gain_percent = 1.0", "gain_percent = 20.0")]
#[case("gain_percent = 1.0", "gain_percent = 0.0")]
#[case("temperature_k = 4.0", "temperature_k = 20.0")]
#[case("band_percent = 5.0", "band_percent = 99.999")]
#[case("confidence = 0.9", "confidence = 0.5")]
#[case("confidence = 0.9", "confidence = 0.9999999999999999")]
#[case("confidence = 0.9", "over = \"quantile\"\nquantile = 0.000001")]
#[case("confidence = 0.9", "over = \"quantile\"\nquantile = 0.999999")]
#[case("from_ms = 1.0", "from_ms = 59.999999")]
#[case("from_ms = 1.0", "from_ms = 0.0")]
#[case("window_ms = 20.0", "window_ms = 59.0")]
#[case("window_ms = 20.0", "window_ms = [1.0, 60.0]")]
#[case("window_ms = 20.0", "window_ms = [59.999999, 60.0]")]
#[case("within = [0.0, 1.0]", "within = [1.0, 1.0]")]
#[case("at_most = 2.0", "at_most = 0.0")]
#[case("at_most = 2.0", "at_least = 1e-9")]
#[case("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", "\"saturated_percent\"\nat_most = 99.9")]
#[case("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", "\"saturated_percent\"\nat_least = 100.0")]
#[case("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", "\"overruns\"\nat_most = 0.0")]
fn accepts_the_last_good_value(#[case] good: &str, #[case] last_good: &str) {
    if let Err(fault) = load_with_change(good, last_good) {
        panic!("{}", render(&fault));
    }
    let folder = create_folder(&[(good, last_good)]);
    let text = std::fs::read_to_string(folder.path().join("s.toml")).unwrap();
    let document = serde_json::to_value(toml::from_str::<toml::Table>(&text).unwrap()).unwrap();
    if let Err(fault) = jsonschema::validate(crate::scenario::schema::scenario_schema().as_value(), &document) {
        panic!("the schema rejects a good value: {fault}");
    }
}

#[test]
fn accepts_a_trial_of_one_period_and_a_period_of_1_s() {
    let expectation = ("from_ms = 1.0", "from_ms = 0.0");
    let window = ("window_ms = 20.0", "window_ms = 0.5");
    let setpoint = ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "2.0");
    assert!(load_with_changes(&[("duration_ms = 60.0", "duration_ms = 1.0"), expectation, window, setpoint]).is_ok());
    assert!(
        load_with_changes(&[("duration_ms = 60.0", "duration_ms = 1000.0"), ("period_ms = 1.0", "period_ms = 1000.0")])
            .is_ok()
    );
}

#[test]
fn counts_a_row_per_control_instant() {
    let long = |duration: &str| {
        load_with_changes(&[
            ("duration_ms = 60.0", duration),
            ("trace_step_ms = 0.05", "trace_step_ms = 1e6"),
            ("period_ms = 1.0", "period_ms = 0.01"),
        ])
    };
    assert!(long("duration_ms = 20000.0").is_ok());
    let fault = long("duration_ms = 20000.1").unwrap_err();
    assert!(fault.message.contains("2000010 rows, expected at most 2000000"), "{fault}");
    assert_eq!(fault.position(), (4, 15));
}

#[test]
fn a_long_scenario_has_a_row_per_period() {
    let step = |duration: &str| {
        load_with_changes(&[("duration_ms = 60.0", duration), ("trace_step_ms = 0.05\n", "")]).unwrap().trace_step.ms()
    };
    assert_eq!(step("duration_ms = 1000.0"), 0.05);
    assert_eq!(step("duration_ms = 1000.1"), 1.0);
}

#[test]
fn checks_damping_corners_between_forces() {
    let curve = ("[[0.0, 1.0], [1.5, 2.0]]", "[[0.0, 1.0], [0.5, 400.0], [1.0, 2.0], [1.5, 2.0]]");
    let fault = load_with_changes(&[curve]).err().unwrap();
    assert!(fault.message.contains("leave the plate without a resonance"), "{}", render(&fault));
    assert!(load_with_changes(&[curve, ("  30.0, 1.0", "  30.0, 0.3")]).is_ok());
    // With the lightest touch, 0.25 N between two corners, a hot plate has no resonance.
    let light = ("[[0.0, 1.0], [1.5, 2.0]]", "[[0.0, 560.0], [0.5, 2.0], [1.5, 2.0]]");
    let touch = ("20.0, 0.0", "20.0, 0.25");
    assert!(load_with_changes(&[light, touch]).is_ok());
    let fault = load_with_changes(&[light, touch, ("[60.0, 2.0]", "[60.0, 700.0]")]).err().unwrap();
    assert_eq!(fault.position(), (28, 55), "{}", render(&fault));
}

#[rstest]
#[case(
    "time_constant_ms = 1.88",
    "time_constant_ms = 9.852e6",
    "time_constant_ms = 9.853e6",
    "a quality factor of 1.000e9"
)]
#[case("gain_um_per_vpp = 0.00698", "gain_um_per_vpp = 3.4e38", "gain_um_per_vpp = 3.5e38", "single precision")]
#[case("gain_um_per_vpp = 0.00698", "gain_um_per_vpp = 1.2e-38", "gain_um_per_vpp = 1.1e-38", "single precision")]
#[case("limit_vpp = 900.0", "limit_vpp = 3.4e38", "limit_vpp = 3.5e38", "single precision")]
#[case("[[0.0, 1.0], [1.5, 2.0]]", "[[0.0, 1e-6], [1.5, 2.0]]", "[[0.0, 1e-7], [1.5, 2.0]]", "without a resonance")]
#[case(
    "slope_hz_per_k = -9.638",
    "slope_hz_per_k = 1.1e5",
    "slope_hz_per_k = 1.2e5",
    "without a resonance, expected one of at most 2.5e6 Hz"
)]
fn rejects_a_plate_outside_the_numeric_range(
    #[case] plain: &str,
    #[case] good: &str,
    #[case] bad: &str,
    #[case] message: &str,
) {
    let with = |other| {
        load_with_changes(&[
            (plain, other),
            ("temperature_k = 4.0", "temperature_k = 0.0"),
            ("[60.0, 2.0]", "[60.0, 22.0]"),
        ])
    };
    assert!(with(good).is_ok(), "{}", render(&with(good).err().unwrap()));
    let fault = with(bad).err().unwrap();
    assert!(fault.message.contains(message), "{}", render(&fault));
}
