//! Tests `platebench stability --rig`: results, refusals and ends.

use crate::test_folder::{TestFolder, controller_rig, start_bench, wait_until, workspace_root};
use rstest::rstest;
use std::fs;

const STEP: &str = "metric = \"settling_time_ms\"\nat_most = 4.0\nrequirement = \"R-1\"";
const SCENARIO: [&str; 3] = ["stability", "--scenario", "scenarios/s.toml"];

fn folder() -> TestFolder {
    TestFolder::with_step(STEP)
}

#[test]
fn writes_tables_maps_and_chart_over_operating_points() {
    let folder = folder();
    let points = ["--force-n", "0", "--force-n", "1", "--detuning-hz", "-20", "--detuning-hz", "0"];
    let options = ["--rig", "hosted", "--law", "dq-pi-fixed", "--margin", "delay", "--jobs", "2", "--out", "m"];
    let output = folder.bench(SCENARIO.iter().chain(&options).chain(&points)).assert_exit(0);
    output.assert_stdout(&[
        "dq-pi-fixed on hosted at 1 ms, 2 µm, -20 Hz, 1 N",
        "delay margin, periods",
        "settling_time_ms",
        "Speed against accuracy",
        "In the last 100 of 1600 periods the amplitude stays within 5 % of its mean",
    ]);
    assert_eq!(folder.read("m/margins.csv").lines().count(), 1 + 4);
    for file in ["m/stability.html", "m/margins.json", "m/speed-accuracy.svg", "m/map-delay.svg"] {
        assert!(folder.exists(file), "{file}");
    }
}

#[test]
fn equal_searches_have_equal_margins() {
    let folder = folder();
    let measured = |jobs: &str| {
        let options = ["--rig", "hosted", "--margin", "drive-gain", "--jobs", jobs, "--format", "json"];
        let mut result = folder.bench(SCENARIO.iter().chain(&options)).assert_exit(0).json();
        result["cases"][0]["time_per_step_us"].take();
        result
    };
    assert_eq!(measured("1"), measured("3"));
}

#[test]
fn references_are_rows_of_the_same_table() {
    let folder = folder();
    let options = ["--rig", "hosted", "--law", "own", "--reference", "hosted", "--margin", "force", "--format", "json"];
    let result = folder.bench(SCENARIO.iter().chain(&options)).assert_exit(0).json();
    let cases = result["cases"].as_array().unwrap();
    let references = cases.iter().filter(|case| case["is_reference"] == true).count();
    assert_eq!((cases.len(), references, &cases[0]["law"]), (10, 9, &"own".into()));
}

#[rstest]
#[case::own_law_without_a_rig(&["--law", "own"], "--law own needs --rig")]
#[case::unknown_law(&["--rig", "hosted", "--law", "best"], "invalid value 'best'")]
#[case::no_such_requirement(&["--rig", "hosted", "--requirement", "Q"], "requirement that begins with Q")]
#[case::no_setpoint(&["--rig", "hosted", "--setpoint-um", "0"], "an amplitude in µm above 0")]
#[case::odd_period(&["--rig", "hosted", "--period-ms", "0.0005"], "expected whole microseconds")]
#[case::a_force_that_is_too_large(&["--rig", "hosted", "--force-n", "100.1"], "a force in N from 0 to 100")]
#[case::a_reference_without_a_rig(&["--reference", "hosted"], "--rig <RIG>")]
#[case::missing_scenario(&["--rig", "hosted", "--scenario", "none.toml"], "none.toml")]
fn refuses_invalid_input(#[case] options: &[&str], #[case] expected: &str) {
    let names_scenario = options.contains(&"--rig") && !options.contains(&"--scenario");
    let command = if names_scenario { &SCENARIO[..] } else { &SCENARIO[..1] };
    folder().bench(command.iter().chain(options)).assert_message(2, &[expected]);
}

#[test]
fn a_law_that_the_controller_lacks_is_not_applicable() {
    let Some(python) = platebench_test_kit::python_with_pyserial() else { return };
    let controller = workspace_root().join("docs/examples/controller.py");
    let rig = format!("exec:{python} '{}' {{port}}", controller.display());
    let options = ["--law", "deadbeat", "--rig", &rig];
    folder().bench(SCENARIO.iter().chain(&options)).assert_message(4, &["does not announce the law deadbeat"]);
}

#[test]
fn a_rig_that_ends_is_unreachable() {
    folder().bench(SCENARIO.iter().chain(&["--rig", "exec:false {port}"])).assert_exit(5);
}

#[test]
fn a_signal_ends_the_search_with_0_v() {
    let folder = folder();
    let log = folder.join("log");
    let rig = controller_rig(Some(&log));
    let bench = start_bench(folder.path(), SCENARIO.iter().chain(&["--rig", rig.as_str()]));
    wait_until("no exchange", || fs::metadata(&log).is_ok_and(|log| log.len() > 0));
    bench.signal("INT");
    bench.finish().assert_exit(130);
}
