use crate::test_folder::{run_bench, start_bench, wait_until, workspace_root};
use platebench_test_kit::python_with_pyserial;
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
