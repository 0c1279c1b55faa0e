//! What people write: new scenarios, checks without a run, settings, and runs that follow their files.

use crate::bench::{Guarded, Workshop, await_that, call, code, program, root, signal, step_scenario};
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Output, Stdio};

const GOOD: &str = "metric = \"settling_time_ms\"\nat_most = 2.0";

fn told(output: &Output) -> String {
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
    let call = |arguments: &[&str]| call(folder.path(), arguments);
    assert_eq!(code(&call(&["new", "mine", "--law", law])), 0);
    let checked = call(&["check", "mine.toml", "plates"]);
    assert_eq!((code(&checked), told(&checked).as_str()), (0, "nothing wrong with 1 scenario, 1 plate\n"));
    let played = call(&["run", "mine.toml", "--rig", "hosted"]);
    assert_eq!(code(&played), 0, "{}", told(&played));
    // Never overwritten.
    let before = fs::read(folder.path().join("mine.toml")).unwrap();
    assert_eq!(code(&call(&["new", "mine"])), 2);
    assert_eq!(fs::read(folder.path().join("mine.toml")).unwrap(), before);
}

#[test]
fn the_repository_s_files_are_good() {
    let output = call(&root(), ["check"]);
    assert_eq!(code(&output), 0, "{}", told(&output));
    assert!(told(&output).contains("plates, 1 plan"), "{}", told(&output));
}

#[test]
fn a_check_tells_all_faults_of_all_files_and_plays_nothing() {
    let workshop = Workshop::new();
    let step = |controller: &str| step_scenario("aluminium-198x138", controller, "", GOOD);
    workshop.scenario("keys.toml", &step("").replace("duration_ms", "duration_s").replace("title", "titel"));
    workshop.scenario("values.toml", &step("period_ms = 0.0").replace("at_most = 2.0", "at_most = -2.0"));
    workshop.scenario("law.toml", &step("law = \"dq-pid\""));
    let broken = fs::read_to_string(workshop.path().join("scenarios/plates/aluminium-198x138.toml")).unwrap();
    fs::write(workshop.path().join("scenarios/plates/broken.toml"), broken.replace("limit_vpp", "limit_v")).unwrap();
    let output = call(workshop.path(), ["check"]);
    let told = told(&output);
    assert_eq!(code(&output), 2, "{told}");
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
fn nothing_to_check_is_told() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("scenarios")).unwrap();
    assert_eq!(code(&call(folder.path(), ["check"])), 4);
    assert_eq!(code(&call(folder.path(), ["check", "no-such.toml"])), 2);
}

/// Two scenarios, a file that sets `trials`, and how many were played by what is said where.
#[test]
fn flags_come_before_the_environment_before_the_file_before_what_is_built_in() {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    let played = |file: Option<&str>, variable: Option<&str>, flags: &[&str]| {
        let path = workshop.path().join("platebench.toml");
        match file {
            Some(text) => fs::write(&path, text).unwrap(),
            None => fs::remove_file(&path).unwrap_or_default(),
        }
        let mut command = program(workshop.path());
        command.args(["run", "--rig", "hosted", "--format", "json"]).args(flags);
        if let Some(value) = variable {
            command.env("PLATEBENCH_TRIALS", value);
        }
        let output = command.output().unwrap();
        assert_eq!(code(&output), 0, "{}", told(&output));
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
fn paths_of_a_file_are_its_own() {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    fs::write(
        workshop.path().join("platebench.toml"),
        "rig = \"hosted\"\nruns = \"mine\"\nscenarios = [\"scenarios\"]\n",
    )
    .unwrap();
    let below = workshop.path().join("a/b");
    fs::create_dir_all(&below).unwrap();
    let output = call(&below, ["run"]);
    assert_eq!(code(&output), 0, "{}", told(&output));
    assert_eq!(fs::read_dir(workshop.path().join("mine")).unwrap().count(), 1);
    // Not where the command was called.
    assert_eq!(fs::read_dir(&below).unwrap().count(), 0);
}

#[test]
fn a_broken_file_is_pointed_into_but_not_in_the_way_of_help() {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    fs::write(workshop.path().join("platebench.toml"), "rigg = \"hosted\"\n[run]\ntrial = 2\n").unwrap();
    for command in ["run", "check", "baseline"] {
        let output = call(workshop.path(), [command, if command == "baseline" { "list" } else { "scenarios" }]);
        assert_eq!(code(&output), 2, "{}", told(&output));
        let told = told(&output);
        assert!(told.contains("platebench.toml:1:1") && told.contains("did you mean `rig`?"), "{told}");
        assert!(told.contains("platebench.toml:3:1") && told.contains("did you mean `trials`?"), "{told}");
    }
    for arguments in [&["schema", "config"][..], &["man"], &["completions", "bash"], &["run", "--help"]] {
        assert_eq!(code(&call(workshop.path(), arguments)), 0, "{arguments:?}");
    }
}

#[test]
fn a_variable_that_cannot_be_meant_is_named() {
    let folder = tempfile::tempdir().unwrap();
    for (variable, value) in [("PLATEBENCH_RIG", "can:0"), ("PLATEBENCH_JOBS", "0"), ("PLATEBENCH_FORMAT", "")] {
        let output = program(folder.path()).arg("run").env(variable, value).output().unwrap();
        let option = format!("--{}", variable.trim_start_matches("PLATEBENCH_").to_lowercase());
        let said = told(&output);
        assert!(code(&output) == 2 && said.contains(&option) && said.contains(variable), "{variable}: {said}");
        // Whoever says it on the command line knows where it is from.
        let output =
            program(folder.path()).args(["run", &format!("{option}={value}")]).env(variable, value).output().unwrap();
        assert!(code(&output) == 2 && !told(&output).contains(variable), "{variable}: {}", told(&output));
    }
}

#[test]
fn who_has_no_scenarios_yet_is_told_how_to_get_one() {
    let folder = tempfile::tempdir().unwrap();
    let said = |arguments: &[&str]| told(&call(folder.path(), arguments));
    assert!(said(&["run"]).contains("platebench new"), "{}", said(&["run"]));
    assert!(!said(&["run", "nowhere"]).contains("platebench new"), "{}", said(&["run", "nowhere"]));
}

#[test]
fn completions_and_manual_pages_know_every_command() {
    let folder = tempfile::tempdir().unwrap();
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let output = call(folder.path(), ["completions", shell]);
        assert!(code(&output) == 0 && told(&output).contains("baseline"), "{shell}");
    }
    assert!(told(&call(folder.path(), ["man"])).starts_with(".ie"), "{}", told(&call(folder.path(), ["man"])));
    assert_eq!(code(&call(folder.path(), ["man", "--out", "man"])), 0);
    let page = fs::read_to_string(folder.path().join("man/platebench-run.1")).unwrap();
    assert!(page.contains("PLATEBENCH_RIG") && page.contains("Examples"), "{page}");
    for command in ["baseline-accept", "check", "new", "schema", "trust"] {
        assert!(folder.path().join(format!("man/platebench-{command}.1")).exists(), "{command}");
    }
}

/// The scenarios of each run so far, in the order of the runs.
fn runs(folder: &Path) -> Vec<Vec<String>> {
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
fn watched(workshop: &Workshop, rig: &str) -> Guarded {
    let told = fs::File::create(workshop.path().join("told")).unwrap();
    let mut run = program(workshop.path());
    let run = run.args(["run", "--rig", rig, "--watch", "--quiet"]).stdout(Stdio::null()).stderr(told);
    Guarded(run.spawn().unwrap())
}

#[test]
fn a_watched_run_plays_what_changed_and_ends_when_told() {
    let workshop = Workshop::new();
    let text = step_scenario("aluminium-198x138", "", "", GOOD);
    workshop.scenario("a.toml", &text);
    workshop.scenario("b.toml", &text);
    workshop.scenario("c.toml", &text.replace("aluminium-198x138", "aluminium-198x138-600vpp"));
    let mut child = watched(&workshop, "hosted");
    let told = || fs::read_to_string(workshop.path().join("told")).unwrap();
    let mut expected: Vec<Vec<&str>> = Vec::new();
    let mut played = |names: &[&'static str]| {
        expected.push(names.to_vec());
        await_that("a run", || runs(workshop.path()).len() >= expected.len());
        assert_eq!(runs(workshop.path()), expected);
    };
    played(&["a.toml", "b.toml", "c.toml"]);
    workshop.scenario("b.toml", &text.replace("duration_ms = 60.0", "duration_ms = 61.0"));
    played(&["b.toml"]);
    // A file that cannot be read is told and waited for; what was good is not played again.
    workshop.scenario("b.toml", &text.replace("duration_ms = 60.0", "duration_s = 0.06"));
    await_that("the fault", || told().contains("did you mean `duration_ms`"));
    workshop.scenario("b.toml", &text.replace("duration_ms = 60.0", "duration_ms = 62.0"));
    played(&["b.toml"]);
    let plate = workshop.path().join("scenarios/plates/aluminium-198x138.toml");
    fs::write(&plate, fs::read_to_string(&plate).unwrap() + "# another one\n").unwrap();
    played(&["a.toml", "b.toml"]);
    workshop.scenario("d.toml", &text);
    played(&["d.toml"]);
    signal(&child.0, "INT");
    await_that("the end", || child.0.try_wait().unwrap().is_some());
    assert_eq!(child.0.wait().unwrap().code(), Some(130), "{}", told());
}

#[test]
fn a_watched_run_plays_again_what_a_new_firmware_may_change() {
    let workshop = Workshop::new();
    let text = step_scenario("aluminium-198x138", "", "", GOOD);
    workshop.scenario("a.toml", &text);
    workshop.scenario("b.toml", &text);
    let image = workshop.path().join("mine.elf");
    let built = fs::read(root().join("firmware-under-test/images/platebench-stm32f4.elf")).unwrap();
    fs::write(&image, &built).unwrap();
    let mut child = watched(&workshop, "emulated:mine.elf");
    let told = || fs::read_to_string(workshop.path().join("told")).unwrap();
    await_that("a run", || runs(workshop.path()).len() == 1);
    // A build takes the old one away before the new one is there.
    fs::remove_file(&image).unwrap();
    await_that("the fault", || told().contains("mine.elf") && told().contains("cannot be read"));
    // What stands behind the last section is none of its business.
    fs::write(&image, [&built[..], b"built anew"].concat()).unwrap();
    await_that("another run", || runs(workshop.path()).len() == 2);
    workshop.scenario("b.toml", &text.replace("duration_ms = 60.0", "duration_ms = 61.0"));
    await_that("a third run", || runs(workshop.path()).len() == 3);
    assert_eq!(runs(workshop.path()), [vec!["a.toml", "b.toml"], vec!["a.toml", "b.toml"], vec!["b.toml"]]);
    signal(&child.0, "INT");
    await_that("the end", || child.0.try_wait().unwrap().is_some());
    assert_eq!(child.0.wait().unwrap().code(), Some(130), "{}", told());
}

#[test]
fn what_is_told_to_files_has_a_place_before_anything_is_played() {
    let workshop = Workshop::new();
    workshop.scenario("a.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    for (option, file, said) in
        [("--tap", "nowhere/x.tap", "no folder nowhere"), ("--summary", "scenarios", "expected a file")]
    {
        let output = call(workshop.path(), ["run", "--rig", "hosted", option, file]);
        assert!(code(&output) == 2 && told(&output).contains(said), "{}", told(&output));
        assert!(!workshop.path().join("runs").exists(), "something was played");
    }
    let output = call(workshop.path(), ["run", "--rig", "hosted", "--tap", "x.tap", "--summary", "scenarios/../y.md"]);
    assert!(code(&output) == 0 && workshop.path().join("x.tap").exists(), "{}", told(&output));
}

#[test]
fn a_rig_that_is_not_there_leaves_no_folder() {
    let workshop = Workshop::new();
    workshop.scenario("a.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    let output = call(workshop.path(), ["run", "--rig", "emulated:nowhere.elf", "--out", "run"]);
    assert!(told(&output).contains("nowhere.elf") && !told(&output).contains("run folder"), "{}", told(&output));
    assert!(!workshop.path().join("run").exists());
}

#[test]
fn a_run_among_scenarios_is_not_played_with_them() {
    let workshop = Workshop::new();
    workshop.scenario("a.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    for out in ["scenarios", "again"] {
        let output = call(workshop.path(), ["run", "--rig", "hosted", "scenarios", "--out", out]);
        assert_eq!(code(&output), 0, "{}", told(&output));
        let record: serde_json::Value =
            serde_json::from_slice(&fs::read(workshop.path().join(out).join("run.json")).unwrap()).unwrap();
        assert_eq!(record["scenarios"].as_array().unwrap().len(), 1, "{record:#}");
    }
}

#[test]
fn a_watched_run_has_no_folder_of_its_own() {
    let workshop = Workshop::new();
    let output = call(workshop.path(), ["run", "--watch", "--out", "run"]);
    assert!(code(&output) == 2 && told(&output).contains("--runs"), "{}", told(&output));
}
