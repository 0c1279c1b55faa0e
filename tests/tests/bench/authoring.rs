//! What people write: new scenarios, checks without a run, settings, and runs that follow their files.

use crate::test_folder::{
    ChildGuard, TestFolder, bench_command, exit_code, run_bench, send_signal, step_scenario, wait_until, workspace_root,
};
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Output, Stdio};

const GOOD: &str = "metric = \"settling_time_ms\"\nat_most = 2.0";

fn output_text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

#[rstest]
#[case("open-loop")]
#[case("dq-pi")]
#[case("dq-pi-fixed")]
#[case("dq-pi-euler")]
#[case("deadbeat")]
#[case("voltage-only")]
#[case("frequency-only")]
#[case("bang-bang")]
#[case("pll")]
fn a_new_scenario_is_good_and_passes(#[case] law: &str) {
    let folder = tempfile::tempdir().unwrap();
    let call = |arguments: &[&str]| run_bench(folder.path(), arguments);
    assert_eq!(exit_code(&call(&["new", "mine", "--law", law])), 0);
    let checked = call(&["check", "mine.toml", "plates"]);
    assert_eq!((exit_code(&checked), output_text(&checked).as_str()), (0, "no faults in 1 scenario, 1 plate\n"));
    let played = call(&["run", "mine.toml", "--rig", "hosted"]);
    assert_eq!(exit_code(&played), 0, "{}", output_text(&played));
    // Never overwritten.
    let before = fs::read(folder.path().join("mine.toml")).unwrap();
    assert_eq!(exit_code(&call(&["new", "mine"])), 2);
    assert_eq!(fs::read(folder.path().join("mine.toml")).unwrap(), before);
}

#[test]
fn the_repository_s_files_pass_check() {
    let output = run_bench(&workspace_root(), ["check"]);
    assert_eq!(exit_code(&output), 0, "{}", output_text(&output));
    assert!(output_text(&output).contains("plates, 1 plan"), "{}", output_text(&output));
}

#[test]
fn check_reports_all_errors_of_all_files() {
    let workshop = TestFolder::new();
    let step = |controller: &str| step_scenario("aluminium-198x138", controller, "", GOOD);
    workshop.write_scenario("keys.toml", &step("").replace("duration_ms", "duration_s").replace("title", "titel"));
    workshop.write_scenario("values.toml", &step("period_ms = 0.0").replace("at_most = 2.0", "at_most = -2.0"));
    workshop.write_scenario("law.toml", &step("law = \"dq-pid\""));
    let broken = fs::read_to_string(workshop.path().join("scenarios/plates/aluminium-198x138.toml")).unwrap();
    fs::write(workshop.path().join("scenarios/plates/broken.toml"), broken.replace("limit_vpp", "limit_v")).unwrap();
    let output = run_bench(workshop.path(), ["check"]);
    let told = output_text(&output);
    assert_eq!(exit_code(&output), 2, "{told}");
    for fault in [
        "unknown key `duration_s`",
        "did you mean `duration_ms`, in ms?",
        "unknown key `titel`",
        "did you mean `title`?",
        "values.toml:5:13",
        "unknown law `dq-pid`",
        "did you mean `dq-pi`?",
        "unknown key `limit_v`",
        "did you mean `limit_vpp`",
    ] {
        assert!(told.contains(fault), "{fault}: {told}");
    }
    assert!(!workshop.path().join("runs").exists());
}

#[test]
fn check_without_files_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("scenarios")).unwrap();
    assert_eq!(exit_code(&run_bench(folder.path(), ["check"])), 4);
    assert_eq!(exit_code(&run_bench(folder.path(), ["check", "no-such.toml"])), 2);
}

/// Two scenarios, a file that sets `trials`, and how many were played by what is said where.
#[test]
fn flags_override_environment_file_and_defaults() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    let played = |file: Option<&str>, variable: Option<&str>, flags: &[&str]| {
        let path = workshop.path().join("platebench.toml");
        match file {
            Some(text) => fs::write(&path, text).unwrap(),
            None => fs::remove_file(&path).unwrap_or_default(),
        }
        let mut command = bench_command(workshop.path());
        command.args(["run", "--rig", "hosted", "--format", "json"]).args(flags);
        if let Some(value) = variable {
            command.env("PLATEBENCH_TRIALS", value);
        }
        let output = command.output().unwrap();
        assert_eq!(exit_code(&output), 0, "{}", output_text(&output));
        let events = output.stdout.split(|byte| *byte == b'\n').filter(|line| !line.is_empty());
        let events = events.map(|line| serde_json::from_slice::<Value>(line).unwrap());
        events.filter(|event| event["event"] == "trial-finished").count()
    };
    let file = Some("[run]\ntrials = 2\n");
    assert_eq!(played(None, None, &[]), 1);
    assert_eq!(played(file, None, &[]), 2);
    assert_eq!(played(None, Some("3"), &[]), 3);
    assert_eq!(played(file, Some("3"), &[]), 3);
    assert_eq!(played(None, None, &["--trials", "4"]), 4);
    assert_eq!(played(file, None, &["--trials", "4"]), 4);
    assert_eq!(played(None, Some("3"), &["--trials", "4"]), 4);
    assert_eq!(played(file, Some("3"), &["--trials", "4"]), 4);
}

#[test]
fn paths_in_a_file_are_relative_to_it() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    fs::write(
        workshop.path().join("platebench.toml"),
        "rig = \"hosted\"\nruns = \"mine\"\nscenarios = [\"scenarios\"]\n",
    )
    .unwrap();
    let below = workshop.path().join("a/b");
    fs::create_dir_all(&below).unwrap();
    let output = run_bench(&below, ["run"]);
    assert_eq!(exit_code(&output), 0, "{}", output_text(&output));
    assert_eq!(fs::read_dir(workshop.path().join("mine")).unwrap().count(), 1);
    // Not where the command was called.
    assert_eq!(fs::read_dir(&below).unwrap().count(), 0);
}

#[test]
fn a_broken_file_is_reported_but_help_still_works() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    fs::write(workshop.path().join("platebench.toml"), "rigg = \"hosted\"\n[run]\ntrial = 2\n").unwrap();
    for command in ["run", "check", "baseline"] {
        let output = run_bench(workshop.path(), [command, if command == "baseline" { "list" } else { "scenarios" }]);
        assert_eq!(exit_code(&output), 2, "{}", output_text(&output));
        let told = output_text(&output);
        assert!(told.contains("platebench.toml:1:1") && told.contains("did you mean `rig`?"), "{told}");
        assert!(told.contains("platebench.toml:3:1") && told.contains("did you mean `trials`?"), "{told}");
    }
    for arguments in [&["schema", "config"][..], &["man"], &["completions", "bash"], &["run", "--help"]] {
        assert_eq!(exit_code(&run_bench(workshop.path(), arguments)), 0, "{arguments:?}");
    }
}

#[test]
fn an_invalid_environment_variable_is_named() {
    let folder = tempfile::tempdir().unwrap();
    for (variable, value) in [("PLATEBENCH_RIG", "can:0"), ("PLATEBENCH_JOBS", "0"), ("PLATEBENCH_FORMAT", "")] {
        let output = bench_command(folder.path()).arg("run").env(variable, value).output().unwrap();
        let option = format!("--{}", variable.trim_start_matches("PLATEBENCH_").to_lowercase());
        let said = output_text(&output);
        assert!(exit_code(&output) == 2 && said.contains(&option) && said.contains(variable), "{variable}: {said}");
        // Whoever says it on the command line knows where it is from.
        let output = bench_command(folder.path())
            .args(["run", &format!("{option}={value}")])
            .env(variable, value)
            .output()
            .unwrap();
        assert!(
            exit_code(&output) == 2 && !output_text(&output).contains(variable),
            "{variable}: {}",
            output_text(&output)
        );
    }
}

#[test]
fn a_run_without_scenarios_suggests_new() {
    let folder = tempfile::tempdir().unwrap();
    let said = |arguments: &[&str]| output_text(&run_bench(folder.path(), arguments));
    assert!(said(&["run"]).contains("platebench new"), "{}", said(&["run"]));
    assert!(!said(&["run", "nowhere"]).contains("platebench new"), "{}", said(&["run", "nowhere"]));
}

#[test]
fn completions_and_manual_pages_know_every_command() {
    let folder = tempfile::tempdir().unwrap();
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let output = run_bench(folder.path(), ["completions", shell]);
        assert!(exit_code(&output) == 0 && output_text(&output).contains("baseline"), "{shell}");
    }
    assert!(
        output_text(&run_bench(folder.path(), ["man"])).starts_with(".ie"),
        "{}",
        output_text(&run_bench(folder.path(), ["man"]))
    );
    assert_eq!(exit_code(&run_bench(folder.path(), ["man", "--out", "man"])), 0);
    let page = fs::read_to_string(folder.path().join("man/platebench-run.1")).unwrap();
    assert!(page.contains("PLATEBENCH_RIG") && page.contains("Examples"), "{page}");
    for command in ["baseline-accept", "check", "new", "schema", "trust"] {
        assert!(folder.path().join(format!("man/platebench-{command}.1")).exists(), "{command}");
    }
}

/// The scenarios of each run so far, in the order of the runs.
fn scenarios_of_runs(folder: &Path) -> Vec<Vec<String>> {
    let entries = fs::read_dir(folder.join("runs")).into_iter().flatten().flatten();
    let mut records: Vec<_> = entries
        .filter_map(|entry| {
            let text = fs::read_to_string(entry.path().join("run.json")).ok()?;
            let record: Value = serde_json::from_str(&text).ok()?;
            // The last thing that a run writes.
            let written = fs::metadata(entry.path().join("traceability.csv")).ok()?.modified().ok()?;
            let names = record["scenarios"].as_array()?.iter();
            Some((written, names.map(|scenario| scenario["file"].as_str().unwrap().to_owned()).collect()))
        })
        .collect();
    records.sort();
    records.into_iter().map(|(_, names)| names).collect()
}

/// A watched run of the workshop's scenarios, which tells into its file `told`.
fn start_watched_run(workshop: &TestFolder, rig: &str) -> ChildGuard {
    let told = fs::File::create(workshop.path().join("told")).unwrap();
    let mut run = bench_command(workshop.path());
    let run = run.args(["run", "--rig", rig, "--watch", "--quiet"]).stdout(Stdio::null()).stderr(told);
    ChildGuard(run.spawn().unwrap())
}

#[test]
fn a_watched_run_repeats_changed_scenarios() {
    let workshop = TestFolder::new();
    let text = step_scenario("aluminium-198x138", "", "", GOOD);
    workshop.write_scenario("a.toml", &text);
    workshop.write_scenario("b.toml", &text);
    workshop.write_scenario("c.toml", &text.replace("aluminium-198x138", "aluminium-198x138-600vpp"));
    let mut child = start_watched_run(&workshop, "hosted");
    let told = || fs::read_to_string(workshop.path().join("told")).unwrap();
    let mut expected: Vec<Vec<&str>> = Vec::new();
    let mut played = |names: &[&'static str]| {
        expected.push(names.to_vec());
        wait_until("a run", || scenarios_of_runs(workshop.path()).len() >= expected.len());
        assert_eq!(scenarios_of_runs(workshop.path()), expected);
    };
    played(&["a.toml", "b.toml", "c.toml"]);
    workshop.write_scenario("b.toml", &text.replace("duration_ms = 60.0", "duration_ms = 61.0"));
    played(&["b.toml"]);
    // A file that cannot be read is told and waited for; what was good is not played again.
    workshop.write_scenario("b.toml", &text.replace("duration_ms = 60.0", "duration_s = 0.06"));
    wait_until("the fault", || told().contains("did you mean `duration_ms`"));
    workshop.write_scenario("b.toml", &text.replace("duration_ms = 60.0", "duration_ms = 62.0"));
    played(&["b.toml"]);
    let plate = workshop.path().join("scenarios/plates/aluminium-198x138.toml");
    fs::write(&plate, fs::read_to_string(&plate).unwrap() + "# another one\n").unwrap();
    played(&["a.toml", "b.toml"]);
    workshop.write_scenario("d.toml", &text);
    played(&["d.toml"]);
    send_signal(&child.0, "INT");
    wait_until("the end", || child.0.try_wait().unwrap().is_some());
    assert_eq!(child.0.wait().unwrap().code(), Some(130), "{}", told());
}

#[test]
fn a_watched_run_repeats_after_a_firmware_change() {
    let workshop = TestFolder::new();
    let text = step_scenario("aluminium-198x138", "", "", GOOD);
    workshop.write_scenario("a.toml", &text);
    workshop.write_scenario("b.toml", &text);
    let image = workshop.path().join("mine.elf");
    let built = fs::read(workspace_root().join("firmware-under-test/images/platebench-stm32f4.elf")).unwrap();
    fs::write(&image, &built).unwrap();
    let mut child = start_watched_run(&workshop, "emulated:mine.elf");
    let told = || fs::read_to_string(workshop.path().join("told")).unwrap();
    wait_until("a run", || scenarios_of_runs(workshop.path()).len() == 1);
    // A build takes the old one away before the new one is there.
    fs::remove_file(&image).unwrap();
    wait_until("the fault", || told().contains("mine.elf") && told().contains("cannot be read"));
    // What stands behind the last section is none of its business.
    fs::write(&image, [&built[..], b"built anew"].concat()).unwrap();
    wait_until("another run", || scenarios_of_runs(workshop.path()).len() == 2);
    workshop.write_scenario("b.toml", &text.replace("duration_ms = 60.0", "duration_ms = 61.0"));
    wait_until("a third run", || scenarios_of_runs(workshop.path()).len() == 3);
    assert_eq!(
        scenarios_of_runs(workshop.path()),
        [vec!["a.toml", "b.toml"], vec!["a.toml", "b.toml"], vec!["b.toml"]]
    );
    send_signal(&child.0, "INT");
    wait_until("the end", || child.0.try_wait().unwrap().is_some());
    assert_eq!(child.0.wait().unwrap().code(), Some(130), "{}", told());
}

#[test]
fn output_paths_are_checked_before_the_run() {
    let workshop = TestFolder::new();
    workshop.write_scenario("a.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    for (option, file, said) in
        [("--tap", "nowhere/x.tap", "no folder nowhere"), ("--summary", "scenarios", "expected a file")]
    {
        let output = run_bench(workshop.path(), ["run", "--rig", "hosted", option, file]);
        assert!(exit_code(&output) == 2 && output_text(&output).contains(said), "{}", output_text(&output));
        assert!(!workshop.path().join("runs").exists(), "something was played");
    }
    let output =
        run_bench(workshop.path(), ["run", "--rig", "hosted", "--tap", "x.tap", "--summary", "scenarios/../y.md"]);
    assert!(exit_code(&output) == 0 && workshop.path().join("x.tap").exists(), "{}", output_text(&output));
}

#[test]
fn an_absent_rig_leaves_no_run_folder() {
    let workshop = TestFolder::new();
    workshop.write_scenario("a.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    let output = run_bench(workshop.path(), ["run", "--rig", "emulated:nowhere.elf", "--out", "run"]);
    assert!(
        output_text(&output).contains("nowhere.elf") && !output_text(&output).contains("run folder"),
        "{}",
        output_text(&output)
    );
    assert!(!workshop.path().join("run").exists());
}

#[test]
fn run_folders_among_scenarios_are_not_run() {
    let workshop = TestFolder::new();
    workshop.write_scenario("a.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    for out in ["scenarios", "again"] {
        let output = run_bench(workshop.path(), ["run", "--rig", "hosted", "scenarios", "--out", out]);
        assert_eq!(exit_code(&output), 0, "{}", output_text(&output));
        let record: serde_json::Value =
            serde_json::from_slice(&fs::read(workshop.path().join(out).join("run.json")).unwrap()).unwrap();
        assert_eq!(record["scenarios"].as_array().unwrap().len(), 1, "{record:#}");
    }
}

#[test]
fn a_watched_run_has_no_folder_of_its_own() {
    let workshop = TestFolder::new();
    let output = run_bench(workshop.path(), ["run", "--watch", "--out", "run"]);
    assert!(exit_code(&output) == 2 && output_text(&output).contains("--runs"), "{}", output_text(&output));
}
