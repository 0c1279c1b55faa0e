//! Tests with `FMPy` that the FMU of a plate follows the bench's trace for any step size.

use crate::test_folder::{ProgramOutput, TestFolder, bench_command, workspace_root};
use platebench_test_kit::skip_without;
use std::path::Path;
use std::process::Command;

const PYTHON: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../target/test-readers/bin/python");
const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/bench/fmu_follows_trace.py");
const PLATE_FILE: &str = "scenarios/plates/aluminium-198x138.toml";

fn export(plate: &Path, out: &Path) -> ProgramOutput {
    bench_command(&workspace_root()).args(["plate", "fmu"]).arg(plate).arg("--out").arg(out).output().unwrap().into()
}

#[test]
fn an_fmu_follows_the_trace_of_the_bench() {
    let folder = TestFolder::new();
    let fmu = folder.join("plate.fmu");
    export(&workspace_root().join(PLATE_FILE), &fmu).assert_exit(0);
    export(&workspace_root().join(PLATE_FILE), &fmu).assert_message(2, &["exists already"]);
    if !Path::new(PYTHON).exists() {
        return skip_without(&format!("FMPy at {PYTHON}"));
    }
    let scenario = workspace_root().join("scenarios/paper/fig13-open-loop.toml");
    let run = ["run", scenario.to_str().unwrap(), "--rig", "hosted", "--out", "run"];
    folder.bench(run).assert_exit(0);
    let trace = folder.join("run/traces/paper/fig13-open-loop/000.csv");
    assert!(trace.is_file(), "{}", trace.display());
    let output = Command::new(PYTHON).args([Path::new(SCRIPT), &fmu, &trace]).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(text.lines().count(), 4, "{text}");
}
