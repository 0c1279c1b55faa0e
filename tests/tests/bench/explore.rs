use crate::test_folder::{run_bench, start_bench, wait_until, workspace_root};
use platebench_test_kit::python_with_pyserial;
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::path::Path;

fn envelope() -> String {
    workspace_root().join("scenarios/envelope.toml").display().to_string()
}

fn report(folder: &Path) -> Value {
    serde_json::from_slice(&fs::read(folder.join("out/explore.json")).unwrap()).unwrap()
}

#[test]
fn the_minimal_scene_of_a_mutant_fails_under_run() {
    let Some(python) = python_with_pyserial() else { return };
    let folder = tempfile::tempdir().unwrap();
    let example = fs::read_to_string(workspace_root().join("docs/examples/controller.py")).unwrap();
    let call = "self.law.step(setpoint, wd, wq)";
    assert!(example.contains(call));
    let mutant = example.replace(call, "self.law.step(setpoint * (1.03 if setpoint > 1.5 else 1.0), wd, wq)");
    fs::write(folder.path().join("mutant.py"), mutant).unwrap();
    let rig = format!("exec:{python} mutant.py {{port}}");
    let arguments = [
        "suite",
        "explore",
        &envelope(),
        "--rig",
        &rig,
        "--scenes",
        "12",
        "--out",
        "out",
        "--regressions",
        "found",
        "-q",
    ];
    run_bench(folder.path(), arguments).assert_exit(1).assert_stdout(&["static-error violated"]);
    let report = report(folder.path());
    let violations = report["violations"].as_array().unwrap();
    let violation = violations.iter().find(|violation| violation["property"] == "static-error").unwrap();
    assert_eq!(violation["is_reproduced"], true, "{violation}");
    let file = violation["file"].as_str().unwrap();
    let text = fs::read_to_string(folder.path().join(file)).unwrap();
    assert!(text.starts_with("# Written by platebench suite explore"), "{text}");
    run_bench(folder.path(), ["run", file, "--rig", &rig, "--out", "again"]).assert_exit(1);
    run_bench(folder.path(), ["run", file, "--rig", "hosted", "--out", "clean"]).assert_exit(0);
}

#[test]
fn a_controller_that_ends_once_fails_its_scene() {
    let Some(python) = python_with_pyserial() else { return };
    let folder = tempfile::tempdir().unwrap();
    let example = fs::read_to_string(workspace_root().join("docs/examples/controller.py")).unwrap();
    let call = "self.law.step(setpoint, wd, wq)";
    let dying = example.replace(call, "self.law.step(setpoint, wd, wq if os.path.exists('died') else die())");
    let die = "import os\n\ndef die():\n    open('died', 'w').close()\n    os._exit(0)\n\n";
    let (head, body) = dying.split_once("import ").unwrap();
    fs::write(folder.path().join("dying.py"), format!("{head}{die}import {body}")).unwrap();
    let rig = format!("exec:{python} dying.py {{port}}");
    let arguments = ["suite", "explore", &envelope(), "--rig", &rig, "--scenes", "4", "--jobs", "1", "--out", "out"];
    run_bench(folder.path(), arguments).assert_exit(1);
    let report = report(folder.path());
    assert_eq!((&report["verdict"], &report["failed"]), (&"fail".into(), &1.into()));
}

/// Every controller after the first ends before the handshake, so no scene can be reduced.
#[test]
fn violations_before_a_lost_rig_are_stored() {
    let Some(python) = python_with_pyserial() else { return };
    let folder = tempfile::tempdir().unwrap();
    let example = fs::read_to_string(workspace_root().join("docs/examples/controller.py")).unwrap();
    let call = "self.law.step(setpoint, wd, wq)";
    let mutant = example.replace(call, "self.law.step(setpoint * 1.03, wd, wq)");
    // The exploration connects once to identify the controller, and once to play.
    let starts = "import os, sys\nopen('starts', 'a').write('x')\nif os.path.getsize('starts') > 2:\n    sys.exit(1)\n";
    let (head, body) = mutant.split_once("import ").unwrap();
    fs::write(folder.path().join("once.py"), format!("{head}{starts}import {body}")).unwrap();
    let rig = format!("exec:{python} once.py {{port}}");
    let envelope = envelope();
    let arguments = ["suite", "explore", &envelope, "--rig", &rig, "--scenes", "12", "--jobs", "1", "--out", "out"];
    let arguments = arguments.iter().chain(&["--regressions", "found"]);
    run_bench(folder.path(), arguments).assert_exit(5).assert_stdout(&["violated", "The exploration ended early"]);
    let report = report(folder.path());
    assert_eq!(report["verdict"], "fail");
    assert!(report["stopped_by"].is_string() && report["failed"].as_u64() > Some(0), "{report}");
    let violation = &report["violations"][0];
    assert_eq!(violation["is_reproduced"], false);
    let file = violation["file"].as_str().unwrap();
    run_bench(folder.path(), ["run", file, "--rig", "hosted", "--out", "clean"]).assert_exit(0);
}

#[test]
fn a_quiet_exploration_that_passes_prints_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let explore = |options: &[&str]| {
        let envelope = envelope();
        let arguments = ["suite", "explore", &envelope, "--rig", "hosted", "--scenes", "1", "-q"];
        run_bench(folder.path(), arguments.iter().chain(options))
    };
    assert_eq!(explore(&["--out", "out"]).assert_exit(0).text(), "");
    assert_eq!(report(folder.path())["verdict"], "pass");
    let json = explore(&["--out", "json", "--format", "json"]).assert_exit(0).json();
    assert_eq!(json["scenes"], 1);
}

#[test]
fn an_interrupt_ends_an_exploration() {
    let folder = tempfile::tempdir().unwrap();
    let arguments = ["suite", "explore", &envelope(), "--rig", "hosted", "--for", "10m", "--out", "out"];
    let bench = start_bench(folder.path(), arguments);
    let status = format!("/proc/{}/status", bench.0.id());
    let catches_interrupts = || {
        let text = fs::read_to_string(&status).unwrap();
        let mask = text.lines().find_map(|line| line.strip_prefix("SigCgt:")).unwrap().trim();
        u64::from_str_radix(mask, 16).unwrap() & 1 << 1 != 0
    };
    wait_until("no handler of signals", catches_interrupts);
    bench.signal("INT");
    bench.finish().assert_exit(130);
    // If the signal came before the first scene, there is no report.
    if folder.path().join("out").exists() {
        assert_eq!(report(folder.path())["is_interrupted"], true);
    }
}

/// The example with a law of its own, and with `changes`, pairs of old and new text.
fn own_law(folder: &Path, changes: &[(&str, &str)]) -> Option<String> {
    let python = python_with_pyserial()?;
    let mut text = fs::read_to_string(workspace_root().join("docs/examples/controller.py")).unwrap();
    let state = "        self.law, self.number, self.noise = None, None, 0\n";
    let number = [state, "        law = DQ_PI_FIXED if law <= 8 else law\n"].concat();
    let identity = ("laws = 1 << DQ_PI | 1 << DQ_PI_FIXED", "laws = 0");
    for (old, new) in [(state, &*number), identity].iter().chain(changes) {
        assert!(text.contains(old), "{old}");
        text = text.replace(old, new);
    }
    fs::write(folder.join("own.py"), text).unwrap();
    Some(format!("exec:{python} own.py {{port}}"))
}

/// Outside of the project, so the envelope is the built-in one.
#[rstest]
#[case::correct("self.law.step(setpoint, wd, wq)", "", 0)]
#[case::wrong_level("self.law.step(setpoint * (1.03 if setpoint > 1.5 else 1.0), wd, wq)", "static-error", 1)]
#[case::drives_at_rest("self.law.step(setpoint or 0.2, wd, wq)", "rest-drive", 1)]
fn an_own_law_is_explored_by_default(#[case] step: &str, #[case] property: &str, #[case] exit: i32) {
    let folder = tempfile::tempdir().unwrap();
    let Some(rig) = own_law(folder.path(), &[("self.law.step(setpoint, wd, wq)", step)]) else { return };
    let arguments = ["suite", "explore", "--rig", &rig, "--scenes", "14", "--reply-timeout", "2000", "--out", "out"];
    let output = run_bench(folder.path(), arguments).assert_exit(exit);
    let report = report(folder.path());
    assert_eq!(report["law"], "own");
    assert!(report["own_law"]["settling_us"].as_u64() > Some(0), "{report}");
    assert_eq!(report["envelope"], "the built-in envelope");
    let violations = report["violations"].as_array().unwrap();
    assert_eq!(violations.is_empty(), exit == 0, "{}", output.text());
    if exit == 1 {
        let violation = violations.iter().find(|violation| violation["property"] == property).unwrap();
        let file = violation["file"].as_str().unwrap();
        run_bench(folder.path(), ["run", file, "--rig", &rig, "--out", "again"]).assert_exit(1);
    }
}

#[test]
fn a_law_that_is_not_announced_names_the_options() {
    let folder = tempfile::tempdir().unwrap();
    let Some(rig) = own_law(folder.path(), &[]) else { return };
    let arguments = ["suite", "explore", "--rig", &rig, "--scenes", "1", "--law", "pll"];
    run_bench(folder.path(), arguments).assert_exit(2).assert_stderr(&["the law pll, expected --law own"]);
}
