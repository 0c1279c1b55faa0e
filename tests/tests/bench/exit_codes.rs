//! Checks exit codes and the messages that explain them.

use crate::test_folder::{
    ChildGuard, FAILED_SETTLING, PLATE, ProgramOutput, SETTLING, TestFolder, bench_command, run_bench, start_bench,
    step_scenario, step_text, wait_until, workspace_root,
};
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::process::{Command, Stdio};

const COLUMNS: &str = "time=t:s,drive=V:V,frequency=f:Hz,wd=d:um,wq=q:um";
const UNDECIDED: &str = "metric = \"repeatability_percent\"\nat_most = 1.0";

#[rstest]
#[case::passed(SETTLING, 0)]
#[case::failed(FAILED_SETTLING, 1)]
#[case::inconclusive(UNDECIDED, 3)]
fn verdicts_become_exit_codes(#[case] expect: &str, #[case] expected: i32) {
    let folder = TestFolder::with_step(expect);
    folder.run_hosted("run").assert_exit(expected);
    folder.bench(["report", "run", "--rejudge"]).assert_exit(expected);
}

#[test]
fn a_failure_outweighs_an_inconclusive_verdict() {
    let folder = TestFolder::new();
    for (name, expect) in [("a.toml", UNDECIDED), ("b.toml", FAILED_SETTLING), ("c.toml", SETTLING)] {
        folder.write_scenario(name, &step_text(expect));
    }
    folder.run_hosted("run").assert_exit(1);
}

/// The inputs are pipes without a writer. A program that opened one would block.
#[rstest]
#[case::scenario(&["run", "pipe.toml", "--rig", "hosted"])]
#[case::folder(&["run", "folder", "--rig", "hosted"])]
#[case::plate(&["run", "plate.toml", "--rig", "hosted"])]
#[case::profile(&["run", "profile.toml", "--rig", "hosted"])]
#[case::check(&["check", "pipe.toml"])]
#[case::tune(&["tune", "--plate", "pipe.toml"])]
#[case::firmware(&["run", "good.toml", "--rig", "emulated:pipe.toml"])]
#[case::plan(&["acceptance", "run", "--rig", "hosted", "--plan", "pipe.toml"])]
#[case::public_key(&["acceptance", "verify", "folder", "--key", "pipe.toml"])]
#[case::secret_key(&["acceptance", "run", "--rig", "hosted", "--plan", "plan.toml", "--out", "a", "--sign", "pipe.toml"])]
#[case::telemetry(&["identify", "pipe.toml", "--columns", COLUMNS])]
#[case::trace(&["identify", "pipe.toml"])]
#[case::replayed_telemetry(&["replay", "pipe.toml", "--columns", COLUMNS, "--scenario", "good.toml"])]
#[case::replayed_trace(&["replay", "pipe.toml", "--scenario", "good.toml"])]
#[case::analysed_firmware(&["suite", "coverage", "good.toml", "--rig", "emulated:pipe.toml"])]
#[case::replayed_firmware(&["replay", "run/traces/s/000.csv", "--rig", "emulated:pipe.toml"])]
#[case::envelope(&["suite", "explore", "pipe.toml", "--rig", "hosted", "--scenes", "1"])]
#[case::campaign(&["campaign", "run", "pipe.toml", "--out", "c"])]
#[case::boards(&["board", "list", "--boards", "pipe.toml"])]
#[case::fmu_library(&["plate", "fmu", PLATE, "--out", "p.fmu", "--library", "pipe.toml"])]
fn a_pipe_as_input_is_rejected_without_waiting(#[case] arguments: &[&str]) {
    let folder = TestFolder::new();
    let expect = format!("{SETTLING}\nrequirement = \"R-1\"");
    let good = step_text(&expect).replace("plates/", "scenarios/plates/");
    folder.write("good.toml", &good);
    folder.write("plate.toml", &good.replace("scenarios/plates/aluminium-198x138.toml", "pipe.toml"));
    folder.write("profile.toml", &good.replace("setpoint_um = 2.0", "setpoint_um = { csv = \"pipe.toml\" }"));
    folder.write(
        "plan.toml",
        "title = \"a\"\nrepetitions = 1\n[[requirement]]\nid = \"R-1\"\ntext = \"It settles.\"\n\
         [[scenario]]\nfile = \"good.toml\"\n",
    );
    folder.write_scenario("s.toml", &step_text(SETTLING));
    folder.run_hosted("run");
    fs::create_dir(folder.join("folder")).unwrap();
    for pipe in ["pipe.toml", "folder/pipe.toml"] {
        assert!(Command::new("mkfifo").arg(folder.join(pipe)).status().unwrap().success());
    }
    let mut bench = start_bench(folder.path(), arguments);
    wait_until("the bench waits for a pipe", || bench.has_ended());
    bench.finish().assert_message(2, &["pipe.toml", "it is a pipe or a device, expected"]);
}

#[rstest]
#[case::table(&["run", "--rig", "hosted"])]
#[case::lines(&["run", "--rig", "hosted", "--format", "json"])]
#[case::schema(&["generate", "schema", "scenario"])]
fn a_write_error_is_not_a_success(#[case] arguments: &[&str]) {
    let folder = TestFolder::with_step(SETTLING);
    let full = fs::File::create("/dev/full").unwrap();
    let output = bench_command(folder.path()).args(arguments).stdout(full).stderr(Stdio::piped()).output().unwrap();
    ProgramOutput::from(output).assert_message(2, &["standard output is incomplete: No space left"]);
}

#[test]
fn invalid_input_outweighs_all_and_nothing_runs() {
    let folder = TestFolder::new();
    folder.write_scenario("bad.toml", &step_text(FAILED_SETTLING));
    folder.write_scenario("broken.toml", &step_text(SETTLING).replace("duration_ms", "duration"));
    folder.bench(["run", "--out", "run"]).assert_message(2, &["broken.toml:3:1"]);
    assert!(!folder.exists("run"));
}

#[rstest]
#[case::no_such_file(&["run", "no-such.toml"], "no-such.toml")]
#[case::no_default_folder(&["run"], "scenarios")]
#[case::unknown_law(&["run", "--law", "dq-pid"], "dq-pid")]
#[case::unknown_rig(&["run", "--rig", "can:0"], "can:0")]
#[case::no_trials(&["run", "--trials", "0"], "0")]
#[case::wrong_shard(&["run", "--shard", "3/2"], "3/2")]
#[case::no_command(&["frobnicate"], "frobnicate")]
#[case::no_run(&["report", "nowhere", "--rejudge"], "nowhere")]
#[case::no_report(&["report", "nowhere"], "nowhere")]
fn wrong_usage_names_the_argument(#[case] arguments: &[&str], #[case] named: &str) {
    let folder = tempfile::tempdir().unwrap();
    run_bench(folder.path(), arguments).assert_message(2, &[named]).assert_output_without("panicked");
}

#[test]
fn an_unknown_law_is_reported_with_its_line() {
    let folder = TestFolder::with_scenario(&step_scenario("aluminium-198x138", "law = \"dq-pid\"", "", SETTLING));
    folder.bench(["run"]).assert_message(2, &["s.toml:5:7", "`dq-pi`"]);
}

#[test]
fn a_run_without_scenarios_is_not_a_pass() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("scenarios")).unwrap();
    run_bench(folder.path(), ["run"]).assert_exit(4);
    TestFolder::with_step(SETTLING).bench(["run", "--shard", "2/2"]).assert_exit(4);
}

#[test]
fn a_named_folder_without_scenarios_is_not_a_pass() {
    let folder = TestFolder::with_step(SETTLING);
    fs::create_dir(folder.join("more")).unwrap();
    folder
        .bench(["run", "scenarios", "more", "--out", "run"])
        .assert_message(4, &["more: no scenario was found below this folder"]);
    assert!(!folder.exists("run"));
}

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
        ["tested: python-example 0.1.0, build unknown; rig exec:", "--law dq-pi or --law dq-pi-fixed plays every"]
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
    folder.bench(["run", &*scenario, "--out", "run", "--rig", &rig]).assert_exit(0);
}

const REFERENCE: &str = "metric = \"reference_difference_percent\"\nat_most = 1.0\n";

#[rstest]
#[case("lockstep", 0)]
#[case("real-time", 4)]
fn comparison_with_the_reference_needs_lockstep(#[case] clock: &str, #[case] expected: i32) {
    let folder = TestFolder::with_step(REFERENCE);
    folder.bench(["run", "--out", "run", "--rig", "hosted", "--clock", clock]).assert_exit(expected);
}

#[test]
fn a_run_folder_is_not_overwritten() {
    let folder = TestFolder::with_step(SETTLING);
    folder.run_hosted("run").assert_exit(0);
    let before = folder.read("run/run.json");
    folder.run_hosted("run").assert_exit(2);
    assert_eq!(folder.read("run/run.json"), before);
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
fn an_unusable_rig_leaves_no_files() {
    let folder = TestFolder::with_step(SETTLING);
    for (rig, message) in [("exec:true", "`true` has no {port}"), ("probe:STM32F407VG", "--features probe")] {
        folder.bench(["run", "--rig", rig]).assert_message(2, &[message]);
    }
    assert!(!folder.exists("runs"));
}

#[test]
fn a_closed_output_pipe_is_not_an_error() {
    let folder = TestFolder::with_step(SETTLING);
    let mut bench = bench_command(folder.path());
    let mut child = ChildGuard(bench.arg("run").stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap());
    drop(child.0.stdout.take());
    child.finish().assert_exit(0);
}

#[rstest]
#[case::level("platebench_rig=loud")]
#[case::target("=debug,[")]
fn an_invalid_log_filter_is_refused(#[case] filter: &str) {
    let folder = TestFolder::new();
    let output: ProgramOutput =
        bench_command(folder.path()).args(["check", "."]).env("PLATEBENCH_LOG", filter).output().unwrap().into();
    output.assert_message(2, &["PLATEBENCH_LOG", "expected a filter such as `debug`"]);
}

#[test]
fn the_log_follows_its_switches() {
    const LINE: &str = "scenario judged";
    let folder = TestFolder::with_step(SETTLING);
    let log = |arguments: &[&str], variable: Option<&str>| {
        let mut command = bench_command(folder.path());
        command.args(["run"]).args(arguments).envs(variable.map(|value| ("PLATEBENCH_LOG", value)));
        ProgramOutput::from(command.output().unwrap()).stderr
    };
    assert!(!log(&[], None).contains(LINE));
    assert!(log(&["-v"], None).contains(LINE));
    assert!(log(&[], Some("platebench_engine=info")).contains(LINE));
    let json = log(&["-v", "--log-format", "json"], None);
    let line = json.lines().find(|line| line.contains(LINE)).unwrap();
    assert_eq!(serde_json::from_str::<Value>(line).unwrap()["level"], "INFO");
}

#[test]
fn the_default_run_needs_only_the_repository() {
    let output =
        run_bench(&workspace_root(), ["run", "--trials", "2", "--out", "target/tests/default-run", "--shard", "1/40"]);
    let _ = fs::remove_dir_all(workspace_root().join("target/tests/default-run"));
    output.assert_exit(0);
}

#[rstest]
#[case::unmet_target(&["tune", "--plate", PLATE, "--samples", "0", "--response-ms", "0.5"], 1, "✗ fail: the target cannot")]
#[case::no_baseline(&["baseline", "diff", "run"], 4, "inconclusive (nothing to run): nothing was compared")]
#[case::no_scenario(&["run", "empty"], 4, "inconclusive (nothing to run): ")]
#[case::empty_folder(&["run", "scenarios", "empty"], 4, "inconclusive (nothing to run): ")]
#[case::no_recording(&["identify", "empty"], 4, "inconclusive (nothing to run): ")]
#[case::absent_rig(&["run", "--rig", "exec:false {port}", "--out", "a"], 5, "inconclusive (rig): ")]
#[case::tuned_for_an_absent_rig(
    &["tune", "--plate", PLATE, "--samples", "0", "--send", "exec:false {port}", "--out", "a"],
    5,
    "? inconclusive (rig): the gains were not verified"
)]
#[case::coverage(
    &["suite", "coverage", "scenarios/s.toml", "--at-least", "100"],
    1,
    "✗ fail: lines executed "
)]
#[case::unplayed_campaign(&["campaign", "status", "c"], 3, "? inconclusive: 2 of 2 shards are missing")]
fn every_exit_code_but_0_and_2_has_a_verdict_and_a_reason(
    #[case] arguments: &[&str],
    #[case] expected: i32,
    #[case] verdict: &str,
) {
    let folder = TestFolder::with_step(SETTLING);
    fs::create_dir(folder.join("empty")).unwrap();
    folder.run_hosted("run");
    let campaign = "title = \"c\"\nscenario = \"scenarios/s.toml\"\n[vary]\n\"controller.loop_delay_ms\" = \
                    { uniform = [0.0, 0.1] }\n[plan]\nmethod = \"random\"\ntrials = 4\nseed = 1\n";
    folder.write("c.toml", campaign);
    folder.bench(["campaign", "plan", "c.toml", "--out", "c", "--shards", "2", "--rig", "hosted"]).assert_exit(0);
    folder.bench(arguments).assert_text(expected, &[verdict]);
}
