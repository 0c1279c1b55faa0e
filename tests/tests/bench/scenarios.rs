//! Runs every scenario of the repository and compares its exit code with `expected_exit`.

use crate::test_folder::{run_bench, workspace_root};
use platebench_model::record::{RunRecord, Verdict};
use platebench_model::scenario::{Scenario, find};
use rstest::rstest;
use std::fs;
use std::path::{Path, PathBuf};

/// The scenarios of a file: one, or the cases of its matrix.
fn scenarios_of(path: &Path) -> Vec<Scenario> {
    find(&[path.to_owned()]).unwrap().scenarios
}

#[rstest]
#[case::all_cases("scenarios/laws/drive.toml", "(27 cases: 400vpp-bang-bang, 400vpp-deadbeat, 400vpp-dq-pi-euler, ", 1)]
#[case::each_command_is_compared("scenarios/reference/damping.toml", "", 0)]
fn check_prints_each_warning_once(#[case] file: &str, #[case] text: &str, #[case] lines: usize) {
    let output = run_bench(&workspace_root(), ["check", file]).assert_exit(0).assert_stderr(&[text]);
    assert_eq!(output.stderr.lines().count(), lines, "{}", output.stderr);
}

#[rstest]
fn each_scenario_has_its_expected_exit_code(
    #[files("../scenarios/paper/*.toml")]
    #[files("../scenarios/limits/*.toml")]
    #[files("../scenarios/faults/*.toml")]
    #[files("../scenarios/laws/*.toml")]
    #[files("../scenarios/guards/*.toml")]
    #[files("../scenarios/identify/*.toml")]
    #[files("../scenarios/hardware/*.toml")]
    path: PathBuf,
) {
    let folder = tempfile::tempdir().unwrap();
    let scenarios = scenarios_of(&path);
    let codes: Vec<_> = scenarios.iter().map(|scenario| scenario.expected_exit.unwrap_or(0)).collect();
    let worst = [5, 1, 3, 0].into_iter().find(|code| codes.contains(code)).unwrap();
    run_bench(folder.path(), ["run", path.to_str().unwrap(), "--out", "run"]).assert_exit(worst.into());
    if codes.len() > 1 {
        let record = RunRecord::read(&folder.path().join("run")).unwrap();
        assert_eq!(record.scenarios.len(), codes.len());
        for (scenario, result) in scenarios.iter().zip(&record.scenarios) {
            let expected = if scenario.expected_exit.is_some() { Verdict::Fail } else { Verdict::Pass };
            assert_eq!((&result.file, result.verdict), (&scenario.file, expected));
        }
    }
    for file in ["run.json", "junit.xml", "report.html", "traceability.csv"] {
        assert!(folder.path().join("run").join(file).exists(), "{file}");
    }
}

#[rstest]
fn paper_expectations_name_their_requirements(#[files("../scenarios/paper/*.toml")] path: PathBuf) {
    let scenario = platebench_model::scenario::load(&path, "s.toml").unwrap();
    for expectation in scenario.expectations {
        assert!(expectation.requirement.is_some(), "{}", expectation.metric);
    }
}

#[test]
fn the_default_run_passes_and_excludes_limits() {
    let folder = tempfile::tempdir().unwrap();
    let scenarios = workspace_root().join("scenarios");
    let arguments = ["run", scenarios.to_str().unwrap(), "--out", "run", "-v"];
    let output = run_bench(folder.path(), arguments).assert_exit(0);
    let record = fs::read_to_string(folder.path().join("run/run.json")).unwrap();
    assert!(record.contains("paper/fig16-closed-loop.toml"));
    assert!(!record.contains("\"file\": \"limits/"), "{}", output.stdout);
    // Masks rounding errors, column widths, cost and duration, which depend on machine or image.
    let cost = (r"step: [\d ]+ worst (\(.*?\))[,;](?: [\d ]+ are)? [\d.]+ %", "step: # worst $1, # %");
    let duration = (r"duration: .*", "duration: #");
    let slowest = (r"slowest scenario: .*\n", "");
    let build = (r"tested: platebench-f4 [\d.]+, build [0-9a-f]{8} ", "tested: platebench-f4 # ");
    insta::with_settings!({
        filters => vec![(r"\d(\.\d+)?e-\d+", "tiny"), (" {2,}", "  "), cost, duration, slowest, build]
    }, {
        insta::assert_snapshot!(output.stdout);
    });
}

#[rstest]
fn each_law_behaves_as_documented(
    #[files("../scenarios/laws/drive.toml")]
    #[files("../scenarios/laws/noise.toml")]
    path: PathBuf,
) {
    let folder = tempfile::tempdir().unwrap();
    run_bench(folder.path(), ["run", path.to_str().unwrap(), "--rig", "hosted", "--out", "run", "--quiet"]);
    let record = RunRecord::read(&folder.path().join("run")).unwrap();
    let scenarios = scenarios_of(&path);
    assert_eq!(scenarios.len(), 27);
    for (scenario, result) in scenarios.iter().zip(&record.scenarios) {
        assert_eq!((&result.file, result.expectations.len()), (&scenario.file, scenario.expectations.len()));
        for (expected, result) in scenario.expectations.iter().zip(&result.expectations) {
            assert!(expected.requirement.is_some() || result.verdict == Verdict::Pass, "{result:?}");
        }
    }
}
