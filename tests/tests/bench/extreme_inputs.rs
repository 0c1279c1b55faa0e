//! Tests scenarios and plates at the limits of their ranges, and beyond.

use crate::test_folder::{PLATE, TestFolder, run_bench, workspace_root};
use platebench_engine::rejudge;
use platebench_model::record::RunRecord;
use rstest::rstest;
use std::fs;
use std::path::Path;

const CHANGED_PLATE: &str = "scenarios/plates/plate.toml";

/// Returns a scenario of 60 ms, unless `head` sets the duration.
fn scenario_text(head: &str, controller: &str) -> String {
    let duration = if head.contains("duration_ms") { "" } else { "duration_ms = 60.0\n" };
    let metrics =
        ["settling_time_ms", "overshoot_percent", "quadrature_ratio", "frequency_error_hz", "final_amplitude_um"];
    let expect = metrics.map(|metric| format!("[[expect]]\nmetric = \"{metric}\"\nat_most = 1.0\n")).concat();
    format!(
        "title = \"Extreme\"\nplate = \"plates/plate.toml\"\n{duration}{head}\n[controller]\n{controller}\n\
         [profile]\nsetpoint_um = 2.0\n[[expect]]\nmetric = \"static_error_percent\"\nat_most = 1.0\n{expect}"
    )
}

fn extreme_folder(head: &str, controller: &str, (from, to): (&str, &str)) -> TestFolder {
    let folder = TestFolder::with_scenario(&scenario_text(head, controller));
    fs::copy(folder.join(PLATE), folder.join(CHANGED_PLATE)).unwrap();
    folder.replace(CHANGED_PLATE, from, to);
    folder
}

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
        let found = text.split(|c: char| !c.is_alphanumeric()).find(|word| ["nan", "inf", "infinity"].contains(word));
        assert_eq!(found, None, "{}", path.display());
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
fn an_extreme_run_writes_finite_numbers(#[case] change: (&str, &str), #[case] head: &str, #[case] controller: &str) {
    let folder = extreme_folder(head, controller, change);
    folder.run_hosted("run").assert_exit_in(&[0, 1, 3]);
    let out = folder.join("run");
    assert_no_nan_in_files(&out);
    assert_eq!(folder.record("run"), rejudge(&out, None).unwrap());
}

#[rstest]
#[case("past-the-delay-budget.toml")]
#[case("backward-euler.toml")]
fn every_report_format_shows_a_divergence(#[case] name: &str) {
    let folder = tempfile::tempdir().unwrap();
    let path = workspace_root().join("scenarios/limits").join(name);
    let output = run_bench(folder.path(), ["run", path.to_str().unwrap(), "--rig", "hosted", "--out", "run"]);
    let stdout = output.assert_exit(1).stdout;
    let out = folder.path().join("run");
    let live = RunRecord::read(&out).unwrap();
    let scenario = &live.scenarios[0];
    assert!(scenario.trials[0].diverged_at_s.is_some_and(|at_s| at_s < 0.1), "{:?}", scenario.trials);
    let [junit, page] = ["junit.xml", "report.html"].map(|file| fs::read_to_string(out.join(file)).unwrap());
    for expectation in &scenario.expectations {
        let reason = expectation.reason.as_ref().unwrap().to_string();
        let at = reason.find("diverged at t = ").unwrap_or_else(|| panic!("{reason}"));
        let divergence = &reason[at..reason.find(" ms").unwrap()];
        for (format, text) in [("JUnit", &junit), ("page", &page), ("console", &stdout)] {
            assert!(text.contains(divergence), "{format}: {divergence}");
        }
    }
    assert_eq!(live, rejudge(&out, None).unwrap());
}
