//! The same scenarios on the hosted and on the emulated rig, and what only the emulated one can show.

use crate::test_folder::{TestFolder, exit_code, run_bench, step_scenario, workspace_root};
use platebench_record::{Cause, RunRecord, Verdict};
use rstest::rstest;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

fn collect_traces(folder: &Path, found: &mut BTreeMap<PathBuf, Vec<u8>>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            collect_traces(&path, found);
        } else {
            found.insert(path.clone(), fs::read(&path).unwrap());
        }
    }
}

/// Every trace of a run by its path below the run folder.
fn read_traces(run: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    collect_traces(&run.join("traces"), &mut found);
    found.into_iter().map(|(path, bytes)| (path.strip_prefix(run).unwrap().to_owned(), bytes)).collect()
}

#[rstest]
#[case::own_laws(&[])]
#[case::dq_pi(&["--law", "dq-pi"])]
#[case::dq_pi_euler(&["--law", "dq-pi-euler"])]
#[case::open_loop(&["--law", "open-loop"])]
fn hosted_and_emulated_traces_are_identical(#[case] law: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let scenarios =
        ["paper", "limits"].map(|part| workspace_root().join("scenarios").join(part).to_str().unwrap().to_owned());
    for rig in ["hosted", "emulated"] {
        let arguments = ["run", &scenarios[0], &scenarios[1], "--rig", rig, "--out", rig, "--trials", "2"];
        run_bench(folder.path(), arguments.iter().chain(law));
    }
    let hosted = read_traces(&folder.path().join("hosted"));
    let emulated = read_traces(&folder.path().join("emulated"));
    assert!(hosted.len() > 20, "{} traces", hosted.len());
    assert_eq!(hosted.keys().collect::<Vec<_>>(), emulated.keys().collect::<Vec<_>>());
    for (path, bytes) in &hosted {
        assert!(emulated[path] == *bytes, "{} differs", path.display());
    }
}

const SETTLING: &str = "metric = \"settling_time_ms\"\nat_most = 2.0";

fn run_and_read(workshop: &TestFolder, arguments: &[&str], expected: i32) -> RunRecord {
    let out = tempfile::tempdir_in(workshop.path()).unwrap();
    let output = run_bench(workshop.path(), ["run", "--out", out.path().to_str().unwrap()].iter().chain(arguments));
    assert_eq!(exit_code(&output), expected, "{}", String::from_utf8_lossy(&output.stderr));
    RunRecord::read(out.path()).unwrap()
}

#[test]
fn wire_and_computing_time_are_optional() {
    let workshop = TestFolder::new();
    // A law whose longest step does not depend on what it is shown.
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "law = \"dq-pi-fixed\"", "", SETTLING));
    let transparent = run_and_read(&workshop, &["--rig", "emulated"], 0);
    let wired = run_and_read(&workshop, &["--rig", "emulated", "--wire-time"], 1);
    let telemetry = |record: &RunRecord| record.scenarios[0].trials[0].telemetry.clone();
    assert_eq!(telemetry(&transparent).loop_delay_us, Some(0.0));
    // 24 bytes each way at 1 Mbaud are 480 µs; the idle line that ends a frame and the control step come on top.
    let delay = telemetry(&wired).loop_delay_us.unwrap();
    assert!((480.0..560.0).contains(&delay), "{delay} µs");
    // Other samples take other branches: 36 instructions apart, at 168 MHz.
    let without = telemetry(&transparent).rig_delay_us.unwrap();
    assert!((without - telemetry(&wired).rig_delay_us.unwrap()).abs() < 0.25, "{without} µs");
    assert!(wired.scenarios[0].expectations[0].value.unwrap() > 4.0);
}

#[test]
fn instruction_limits_need_a_counting_rig() {
    let workshop = TestFolder::new();
    let limit = |at_most: u32| {
        let expect = format!("metric = \"instructions_per_step\"\nat_most = {at_most}.0");
        workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", &expect));
    };
    limit(168_000);
    let counted = run_and_read(&workshop, &["--rig", "emulated"], 0).scenarios[0].expectations[0].value.unwrap();
    assert!((500.0..20_000.0).contains(&counted), "{counted}");
    limit(counted as u32 - 1);
    run_and_read(&workshop, &["--rig", "emulated"], 1);
    let hosted = run_and_read(&workshop, &["--rig", "hosted"], 3);
    assert_eq!(hosted.scenarios[0].expectations[0].cause, Some(Cause::Evidence));
}

/// `firmware-under-test/stm32f4/src/planted_faults.rs`: a setpoint of 900 + n µm makes the firmware do wrong number n.
#[rstest]
#[case::unaligned_access(1, "planted_faults::unaligned_access")]
#[case::division_by_zero(2, "planted_faults::division_by_zero")]
#[case::endless_loop(3, "planted_faults::endless_loop")]
#[case::stack_overflow(4, "planted_faults::stack_overflow")]
#[case::undefined_instruction(5, "planted_faults::undefined_instruction")]
#[case::unmodelled_peripheral(9, "planted_faults::unmodelled_peripheral")]
fn a_trap_is_reported_with_function_and_address(#[case] which: u32, #[case] function: &str) {
    let workshop = TestFolder::new();
    // An expectation that a plate at 0 V would meet: standing still is no way to pass.
    let text = step_scenario("aluminium-198x138", "", "", "metric = \"overshoot_percent\"\nat_most = 1000.0");
    let wrong = format!("{{ hold = [[0.0, 2.0], [10.0, {}.0], [11.0, 2.0]] }}", 900 + which);
    workshop.write_scenario("s.toml", &text.replace("setpoint_um = 2.0", &format!("setpoint_um = {wrong}")));
    let rig = format!("emulated:{}", workspace_root().join("firmware-under-test/images/planted-faults.elf").display());
    let record = run_and_read(&workshop, &["--rig", &rig], 1);
    assert_eq!(record.verdict, Verdict::Fail);
    let reason = record.scenarios[0].expectations[0].reason.as_ref().unwrap().to_string();
    assert!(reason.contains(function) && reason.contains("0x"), "{reason}");
    assert_eq!(record.scenarios[0].trials[0].cause, None, "the firmware's own doing");
}

#[rstest]
#[case::not_there("no-such.elf", "no-such.elf")]
#[case::not_an_elf("Cargo.toml", "not a firmware for the emulated board")]
fn rejects_a_file_without_firmware(#[case] elf: &str, #[case] told: &str) {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", SETTLING));
    let output =
        run_bench(workshop.path(), ["run", "--rig", &format!("emulated:{}", workspace_root().join(elf).display())]);
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{error}");
    assert!(error.contains(told), "{error}");
}
