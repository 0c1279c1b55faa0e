//! The ends of what a scenario may ask for: whole runs whose files hold numbers only, and pointed refusals beyond.

use crate::test_folder::{TestFolder, exit_code, run_bench, workspace_root};
use platebench_record::RunRecord;
use platebench_runner::rejudge;
use rstest::rstest;
use std::fs;
use std::path::Path;

/// A scenario of 60 ms unless `head` says otherwise, with the metrics that divide by something.
fn scenario_text(head: &str, controller: &str) -> String {
    let duration = if head.contains("duration_ms") { "" } else { "duration_ms = 60.0\n" };
    let metrics =
        ["settling_time_ms", "overshoot_percent", "quadrature_ratio", "frequency_error_hz", "final_amplitude_um"];
    let expect = metrics.map(|metric| format!("[[expect]]\nmetric = \"{metric}\"\nat_most = 1.0\n")).concat();
    format!(
        "title = \"Extreme\"\nplate = \"plates/plate.toml\"\n{duration}{head}\n[controller]\n{controller}\n[profile]\nsetpoint_um = 2.0\n\
         [[expect]]\nmetric = \"static_error_percent\"\nat_most = 1.0\n{expect}"
    )
}

/// The paper's plate with one line changed.
fn changed_plate(from: &str, to: &str) -> String {
    let text = fs::read_to_string(workspace_root().join("scenarios/plates/aluminium-198x138.toml")).unwrap();
    assert!(text.contains(from), "{from}");
    text.replace(from, to)
}

/// Every file that the run wrote; what words mean in a style sheet or a script is no number of the run's.
fn assert_no_nan_in_files(folder: &Path) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            assert_no_nan_in_files(&path);
            continue;
        }
        let mut text = fs::read_to_string(&path).unwrap().to_lowercase();
        for element in ["script", "style"] {
            let (open, close) = (format!("<{element}"), format!("</{element}>"));
            while let Some(start) = text.find(&open) {
                let end = text[start..].find(&close).map_or(text.len(), |length| start + length + close.len());
                text.replace_range(start..end, "");
            }
        }
        let none = text.split(|c: char| !c.is_alphanumeric()).find(|word| ["nan", "inf", "infinity"].contains(word));
        assert_eq!(none, None, "{}", path.display());
    }
}

const UNCHANGED: (&str, &str) = ("", "");
const LONG_RINGING: (&str, &str) = ("time_constant_ms = 1.88", "time_constant_ms = 9852.6");
const RINGING_FOR_HOURS: (&str, &str) = ("time_constant_ms = 1.88", "time_constant_ms = 9.852e6");

#[rstest]
#[case::far_below_resonance(
    UNCHANGED,
    "",
    "start_frequency_hz = 16153.8\nfrequency_range_hz = 16000.0\nfrequency_slew_hz = 1e9"
)]
#[case::far_above_resonance(
    UNCHANGED,
    "",
    "start_frequency_hz = 48461.0\nfrequency_range_hz = 48000.0\nfrequency_slew_hz = 1e9"
)]
#[case::quality_of_a_million(LONG_RINGING, "", "")]
#[case::quality_of_a_million_in_the_envelope(LONG_RINGING, "model = \"envelope\"", "start_frequency_hz = 32307.61")]
#[case::highest_quality(RINGING_FOR_HOURS, "", "")]
#[case::highest_quality_in_the_envelope(RINGING_FOR_HOURS, "model = \"envelope\"", "")]
#[case::period_of_one_carrier_cycle(UNCHANGED, "", "period_ms = 0.031")]
#[case::shortest_period(UNCHANGED, "duration_ms = 5.0", "period_ms = 0.001")]
#[case::ten_days(UNCHANGED, "duration_ms = 8.64e8\ntrace_step_ms = 1e6", "period_ms = 1000.0")]
#[case::largest_gain(("0.00698", "3.4e38"), "", "")]
#[case::tiny_gain(("0.00698", "1e-30"), "", "")]
#[case::largest_drive(("limit_vpp = 900.0", "limit_vpp = 3.4e38"), "", "")]
#[case::nothing_but_noise(("noise_um_rms = 0.0", "noise_um_rms = 1e308"), "", "")]
#[case::largest_gains(
    UNCHANGED,
    "",
    "[controller.gains]\namplitude_kp = 3e38\namplitude_ki = 3e38\nfrequency_kp = -3e38\nfrequency_ki = 3e38"
)]
fn files_of_an_extreme_run_hold_finite_numbers(
    #[case] (from, to): (&str, &str),
    #[case] head: &str,
    #[case] controller: &str,
) {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &scenario_text(head, controller));
    fs::write(workshop.path().join("scenarios/plates/plate.toml"), changed_plate(from, to)).unwrap();
    let output = run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "run"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert!([0, 1, 3].contains(&exit_code(&output)), "{told}");
    let out = workshop.path().join("run");
    assert_no_nan_in_files(&out);
    assert_eq!(RunRecord::read(&out).unwrap(), rejudge(&out, None).unwrap());
}

#[rstest]
#[case::no_damping(
    "time_constant_ms = 1.88",
    "time_constant_ms = inf",
    "plates/plate.toml:9:20",
    "expected a finite number above 0"
)]
#[case::negative_damping(
    "time_constant_ms = 1.88",
    "time_constant_ms = -1.88",
    "plates/plate.toml:9:20",
    "expected a finite number above 0"
)]
#[case::next_to_no_damping(
    "time_constant_ms = 1.88",
    "time_constant_ms = 1e300",
    "plates/plate.toml:9:20",
    "a quality factor of "
)]
#[case::a_finger_that_undamps("[1.5, 2.0]", "[1.5, 0.0]", "plates/plate.toml:13:17", "expected ratios above 0")]
#[case::a_finger_that_drives("[0.0, 1.0]", "[0.0, -1.0]", "plates/plate.toml:13:17", "expected ratios above 0")]
#[case::a_gain_beyond_the_wire("0.00698", "1e60", "plates/plate.toml:10:19", "single precision")]
fn an_impossible_plate_is_reported_with_its_line(
    #[case] from: &str,
    #[case] to: &str,
    #[case] place: &str,
    #[case] message: &str,
) {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &scenario_text("", ""));
    fs::write(workshop.path().join("scenarios/plates/plate.toml"), changed_plate(from, to)).unwrap();
    let output = run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "run"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{told}");
    assert!(told.contains(place) && told.contains(message), "{told}");
}

/// One cycle of the carrier is 30.95 µs; the wire carries whole microseconds.
#[test]
fn a_period_between_two_microseconds_is_refused() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &scenario_text("", "period_ms = 0.030952"));
    fs::write(workshop.path().join("scenarios/plates/plate.toml"), changed_plate("", "")).unwrap();
    let output = run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "run"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(exit_code(&output) == 2 && told.contains("expected whole microseconds"), "{told}");
}

/// The console, JUnit and the report say what the record says, and the same when judged again.
#[rstest]
#[case("past-the-delay-budget.toml")]
#[case("backward-euler.toml")]
fn every_report_format_shows_a_divergence(#[case] name: &str) {
    let folder = tempfile::tempdir().unwrap();
    let path = workspace_root().join("scenarios/limits").join(name);
    let output = run_bench(folder.path(), ["run", path.to_str().unwrap(), "--rig", "hosted", "--out", "run"]);
    assert_eq!(exit_code(&output), 1);
    let out = folder.path().join("run");
    let live = RunRecord::read(&out).unwrap();
    let scenario = &live.scenarios[0];
    assert!(scenario.trials[0].diverged_at_s.is_some_and(|at_s| at_s < 0.1), "{:?}", scenario.trials);
    for expectation in &scenario.expectations {
        let reason = expectation.reason.as_ref().unwrap().to_string();
        let at = reason.find("diverged at t = ").unwrap_or_else(|| panic!("{reason}"));
        let said = &reason[at..reason.find(" ms").unwrap()];
        for file in ["junit.xml", "report.html"] {
            assert!(fs::read_to_string(out.join(file)).unwrap().contains(said), "{file}: {said}");
        }
        assert!(String::from_utf8_lossy(&output.stdout).contains(said), "{said}");
    }
    assert_eq!(live, rejudge(&out, None).unwrap());
}
