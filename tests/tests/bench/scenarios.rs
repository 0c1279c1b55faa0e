//! Every scenario of the repository ends as it says it does.

use crate::test_folder::{exit_code, run_bench, workspace_root};
use rstest::rstest;
use std::fs;
use std::path::PathBuf;

fn expected_exit(path: &PathBuf) -> i32 {
    let document: toml::Table = fs::read_to_string(path).unwrap().parse().unwrap();
    document.get("expected_exit").map_or(0, |code| i32::try_from(code.as_integer().unwrap()).unwrap())
}

#[rstest]
fn each_scenario_has_its_expected_exit_code(
    #[files("../scenarios/paper/*.toml")]
    #[files("../scenarios/limits/*.toml")]
    #[files("../scenarios/faults/*.toml")]
    #[files("../scenarios/laws/*.toml")]
    #[files("../scenarios/guards/*.toml")]
    #[files("../scenarios/identify/*.toml")]
    path: PathBuf,
) {
    let folder = tempfile::tempdir().unwrap();
    let output = run_bench(folder.path(), ["run", path.to_str().unwrap(), "--out", "run"]);
    let told = String::from_utf8_lossy(&output.stdout);
    assert_eq!(exit_code(&output), expected_exit(&path), "{told}\n{}", String::from_utf8_lossy(&output.stderr));
    for file in ["run.json", "junit.xml", "report.html", "traceability.csv"] {
        assert!(folder.path().join("run").join(file).exists(), "{file}");
    }
}

/// Every expectation of the paper's scenarios says which requirement it holds.
#[rstest]
fn paper_expectations_name_their_requirements(#[files("../scenarios/paper/*.toml")] path: PathBuf) {
    let scenario = platebench_scenario::load(&path, "s.toml").unwrap();
    for expectation in scenario.expectations {
        assert!(expectation.requirement.is_some(), "{}", expectation.metric);
    }
}

#[test]
fn the_default_run_excludes_limits() {
    let folder = tempfile::tempdir().unwrap();
    let output = run_bench(
        folder.path(),
        ["run", workspace_root().join("scenarios").to_str().unwrap(), "--out", "run", "--trials", "2"],
    );
    let record = fs::read_to_string(folder.path().join("run/run.json")).unwrap();
    assert!(record.contains("paper/fig16-closed-loop.toml"));
    assert!(!record.contains("\"file\": \"limits/"), "{}", String::from_utf8_lossy(&output.stdout));
}

#[test]
fn the_table_of_the_default_run() {
    let folder = tempfile::tempdir().unwrap();
    let output = run_bench(
        folder.path(),
        ["run", workspace_root().join("scenarios").to_str().unwrap(), "--out", "run", "--quiet"],
    );
    assert_eq!(exit_code(&output), 0, "{}", String::from_utf8_lossy(&output.stderr));
    // What is zero but for rounding differs from one mathematics library to the next, and with it the columns' widths.
    // What a step costs changes with every image; `images/cost.toml` is where that is held.
    let cost = (r"step: [\d ]+ worst (.*), [\d.]+ %", "step: # worst $1, # %");
    insta::with_settings!({ filters => vec![(r"\d(\.\d+)?e-\d+", "tiny"), (" {2,}", "  "), cost] }, {
        insta::assert_snapshot!(String::from_utf8(output.stdout).unwrap());
    });
}

/// What a law is said to do it does, whether or not that is what is demanded: of the scenes in which every law is measured, each expectation without a requirement holds.
#[rstest]
fn each_law_behaves_as_documented(
    #[files("../scenarios/laws/drive-*.toml")]
    #[files("../scenarios/laws/noise-*.toml")]
    path: PathBuf,
) {
    let folder = tempfile::tempdir().unwrap();
    run_bench(folder.path(), ["run", path.to_str().unwrap(), "--rig", "hosted", "--out", "run", "--quiet"]);
    let record: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(folder.path().join("run/run.json")).unwrap()).unwrap();
    let scenario = platebench_scenario::load(&path, "s.toml").unwrap();
    let played = record["scenarios"][0]["expectations"].as_array().unwrap();
    assert_eq!(played.len(), scenario.expectations.len());
    for (expected, played) in scenario.expectations.iter().zip(played) {
        assert!(expected.requirement.is_some() || played["verdict"] == "pass", "{played}");
    }
}
