//! Tests `new`, `check`, settings, completions, manual pages, and watched runs.

use crate::test_folder::{
    ChildGuard, PLATE, ProgramOutput, SETTLING, TestFolder, bench_command, run_bench, step_scenario, step_text,
    wait_until, workspace_root,
};
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::Stdio;

#[rstest]
fn a_new_scenario_is_valid_and_passes(
    #[values(
        "open-loop",
        "dq-pi",
        "dq-pi-fixed",
        "dq-pi-euler",
        "deadbeat",
        "voltage-only",
        "frequency-only",
        "bang-bang",
        "pll"
    )]
    law: &str,
) {
    let folder = tempfile::tempdir().unwrap();
    let call = |arguments: &[&str]| run_bench(folder.path(), arguments);
    call(&["new", "mine", "--law", law]).assert_exit(0);
    let check = call(&["check", "mine.toml", "plates"]).assert_exit(0);
    assert_eq!(check.text(), "no faults in 1 scenario, 1 plate\n");
    call(&["run", "mine.toml", "--rig", "hosted"]).assert_exit(0);
    let before = fs::read(folder.path().join("mine.toml")).unwrap();
    call(&["new", "mine"]).assert_exit(2);
    assert_eq!(fs::read(folder.path().join("mine.toml")).unwrap(), before);
}

#[test]
fn the_repository_s_files_pass_check() {
    run_bench(&workspace_root(), ["check"]).assert_text(0, &["plates, 1 plan"]);
}

#[test]
fn check_reports_all_errors_of_all_files() {
    let folder = TestFolder::new();
    let step = |controller: &str| step_scenario("aluminium-198x138", controller, "", SETTLING);
    folder.write_scenario("keys.toml", &step("").replace("duration_ms", "duration_s").replace("title", "titel"));
    folder.write_scenario("values.toml", &step("period_ms = 0.0").replace("at_most = 2.0", "at_most = -2.0"));
    folder.write_scenario("law.toml", &step("law = \"dq-pid\""));
    folder.write("scenarios/plates/broken.toml", &folder.read(PLATE).replace("limit_vpp", "limit_v"));
    folder.bench(["check"]).assert_exit(2).assert_output(&[
        "unknown key `duration_s`",
        "did you mean `duration_ms`, in ms?",
        "unknown key `titel`",
        "did you mean `title`?",
        "values.toml:5:13",
        "unknown law `dq-pid`",
        "did you mean `dq-pi`?",
        "unknown key `limit_v`",
        "did you mean `limit_vpp`",
    ]);
    assert!(!folder.exists("runs"));
}

#[test]
fn check_without_files_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("scenarios")).unwrap();
    run_bench(folder.path(), ["check"]).assert_exit(4);
    run_bench(folder.path(), ["check", "no-such.toml"]).assert_exit(2);
}

#[rstest]
fn flags_override_environment_file_and_defaults(
    #[values(None, Some("[run]\ntrials = 2\n"))] file: Option<&str>,
    #[values(None, Some("3"))] variable: Option<&str>,
    #[values(None, Some("4"))] flag: Option<&str>,
) {
    let folder = TestFolder::with_step(SETTLING);
    let mut command = bench_command(folder.path());
    command.args(["run", "--rig", "hosted", "--format", "json"]);
    if let Some(text) = file {
        folder.write("platebench.toml", text);
    }
    if let Some(value) = variable {
        command.env("PLATEBENCH_TRIALS", value);
    }
    if let Some(value) = flag {
        command.args(["--trials", value]);
    }
    let output = ProgramOutput::from(command.output().unwrap()).assert_exit(0);
    let events = output.stdout.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    let trials = events.filter(|event| event["event"] == "trial-finished").count();
    assert_eq!(trials.to_string(), flag.or(variable).or(file.map(|_| "2")).unwrap_or("1"));
}

#[test]
fn paths_in_a_file_are_relative_to_it() {
    let folder = TestFolder::with_step(SETTLING);
    folder.write("platebench.toml", "rig = \"hosted\"\nruns = \"mine\"\nscenarios = [\"scenarios\"]\n");
    let below = folder.join("a/b");
    fs::create_dir_all(&below).unwrap();
    run_bench(&below, ["run"]).assert_exit(0);
    assert_eq!(fs::read_dir(folder.join("mine")).unwrap().count(), 1);
    assert_eq!(fs::read_dir(&below).unwrap().count(), 0, "nothing is written to the current folder");
}

#[test]
fn a_broken_file_is_reported_but_help_still_works() {
    let folder = TestFolder::with_step(SETTLING);
    folder.write("platebench.toml", "rigg = \"hosted\"\n[run]\ntrial = 2\n");
    for arguments in [["run", "scenarios"], ["check", "scenarios"], ["baseline", "list"]] {
        folder.bench(arguments).assert_exit(2).assert_output(&[
            "platebench.toml:1:1",
            "did you mean `rig`?",
            "platebench.toml:3:1",
            "did you mean `trials`?",
        ]);
    }
    for arguments in [
        &["generate", "schema", "config"][..],
        &["generate", "man"],
        &["generate", "completions", "bash"],
        &["run", "--help"],
    ] {
        folder.bench(arguments).assert_exit(0);
    }
}

#[rstest]
#[case("PLATEBENCH_RIG", "--rig", "can:0")]
#[case("PLATEBENCH_JOBS", "--jobs", "0")]
#[case("PLATEBENCH_FORMAT", "--format", "")]
fn an_invalid_environment_variable_is_named(#[case] variable: &str, #[case] option: &str, #[case] value: &str) {
    let folder = tempfile::tempdir().unwrap();
    let call = |arguments: &[&str]| -> ProgramOutput {
        bench_command(folder.path()).args(arguments).env(variable, value).output().unwrap().into()
    };
    call(&["run"]).assert_text(2, &[option, variable]);
    // If the option is on the command line, the message does not name the environment variable.
    call(&["run", &format!("{option}={value}")]).assert_exit(2).assert_output_without(variable);
}

#[test]
fn a_run_without_scenarios_suggests_new() {
    let folder = tempfile::tempdir().unwrap();
    run_bench(folder.path(), ["run"]).assert_output(&["platebench new"]);
    run_bench(folder.path(), ["run", "nowhere"]).assert_output_without("platebench new");
}

#[test]
fn completions_and_manual_pages_know_every_command() {
    let folder = tempfile::tempdir().unwrap();
    let call = |arguments: &[&str]| run_bench(folder.path(), arguments).assert_exit(0);
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        call(&["generate", "completions", shell]).assert_output(&["baseline"]);
    }
    let page = call(&["generate", "man"]);
    assert!(page.text().starts_with(".ie"), "{}", page.text());
    call(&["generate", "man", "--out", "man"]);
    let page = fs::read_to_string(folder.path().join("man/platebench-run.1")).unwrap();
    assert!(page.contains("PLATEBENCH_RIG") && page.contains("Examples"), "{page}");
    for command in ["baseline-accept", "check", "generate-schema", "new", "suite-trust"] {
        assert!(folder.path().join(format!("man/platebench-{command}.1")).exists(), "{command}");
    }
}

fn scenarios_of_runs(folder: &Path) -> Vec<Vec<String>> {
    let entries = fs::read_dir(folder.join("runs")).into_iter().flatten().flatten();
    let mut records: Vec<_> = entries
        .filter_map(|entry| {
            let text = fs::read_to_string(entry.path().join("run.json")).ok()?;
            let record: Value = serde_json::from_str(&text).ok()?;
            // `traceability.csv` is the last file that a run writes, so its time orders the runs.
            let written = fs::metadata(entry.path().join("traceability.csv")).ok()?.modified().ok()?;
            let names = record["scenarios"].as_array()?.iter();
            Some((written, names.map(|scenario| scenario["file"].as_str().unwrap().to_owned()).collect()))
        })
        .collect();
    records.sort();
    records.into_iter().map(|(_, names)| names).collect()
}

struct WatchedRun<'a> {
    folder: &'a TestFolder,
    child: ChildGuard,
    expected: Vec<Vec<&'static str>>,
}

impl<'a> WatchedRun<'a> {
    fn start(folder: &'a TestFolder, rig: &str) -> Self {
        let stderr = fs::File::create(folder.join("stderr")).unwrap();
        let mut run = bench_command(folder.path());
        let run = run.args(["run", "--rig", rig, "--watch", "--quiet"]).stdout(Stdio::null()).stderr(stderr);
        Self { folder, child: ChildGuard(run.spawn().unwrap()), expected: Vec::new() }
    }

    #[track_caller]
    fn expect_run(&mut self, names: &[&'static str]) {
        self.expected.push(names.to_vec());
        wait_until("no further run", || scenarios_of_runs(self.folder.path()).len() >= self.expected.len());
        assert_eq!(scenarios_of_runs(self.folder.path()), self.expected);
    }

    #[track_caller]
    fn wait_for_messages(&self, parts: &[&str]) {
        wait_until("no message", || parts.iter().all(|part| self.folder.read("stderr").contains(part)));
    }

    #[track_caller]
    fn interrupt(mut self) {
        self.child.signal("INT");
        self.child.wait_for_exit(&[130]);
    }
}

#[test]
fn a_watched_run_repeats_changed_scenarios() {
    let folder = TestFolder::new();
    let text = step_text(SETTLING);
    folder.write_scenario("a.toml", &text);
    folder.write_scenario("b.toml", &text);
    folder.write_scenario("c.toml", &text.replace("aluminium-198x138", "aluminium-198x138-600vpp"));
    let write_b = |duration: &str| folder.write_scenario("b.toml", &text.replace("duration_ms = 60.0", duration));
    let mut run = WatchedRun::start(&folder, "hosted");
    run.expect_run(&["a.toml", "b.toml", "c.toml"]);
    write_b("duration_ms = 61.0");
    run.expect_run(&["b.toml"]);
    write_b("duration_s = 0.06");
    run.wait_for_messages(&["did you mean `duration_ms`"]);
    write_b("duration_ms = 62.0");
    run.expect_run(&["b.toml"]);
    folder.write(PLATE, &(folder.read(PLATE) + "# another one\n"));
    run.expect_run(&["a.toml", "b.toml"]);
    folder.write_scenario("d.toml", &text);
    run.expect_run(&["d.toml"]);
    run.interrupt();
}

#[test]
fn a_watched_run_repeats_after_a_firmware_change() {
    let folder = TestFolder::new();
    let text = step_text(SETTLING);
    folder.write_scenario("a.toml", &text);
    folder.write_scenario("b.toml", &text);
    let image = folder.join("mine.elf");
    let built = fs::read(workspace_root().join("firmware-under-test/images/platebench-stm32f4.elf")).unwrap();
    fs::write(&image, &built).unwrap();
    let mut run = WatchedRun::start(&folder, "emulated:mine.elf");
    run.expect_run(&["a.toml", "b.toml"]);
    // A build deletes the old image first, so the image is missing for a while.
    fs::remove_file(&image).unwrap();
    run.wait_for_messages(&["mine.elf", "cannot be read"]);
    // Bytes after the last section change the file but not the program.
    fs::write(&image, [&built[..], b"built anew"].concat()).unwrap();
    run.expect_run(&["a.toml", "b.toml"]);
    folder.write_scenario("b.toml", &text.replace("duration_ms = 60.0", "duration_ms = 61.0"));
    run.expect_run(&["b.toml"]);
    run.interrupt();
}

#[test]
fn output_paths_are_checked_before_the_run() {
    let folder = TestFolder::with_step(SETTLING);
    for (option, file, message) in
        [("--tap", "nowhere/x.tap", "no folder nowhere"), ("--summary", "scenarios", "expected a file")]
    {
        folder.bench(["run", "--rig", "hosted", option, file]).assert_text(2, &[message]);
        assert!(!folder.exists("runs"));
    }
    folder.bench(["run", "--rig", "hosted", "--tap", "x.tap", "--summary", "scenarios/../y.md"]).assert_exit(0);
    assert!(folder.exists("x.tap"));
}

#[test]
fn an_absent_rig_leaves_no_run_folder() {
    let folder = TestFolder::with_step(SETTLING);
    folder
        .bench(["run", "--rig", "emulated:nowhere.elf", "--out", "run"])
        .assert_output(&["nowhere.elf"])
        .assert_output_without("run folder");
    assert!(!folder.exists("run"));
}

#[test]
fn run_folders_among_scenarios_are_not_run() {
    let folder = TestFolder::with_step(SETTLING);
    for out in ["scenarios", "scenarios/kept", "again"] {
        folder.bench(["run", "--rig", "hosted", "scenarios", "--out", out]).assert_exit(0);
        assert_eq!(folder.record(out).scenarios.len(), 1, "{out}");
    }
}

#[test]
fn a_watched_run_has_no_folder_of_its_own() {
    TestFolder::new().bench(["run", "--watch", "--out", "run"]).assert_text(2, &["--runs"]);
}
