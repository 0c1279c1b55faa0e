use crate::scenario::definition::Scenario;
use crate::scenario::{Diagnostic, load};
use rstest::rstest;

const PLATE: &str = include_str!("../../../../../../scenarios/plates/aluminium-198x138.toml");

fn scenario_text(expectations: &str) -> String {
    format!(
        "title = \"s\"\nplate = \"plate.toml\"\nduration_ms = 60.0\n[profile]\n\
         setpoint_um = {{ hold = [[0.0, 0.0], [5.0, 2.0], [30.0, 1.0], [50.0, 0.0]] }}\n\
         finger_force_n = {{ hold = [[0.0, 0.0], [10.0, 1.0], [20.0, 2.0], [40.0, 0.0]] }}\n\
         temperature_offset_k = {{ linear = [[0.0, 0.0], [34.0, 0.0], [36.0, 1.0]] }}\n{expectations}"
    )
}

fn load_text(text: &str) -> Result<Scenario, Diagnostic> {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("plate.toml"), PLATE).unwrap();
    let path = folder.path().join("s.toml");
    std::fs::write(&path, text).unwrap();
    load(&path, "s.toml")
}

fn load_expectation(expectation: &str) -> Result<Scenario, Diagnostic> {
    load_text(&scenario_text(&format!("[[expect]]\nmetric = {expectation}")))
}

#[rstest]
#[case("\"settling_time_ms\"\nat_most = 2.0", &[(5.0, 30.0)])]
#[case("\"settling_time_ms\"\nat_most = 2.0\nfrom_ms = 31.0", &[(30.0, 50.0)])]
#[case("\"settling_time_ms\"\nat_most = 2.0\nuntil_ms = 9.0", &[(5.0, 9.0)])]
#[case("\"settling_time_ms\"\nat_most = 2.0\nafter = \"setpoint\"", &[(5.0, 10.0), (30.0, 34.0)])]
#[case("\"peak_deviation_percent\"\nat_most = 2.0\nfrom_ms = 10.0", &[(10.0, 60.0)])]
#[case("\"peak_deviation_percent\"\nat_most = 2.0\nuntil_ms = 10.0", &[(0.0, 10.0)])]
#[case("\"recovery_time_ms\"\nat_most = 2.0\nafter = \"force\"", &[(10.0, 20.0), (20.0, 30.0), (40.0, 50.0)])]
#[case("\"recovery_time_ms\"\nat_most = 2.0\nafter = \"temperature\"", &[(34.0, 40.0)])]
#[case("\"static_error_percent\"\nat_most = 2.0\nwindow_ms = [20.0, 30.0]", &[(20.0, 30.0)])]
#[case("\"static_error_percent\"\nat_most = 2.0\nfrom_ms = 20.0\nuntil_ms = 30.0", &[(20.0, 30.0)])]
// A mean is judged in the last third of each window. Windows with a setpoint of 0 are omitted,
// because a relative error needs a setpoint.
#[case("\"static_error_percent\"\nat_most = 2.0\nafter = \"force\"",
    &[(16.666_666, 20.0), (26.666_666, 30.0), (46.666_666, 50.0)])]
#[case("\"ripple_percent\"\nat_most = 2.0\nafter = \"setpoint\"", &[(8.333_332, 10.0), (32.666_666, 34.0)])]
#[case("\"ripple_um\"\nat_most = 2.0\nwindow_ms = 5.0", &[(55.0, 60.0)])]
#[case("\"rest_drive_vpp\"\nat_most = 0.0", &[(1.0, 5.0), (51.0, 60.0)])]
#[case("\"rest_drive_vpp\"\nat_most = 0.0\nuntil_ms = 10.0", &[(1.0, 5.0)])]
#[case("\"final_amplitude_um\"\nat_most = 2.0\nuntil_ms = 30.0", &[(0.0, 30.0)])]
#[case("\"drive_peak_vpp\"\nat_most = 2.0", &[(0.0, 60.0)])]
fn judges_an_expectation_in_its_windows(#[case] expectation: &str, #[case] windows_ms: &[(f64, f64)]) {
    let scenario = load_expectation(expectation).unwrap_or_else(|error| panic!("{error}"));
    let windows: Vec<_> =
        scenario.expectations[0].windows.iter().map(|window| (window.from.ms(), window.to.ms())).collect();
    assert_eq!(windows, windows_ms);
}

#[rstest]
#[case::steps("hold = [[0.0, 0.0], [5.0, 0.0], [10.0, 1.0], [50.0, 0.0]]", &[(1.0, 10.0), (51.0, 60.0)])]
#[case::lines("linear = [[3.0, 0.0], [5.0, 0.0], [6.0, 2.0], [30.0, 0.0], [40.0, 0.0], [41.0, 1.0], [58.0, 0.0]]",
    &[(1.0, 5.0), (31.0, 40.0), (59.0, 60.0)])]
fn judges_the_rests_of_a_profile(#[case] profile: &str, #[case] windows_ms: &[(f64, f64)]) {
    let setpoint = "hold = [[0.0, 0.0], [5.0, 2.0], [30.0, 1.0], [50.0, 0.0]]";
    let text = scenario_text("[[expect]]\nmetric = \"rest_drive_vpp\"\nat_most = 0.0").replace(setpoint, profile);
    let scenario = load_text(&text).unwrap_or_else(|error| panic!("{error}"));
    let windows: Vec<_> =
        scenario.expectations[0].windows.iter().map(|window| (window.from.ms(), window.to.ms())).collect();
    assert_eq!(windows, windows_ms);
}

#[rstest]
#[case::outside_the_trial(
    "\"peak_deviation_percent\"\nat_most = 2.0\nfrom_ms = 60.0",
    "from_ms",
    "60 ms, expected before"
)]
#[case::end_outside(
    "\"peak_deviation_percent\"\nat_most = 2.0\nuntil_ms = 60.1",
    "until_ms",
    "60.1 ms, expected after 0 ms"
)]
#[case::empty(
    "\"peak_deviation_percent\"\nat_most = 2.0\nfrom_ms = 9.0\nuntil_ms = 9.0",
    "until_ms",
    "expected after 9 ms"
)]
#[case::before_the_step(
    "\"settling_time_ms\"\nat_most = 2.0\nuntil_ms = 5.0",
    "until_ms",
    "expected after the setpoint step at 5 ms"
)]
#[case::missing("\"peak_deviation_percent\"\nat_most = 2.0", "metric", "without a window")]
#[case::missing("\"recovery_time_ms\"\nat_most = 2.0", "metric", "without a window")]
#[case::after_and_from(
    "\"recovery_time_ms\"\nat_most = 2.0\nafter = \"force\"\nfrom_ms = 1.0",
    "after",
    "only one of both"
)]
#[case::window_and_until(
    "\"static_error_percent\"\nat_most = 2.0\nwindow_ms = 1.0\nuntil_ms = 9.0",
    "window_ms",
    "only one of both"
)]
#[case::misspelt("\"recovery_time_ms\"\nat_most = 2.0\nafter = \"finger\"", "after", "unknown profile `finger`")]
#[case::other_profile(
    "\"settling_time_ms\"\nat_most = 2.0\nafter = \"force\"",
    "after",
    "does not apply to settling_time_ms"
)]
#[case::name_of_two_lines("\"overruns\"\nat_most = 2.0\nname = \"two\\nlines\"", "name", "expected one line of text")]
#[case::moving_setpoint("\"static_error_percent\"\nat_most = 2.0\nfrom_ms = 20.0", "from_ms", "the setpoint changes")]
#[case::never_at_rest("\"rest_drive_vpp\"\nat_most = 2.0\nfrom_ms = 5.0\nuntil_ms = 51.0", "metric", "a longer time")]
fn refuses_a_window_without_anything_to_judge(#[case] expectation: &str, #[case] key: &str, #[case] message: &str) {
    let error = load_expectation(expectation).unwrap_err();
    assert!(error.message.contains(message), "{error}");
    let line = error.render(false);
    assert!(line.contains(&format!("{key} = ")), "{line}");
}

#[test]
fn refuses_changes_of_a_constant_profile() {
    let text = scenario_text("[[expect]]\nmetric = \"recovery_time_ms\"\nat_most = 2.0\nafter = \"force\"");
    let constant = text.replace("{ hold = [[0.0, 0.0], [10.0, 1.0], [20.0, 2.0], [40.0, 0.0]] }", "1.0");
    let error = load_text(&constant).unwrap_err();
    assert!(error.message.contains("the force never changes in the trial"), "{error}");
}

#[test]
fn expectations_have_unique_names() {
    let settling = "[[expect]]\nmetric = \"settling_time_ms\"\nat_most = 2.0\n";
    let named = |name: &str| format!("{settling}name = \"{name}\"\n");
    let load_all = |expectations: &[String]| load_text(&scenario_text(&expectations.concat()));
    let scenario = load_all(&[settling.to_owned(), named("first tap"), settling.to_owned()]).unwrap();
    let names: Vec<_> = scenario.expectations.iter().map(|expectation| expectation.name.as_str()).collect();
    assert_eq!(names, ["settling_time_ms", "first tap", "settling_time_ms 2"]);
    for twice in ["a", "settling_time_ms"] {
        let error = load_all(&[named("a"), settling.to_owned(), named(twice)]).unwrap_err();
        assert!(error.message.contains(&format!("has the name `{twice}`")), "{error}");
        assert_eq!(error.position().0, scenario_text("").lines().count() + 11, "{error}");
    }
}

#[test]
fn refuses_more_than_two_thousand_expectations() {
    let expectations = |count: usize| scenario_text(&"[[expect]]\nmetric = \"overruns\"\nat_most = 0\n".repeat(count));
    assert_eq!(load_text(&expectations(2_000)).unwrap().expectations.len(), 2_000);
    let error = load_text(&expectations(2_001)).unwrap_err();
    assert!(error.message.contains("2001 [[expect]], expected at most 2000"), "{error}");
}

#[test]
fn refuses_a_million_points_in_toml_and_names_the_csv_file() {
    let points = (0..1_000_000).map(|ms| format!("[{ms}.0, 1.0]")).collect::<Vec<_>>().join(",");
    let text = scenario_text("")
        .replace("{ linear = [[0.0, 0.0], [34.0, 0.0], [36.0, 1.0]] }", &format!("{{ hold = [{points}] }}"));
    let error = load_text(&text).unwrap_err();
    assert!(error.message.contains("larger than 4 MiB; write the points of a profile to a CSV file"), "{error}");
}
