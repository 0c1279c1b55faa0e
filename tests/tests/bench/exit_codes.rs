//! Checks exit codes of runs with other programs, closed pipes and shared folders.

use crate::test_folder::{
    ChildGuard, SETTLING, TestFolder, bench_command, run_bench, start_bench, step_scenario, wait_until, workspace_root,
};
use rstest::rstest;
use std::fs;
use std::process::Stdio;

#[rstest]
#[case::skipped(&[], 4)]
#[case::required(&["--require-all"], 1)]
fn a_law_that_the_controller_lacks_is_not_applicable(#[case] options: &[&str], #[case] expected: i32) {
    let Some(python) = platebench_test_kit::python_with_pyserial() else { return };
    let folder = TestFolder::with_scenario(&step_scenario("aluminium-198x138", "law = \"deadbeat\"", "", SETTLING));
    let controller = workspace_root().join("docs/examples/controller.py");
    let rig = format!("exec:{python} '{}' {{port}}", controller.display());
    let output = folder.bench(["run", "--out", "run", "--rig", &rig].iter().chain(options)).assert_exit(expected);
    // The text is wrapped.
    let text = output.text().split_whitespace().collect::<Vec<_>>().join(" ");
    for part in
        ["tested: python-example 0.1.0, build unknown; rig \"exec:", "--law dq-pi or --law dq-pi-fixed plays every"]
    {
        assert!(text.contains(part), "{text}");
    }
}

#[test]
fn the_example_controller_answers_as_the_protocol_says() {
    let Some(python) = platebench_test_kit::python_with_pyserial() else { return };
    let folder = TestFolder::with_step(SETTLING);
    let controller = workspace_root().join("docs/examples/controller.py");
    let rig = format!("exec:{python} '{}' {{port}}", controller.display());
    let scenario = workspace_root().join("scenarios/reference/protocol.toml");
    let scenario = scenario.to_string_lossy();
    // On a busy machine, a reply may take longer than the default 500 ms.
    let patient = ["--reply-timeout", "5000"];
    let played = folder.bench(["run", &*scenario, "--out", "run", "--rig", &rig].into_iter().chain(patient));
    // What was not tested is no silent pass, and no measured speed decides it.
    let named = "not played: 1 script of the protocol check (more samples than sixteen bits count)";
    let text = played.assert_exit(0).stdout.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(text.contains(named) && text.contains("`run --long-scripts` plays them"), "{text}");
    for file in ["run/report.html", "run/junit.xml"] {
        assert!(folder.read(file).contains("more samples than sixteen bits count"), "{file}");
    }
    let scripts = &folder.record("run").scenarios[0].trials[0].telemetry.scripts_not_played;
    assert_eq!(scripts, &["more samples than sixteen bits count"]);
}

#[test]
fn two_runs_into_one_folder_exclude_each_other() {
    let folder = TestFolder::with_minute();
    let start = || start_bench(folder.path(), ["run", "--rig", "hosted", "--trials", "200", "--out", "run"]);
    let mut runs = [start(), start()];
    let code = |run: &mut ChildGuard| run.0.try_wait().unwrap().map(|status| status.code());
    wait_until("neither run was rejected", || runs.iter_mut().any(|run| code(run).is_some()));
    let codes = runs.each_mut().map(code);
    assert!(codes.contains(&Some(Some(2))) && codes.contains(&None), "{codes:?}");
}

#[test]
fn a_closed_output_pipe_is_not_an_error() {
    let folder = TestFolder::with_step(SETTLING);
    let mut bench = bench_command(folder.path());
    let mut child = ChildGuard(bench.arg("run").stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap());
    drop(child.0.stdout.take());
    child.finish().assert_exit(0);
}

#[test]
fn the_default_run_needs_only_the_repository() {
    let output =
        run_bench(&workspace_root(), ["run", "--trials", "2", "--out", "target/tests/default-run", "--shard", "1/40"]);
    let _ = fs::remove_dir_all(workspace_root().join("target/tests/default-run"));
    output.assert_exit(0);
}
