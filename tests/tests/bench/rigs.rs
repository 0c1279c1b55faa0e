//! The same scenarios on the hosted and on the emulated rig, and what only the emulated one can show.

use crate::bench::{Workshop, call, code, root, step_scenario};
use platebench_verdict::{Cause, RunRecord, Verdict};
use rstest::rstest;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

fn traces_below(folder: &Path, found: &mut BTreeMap<PathBuf, Vec<u8>>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            traces_below(&path, found);
        } else {
            found.insert(path.clone(), fs::read(&path).unwrap());
        }
    }
}

/// Every trace of a run by its path below the run folder.
fn traces(run: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    traces_below(&run.join("traces"), &mut found);
    found.into_iter().map(|(path, bytes)| (path.strip_prefix(run).unwrap().to_owned(), bytes)).collect()
}

#[rstest]
#[case::own_laws(&[])]
#[case::dq_pi(&["--law", "dq-pi"])]
#[case::dq_pi_euler(&["--law", "dq-pi-euler"])]
#[case::open_loop(&["--law", "open-loop"])]
fn the_firmware_image_gives_the_hosted_controller_s_traces_byte_for_byte(#[case] law: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let scenarios = ["paper", "limits"].map(|part| root().join("scenarios").join(part).to_str().unwrap().to_owned());
    for rig in ["hosted", "emulated"] {
        let arguments = ["run", &scenarios[0], &scenarios[1], "--rig", rig, "--out", rig, "--trials", "2"];
        call(folder.path(), arguments.iter().chain(law));
    }
    let hosted = traces(&folder.path().join("hosted"));
    let emulated = traces(&folder.path().join("emulated"));
    assert!(hosted.len() > 20, "{} traces", hosted.len());
    assert_eq!(hosted.keys().collect::<Vec<_>>(), emulated.keys().collect::<Vec<_>>());
    for (path, bytes) in &hosted {
        assert!(emulated[path] == *bytes, "{} differs", path.display());
    }
}

const SETTLING: &str = "metric = \"settling_time_ms\"\nat_most = 2.0";

fn record(workshop: &Workshop, arguments: &[&str], expected: i32) -> RunRecord {
    let out = tempfile::tempdir_in(workshop.path()).unwrap();
    let output = call(workshop.path(), ["run", "--out", out.path().to_str().unwrap()].iter().chain(arguments));
    assert_eq!(code(&output), expected, "{}", String::from_utf8_lossy(&output.stderr));
    RunRecord::read(out.path()).unwrap()
}

#[test]
fn wire_and_computing_time_act_only_where_they_are_asked_to() {
    let workshop = Workshop::new();
    // A law whose longest step does not depend on what it is shown.
    workshop.scenario("s.toml", &step_scenario("aluminium-198x138", "law = \"dq-pi-fixed\"", "", SETTLING));
    let transparent = record(&workshop, &["--rig", "emulated"], 0);
    let wired = record(&workshop, &["--rig", "emulated", "--wire-time"], 1);
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
fn instructions_can_be_limited_where_they_are_counted() {
    let workshop = Workshop::new();
    let limit = |at_most: u32| {
        let expect = format!("metric = \"instructions_per_step\"\nat_most = {at_most}.0");
        workshop.scenario("s.toml", &step_scenario("aluminium-198x138", "", "", &expect));
    };
    limit(168_000);
    let counted = record(&workshop, &["--rig", "emulated"], 0).scenarios[0].expectations[0].value.unwrap();
    assert!((500.0..20_000.0).contains(&counted), "{counted}");
    limit(counted as u32 - 1);
    record(&workshop, &["--rig", "emulated"], 1);
    let hosted = record(&workshop, &["--rig", "hosted"], 3);
    assert_eq!(hosted.scenarios[0].expectations[0].cause, Some(Cause::Evidence));
}

/// `firmware-under-test/stm32f4/src/plant.rs`: a setpoint of 900 + n µm makes the firmware do wrong number n.
#[rstest]
#[case::unaligned_access(1, "plant::unaligned_access")]
#[case::division_by_zero(2, "plant::division_by_zero")]
#[case::endless_loop(3, "plant::endless_loop")]
#[case::stack_overflow(4, "plant::stack_overflow")]
#[case::undefined_instruction(5, "plant::undefined_instruction")]
#[case::unmodelled_peripheral(9, "plant::unmodelled_peripheral")]
fn a_firmware_that_traps_fails_with_function_and_address(#[case] which: u32, #[case] function: &str) {
    let workshop = Workshop::new();
    // An expectation that a plate at 0 V would meet: standing still is no way to pass.
    let text = step_scenario("aluminium-198x138", "", "", "metric = \"overshoot_percent\"\nat_most = 1000.0");
    let wrong = format!("{{ hold = [[0.0, 2.0], [10.0, {}.0], [11.0, 2.0]] }}", 900 + which);
    workshop.scenario("s.toml", &text.replace("setpoint_um = 2.0", &format!("setpoint_um = {wrong}")));
    let rig = format!("emulated:{}", root().join("firmware-under-test/images/planted-faults.elf").display());
    let record = record(&workshop, &["--rig", &rig], 1);
    assert_eq!(record.verdict, Verdict::Fail);
    let reason = record.scenarios[0].expectations[0].reason.as_ref().unwrap();
    assert!(reason.contains(function) && reason.contains("0x"), "{reason}");
    assert_eq!(record.scenarios[0].trials[0].cause, None, "the firmware's own doing");
}

#[rstest]
#[case::not_there("no-such.elf", "no-such.elf")]
#[case::not_an_elf("Cargo.toml", "no firmware for the emulated board")]
fn what_is_no_firmware_is_refused(#[case] elf: &str, #[case] told: &str) {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step_scenario("aluminium-198x138", "", "", SETTLING));
    let output = call(workshop.path(), ["run", "--rig", &format!("emulated:{}", root().join(elf).display())]);
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(code(&output), 2, "{error}");
    assert!(error.contains(told), "{error}");
}
