//! Tests planned faults of the chip on the emulated rig.

use crate::test_folder::{TestFolder, run_bench, step_text, workspace_root};
use platebench_model::record::{RunRecord, Verdict};
use platebench_model::trace::Row;
use rstest::rstest;
use std::path::PathBuf;

const MISSED: &str = "metric = \"missed_replies\"\nat_most = 100.0";

fn run_with_fault(fault: &str) -> (RunRecord, Vec<Row>) {
    let folder = TestFolder::new();
    folder.write_scenario("s.toml", &format!("{}\n[[fault]]\n{fault}\n", step_text(MISSED)));
    folder.bench(["run", "--rig", "emulated", "--out", "run"]).assert_exit(0);
    let run = folder.path().join("run");
    let record = RunRecord::read(&run).unwrap();
    let rows = platebench_model::trace::read_trace(&run.join(&record.scenarios[0].trials[0].trace)).unwrap();
    (record, rows)
}

fn drive_at_ms(rows: &[Row], t_ms: f64) -> f64 {
    rows.iter().find(|row| row.t_s * 1e3 >= t_ms).unwrap().drive_vpp
}

#[rstest]
fn each_scenario_passes_on_the_emulated_rig_only(#[files("../scenarios/chip/*.toml")] path: PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = path.to_str().unwrap();
    let expected = i32::from(path.ends_with("random-flip.toml"));
    run_bench(folder.path(), ["run", path, "--rig", "emulated", "--out", "emulated"]).assert_exit(expected);
    run_bench(folder.path(), ["run", path, "--rig", "hosted", "--out", "hosted"]).assert_exit(4);
    let hosted = RunRecord::read(&folder.path().join("hosted")).unwrap();
    assert!(hosted.not_applicable[0].reason.contains("only the emulated rig"), "{:?}", hosted.not_applicable);
}

#[test]
fn the_watchdog_of_the_chip_ends_a_hang() {
    let (record, rows) = run_with_fault("kind = \"hang\"\nat_ms = 20.4");
    // Without answers the last drive acts, until the watchdog resets the chip and PB0 falls.
    let held = drive_at_ms(&rows, 22.0);
    assert!(held > 0.0 && held == drive_at_ms(&rows, 23.0));
    assert_eq!(drive_at_ms(&rows, 27.0), 0.0);
    assert_eq!(record.scenarios[0].trials[0].telemetry.faults["hang"], 1);
    assert!(record.scenarios[0].trials[0].telemetry.stopped.is_some());
}

#[test]
fn equal_seeds_flip_the_same_bit() {
    let rows = || run_with_fault("kind = \"bit-flip\"\ntarget = \"variable:CONTROLLER\"\nrandom = true").1;
    assert!(rows() == rows());
}

#[test]
fn a_reset_of_the_chip_ends_at_0_v() {
    let (_, rows) = run_with_fault("kind = \"reset\"\nat_ms = 20.4");
    assert!(drive_at_ms(&rows, 20.0) > 0.0);
    assert_eq!(drive_at_ms(&rows, 22.5), 0.0);
}

/// A setpoint of 902 µm makes the test firmware divide by zero (`stm32f4/src/planted_faults.rs`).
#[test]
fn a_later_fault_of_the_chip_excuses_nothing() {
    let folder = TestFolder::new();
    let text =
        step_text(MISSED).replacen("setpoint_um = 2.0", "setpoint_um = { hold = [[0.0, 2.0], [10.0, 902.0]] }", 1);
    let fault = "kind = \"reset\"\nat_ms = 30.0";
    folder.write_scenario("s.toml", &format!("{text}\n[[fault]]\n{fault}\n"));
    let image = workspace_root().join("firmware-under-test/images/planted-faults.elf");
    let rig = format!("emulated:{}", image.display());
    folder.bench(["run", "--rig", &rig, "--out", "run"]).assert_exit(1);
    assert_eq!(RunRecord::read(&folder.path().join("run")).unwrap().verdict, Verdict::Fail);
}
