//! A plate that the controller drives itself, over a pseudo-terminal: with and without somebody at it, and with what goes wrong.

use crate::test_folder::{ChildGuard, TestFolder, bench_command, exit_code, run_bench, send_signal, wait_until};
use platebench_record::{Cause, ClockKind, RealPlateRecord, RunRecord, TrialRecord, Verdict};
use platebench_trace::{Flags, Row};
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Output, Stdio};

/// A machine that is busy with something else costs a trial now and then, which then does not count.
const ATTEMPTS: u32 = 5;

const EXPECT: &str = "[[expect]]\nmetric = \"settling_time_ms\"\nat_most = 3.0\n\
    [[expect]]\nmetric = \"static_error_percent\"\nat_most = 1.0\nwindow_ms = 50.0\nover = \"each\"\n";
const STEP: &str = "setpoint_um = { hold = [[0.0, 0.0], [100.0, 2.0]] }";

/// `--rig` for the board with a plate of its own.
fn board_rig(wishes: &str) -> String {
    format!("exec:'{}' {{port}} {wishes}", env!("CARGO_BIN_EXE_real-plate-under-test"))
}

fn write_plate_scenario(workshop: &TestFolder, duration_ms: f64, profile: &str, expect: &str) {
    let text = format!(
        "title = \"real\"\nplate = \"plates/aluminium-198x138.toml\"\nduration_ms = {duration_ms:?}\n\
         [controller]\nlaw = \"dq-pi\"\n[profile]\n{profile}\n{expect}"
    );
    workshop.write_scenario("s.toml", &text);
}

fn run_on_board(workshop: &TestFolder, wishes: &str, arguments: &[&str]) -> (Output, RunRecord) {
    let out = workshop.path().join("run");
    let _ = fs::remove_dir_all(&out);
    let rig = board_rig(wishes);
    let fixed = ["run", "--plate-mode", "real", "--rig", &rig, "--out", "run"];
    let output = run_bench(workshop.path(), fixed.iter().chain(arguments));
    let record = RunRecord::read(&out).unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&output.stderr)));
    (output, record)
}

fn only_trial(record: &RunRecord) -> &TrialRecord {
    &record.scenarios[0].trials[0]
}

fn real_plate_record(record: &RunRecord) -> &RealPlateRecord {
    only_trial(record).telemetry.real_plate.as_ref().unwrap()
}

fn read_rows(workshop: &TestFolder, record: &RunRecord) -> Vec<Row> {
    platebench_trace::read_trace(&workshop.path().join("run").join(&only_trial(record).trace)).unwrap()
}

/// What `platebench judge` makes of the stored traces.
fn rejudge(workshop: &TestFolder) -> RunRecord {
    let again = run_bench(workshop.path(), ["judge", "run", "--format", "json"]);
    serde_json::from_slice(&again.stdout)
        .unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&again.stderr)))
}

#[test]
fn a_step_of_a_real_plate_is_recorded_judged_and_judged_again() {
    let workshop = TestFolder::new();
    let unseen = "[[expect]]\nmetric = \"frequency_error_hz\"\nat_most = 1.0\n";
    write_plate_scenario(&workshop, 300.0, STEP, &format!("{EXPECT}{unseen}"));
    for attempt in 1..=ATTEMPTS {
        let (output, record) = run_on_board(&workshop, "", &[]);
        let real = real_plate_record(&record);
        assert_eq!(record.clock, ClockKind::RealPlate);
        assert_ne!(record.verdict, Verdict::Fail, "{}", String::from_utf8_lossy(&output.stdout));
        let again = rejudge(&workshop);
        assert_eq!(again.scenarios[0].expectations, record.scenarios[0].expectations);
        if only_trial(&record).cause.is_some() && attempt < ATTEMPTS {
            continue;
        }
        assert_eq!(only_trial(&record).cause, None, "{:?}", only_trial(&record).reason);
        assert_eq!((real.missing, real.unacknowledged, real.safe_confirmed), (0, 0, true));
        assert!(real.periods >= 300 && real.setpoints >= 6 && real.acknowledged_us.is_some() && real.asked.is_empty());
        let [settled, error, unseen] = &record.scenarios[0].expectations[..] else { panic!() };
        assert_eq!((settled.verdict, error.verdict), (Verdict::Pass, Verdict::Pass), "{settled:?} {error:?}");
        // The law settles after 1.9 ms: between the samples at one and at two, as long as nobody knows more.
        assert_eq!(settled.interval, Some([1.0, 2.0]));
        assert!(settled.evidence.observed.as_deref().unwrap().contains("sensor"));
        assert_eq!((unseen.verdict, unseen.cause), (Verdict::Inconclusive, Some(Cause::Evidence)));
        assert_eq!(exit_code(&output), 3);
        let rows = read_rows(&workshop, &record);
        assert!(rows.iter().all(|row| row.flags.contains(Flags::SENSED) && row.resonance_hz.is_nan()));
        assert!(rows.iter().all(|row| row.wd_um == row.sensed_wd_um && row.finger_force_n == 0.0));
        assert!(rows.windows(2).all(|pair| ((pair[1].t_s - pair[0].t_s) * 1e3 - 1.0).abs() < 1e-6));
        assert_eq!(record.safe_confirmed, Some(true));
        return;
    }
}

#[rstest]
#[case::gap("skip=150", "no telemetry between 149 and 151 ms", 3)]
#[case::silence("mute=150", "the telemetry ends at 149 ms", 5)]
#[case::reset("reset=150", "the telemetry ends at 149 ms", 5)]
#[case::deaf("deaf=50", "a setpoint was not acknowledged by", 3)]
#[case::fast_clock("clock=2", "the controller's clock differs by", 3)]
#[case::slow_clock("clock=0.5", "the controller's clock differs by", 3)]
#[case::other_setpoint("hold=1.0", "the controller held a setpoint of 1 µm at 0 ms", 3)]
fn missing_telemetry_is_inconclusive(#[case] wishes: &str, #[case] reason: &str, #[case] expected: i32) {
    let workshop = TestFolder::new();
    write_plate_scenario(&workshop, 400.0, STEP, EXPECT);
    let (output, record) = run_on_board(&workshop, wishes, &[]);
    let trial = only_trial(&record);
    assert_eq!((record.verdict, trial.cause), (Verdict::Inconclusive, Some(Cause::Rig)), "{trial:?}");
    // On a busy machine an acknowledgement may be missed besides.
    let is_told = |what: &str| what.contains(reason) || what.contains("was not acknowledged");
    assert!(trial.reason.as_ref().is_some_and(|reason| is_told(&reason.to_string())), "{trial:?}");
    assert_eq!(exit_code(&output), expected, "{}", String::from_utf8_lossy(&output.stderr));
    if wishes == "skip=150" {
        assert_eq!(real_plate_record(&record).missing, 1);
    }
    if wishes == "reset=150" {
        assert!(trial.telemetry.ended.as_deref().is_some_and(|ended| ended.contains("restarted")), "{trial:?}");
    }
    assert_eq!(rejudge(&workshop).verdict, Verdict::Inconclusive);
}

#[rstest]
#[case::by_itself("stop=150")]
#[case::trap("trap=150")]
fn a_controller_that_stops_fails(#[case] wishes: &str) {
    let workshop = TestFolder::new();
    write_plate_scenario(&workshop, 400.0, STEP, EXPECT);
    for attempt in 1..=ATTEMPTS {
        let (output, record) = run_on_board(&workshop, wishes, &[]);
        if only_trial(&record).cause.is_some() && attempt < ATTEMPTS {
            continue;
        }
        assert_eq!((record.verdict, exit_code(&output)), (Verdict::Fail, 1), "{:?}", only_trial(&record));
        let last = *read_rows(&workshop, &record).last().unwrap();
        assert!(last.flags.contains(Flags::SAFE) && last.drive_vpp == 0.0, "{last:?}");
        assert_eq!(rejudge(&workshop).verdict, Verdict::Fail);
        return;
    }
}

#[rstest]
#[case::hosted("hosted", &[], "--plate-mode real is for a controller that drives its own plate")]
#[case::emulated("emulated", &[], "--plate-mode real is for a controller that drives its own plate")]
#[case::lockstep("serial:/dev/null", &["--clock", "lockstep"], "controller's own clock")]
#[case::scaled("serial:/dev/null", &["--time-scale", "0.1"], "controller's own clock")]
fn a_real_plate_needs_a_line_and_its_own_clock(#[case] rig: &str, #[case] more: &[&str], #[case] reason: &str) {
    let workshop = TestFolder::new();
    write_plate_scenario(&workshop, 400.0, STEP, EXPECT);
    let output = run_bench(workshop.path(), ["run", "--plate-mode", "real", "--rig", rig].iter().chain(more));
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{said}");
    assert!(said.contains(reason), "{said}");
}

#[test]
fn rejects_a_board_without_a_plate_and_line_faults() {
    let workshop = TestFolder::new();
    write_plate_scenario(&workshop, 400.0, STEP, EXPECT);
    let refused = |rig: &str, reason: &str| {
        let output = run_bench(workshop.path(), ["run", "--plate-mode", "real", "--rig", rig, "--out", "refused"]);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(exit_code(&output), 2, "{said}");
        assert!(said.contains(reason), "{said}");
    };
    refused(&board_rig("capability=no"), "does not announce that it drives its own plate");
    let fault = "[[fault]]\nkind = \"drop\"\nfrom_ms = 30.0\nuntil_ms = 34.0\n";
    write_plate_scenario(&workshop, 400.0, STEP, &format!("{EXPECT}{fault}"));
    refused(&board_rig(""), "expected no [[fault]]");
}

/// Under a finger of 1 N and 2 K above the reference.
const TOUCHED_PROFILE: &str =
    "setpoint_um = { hold = [[0.0, 0.0], [100.0, 1.0]] }\nfinger_force_n = 1.0\ntemperature_offset_k = 2.0";
const STATIC_ERROR: &str =
    "[[expect]]\nmetric = \"static_error_percent\"\nat_most = 1.0\nwindow_ms = 50.0\nover = \"each\"\n";

#[rstest]
#[case::not_asked(&["--yes"])]
#[case::no_input(&[])]
fn without_an_operator_manual_steps_are_inconclusive(#[case] more: &[&str]) {
    let workshop = TestFolder::new();
    write_plate_scenario(&workshop, 300.0, TOUCHED_PROFILE, STATIC_ERROR);
    let mut bench = bench_command(workshop.path());
    let rig = board_rig("");
    bench.args(["run", "--plate-mode", "real", "--rig", &rig, "--out", "run"]).args(more).stdin(Stdio::null());
    let output = bench.output().unwrap();
    let record = RunRecord::read(&workshop.path().join("run")).unwrap();
    assert_eq!((record.verdict, exit_code(&output)), (Verdict::Inconclusive, 3));
    let trial = only_trial(&record);
    assert_eq!(trial.cause, Some(Cause::Rig));
    assert!(trial.reason.as_ref().unwrap().to_string().contains("no operator was present"), "{trial:?}");
    assert_eq!(rejudge(&workshop).verdict, Verdict::Inconclusive);
}

/// A person who does what `hand` says to a prompt, and what came of it. `hand` gets the prompt and writes the surroundings.
fn run_with_operator(
    workshop: &TestFolder,
    wishes: &str,
    mut hand: impl FnMut(&str, &Path),
) -> (i32, RunRecord, Vec<String>) {
    let _ = fs::remove_dir_all(workshop.path().join("run"));
    let surroundings = workshop.path().join("surroundings");
    fs::write(&surroundings, "0 0").unwrap();
    let rig = board_rig(&format!("'surroundings={}' {wishes}", surroundings.display()));
    let mut bench = bench_command(workshop.path());
    bench.args(["run", "--plate-mode", "real", "--rig", &rig, "--out", "run"]);
    let bench = bench.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut bench = ChildGuard(bench);
    let mut answers = bench.0.stdin.take().unwrap();
    let mut said = Vec::new();
    for line in BufReader::new(bench.0.stderr.take().unwrap()).lines() {
        let line = line.unwrap();
        if line.starts_with("please ") || line.starts_with("now: ") {
            hand(&line, &surroundings);
        }
        if line.starts_with("please ") {
            answers.write_all(b"\n").unwrap();
        }
        said.push(line);
    }
    let code = bench.0.wait().unwrap().code().unwrap();
    (code, RunRecord::read(&workshop.path().join("run")).unwrap(), said)
}

#[test]
fn an_operator_warms_and_presses_the_plate() {
    let workshop = TestFolder::new();
    write_plate_scenario(&workshop, 300.0, TOUCHED_PROFILE, STATIC_ERROR);
    for attempt in 1..=ATTEMPTS {
        let (code, record, said) = run_with_operator(&workshop, "", |prompt, surroundings| {
            if prompt.contains("26 °C") {
                fs::write(surroundings, "0 2").unwrap();
            } else if prompt.contains("1 N") {
                fs::write(surroundings, "1.1 2").unwrap();
            }
        });
        if only_trial(&record).cause.is_some() && attempt < ATTEMPTS {
            continue;
        }
        assert_eq!((record.verdict, code), (Verdict::Pass, 0), "{:?}\n{said:#?}", only_trial(&record));
        let asked: Vec<_> =
            real_plate_record(&record).asked.iter().map(|asked| (asked.what.as_str(), asked.done)).collect();
        assert_eq!(asked, [("bring the plate to 26 °C (+2 K)", true), ("press the plate with 1 N and hold", true)]);
        assert!(said.iter().any(|line| line == "in 3 s: the trial starts"), "{said:#?}");
        let rows = read_rows(&workshop, &record);
        assert!(rows.iter().all(|row| (row.finger_force_n - 1.1).abs() < 1e-6 && row.temperature_offset_k.is_nan()));
        return;
    }
}

#[test]
fn a_measured_force_contradicts_a_false_confirmation() {
    let workshop = TestFolder::new();
    write_plate_scenario(&workshop, 300.0, TOUCHED_PROFILE, STATIC_ERROR);
    let (code, record, _) = run_with_operator(&workshop, "", |_, _| {});
    assert_eq!((record.verdict, code), (Verdict::Inconclusive, 3));
    let trial = only_trial(&record);
    assert_eq!(trial.cause, Some(Cause::Rig));
    assert!(
        trial.reason.as_ref().unwrap().to_string().starts_with("the finger pressed with 0.00 N at 0 ms"),
        "{trial:?}"
    );
}

#[test]
fn a_finger_within_the_trial_has_a_countdown() {
    let workshop = TestFolder::new();
    let profile = "setpoint_um = 1.0\nfinger_force_n = { hold = [[0.0, 0.0], [1500.0, 1.0]] }";
    write_plate_scenario(&workshop, 3_000.0, profile, STATIC_ERROR);
    for attempt in 1..=ATTEMPTS {
        let (code, record, said) = run_with_operator(&workshop, "", |prompt, surroundings| {
            if prompt == "now: press the plate with 1 N and hold" {
                fs::write(surroundings, "1.0 0").unwrap();
            }
        });
        if only_trial(&record).cause.is_some() && attempt < ATTEMPTS {
            continue;
        }
        assert_eq!((record.verdict, code), (Verdict::Pass, 0), "{:?}\n{said:#?}", only_trial(&record));
        assert!(said.iter().any(|line| line == "in 1 s: press the plate with 1 N and hold"), "{said:#?}");
        let rows = read_rows(&workshop, &record);
        assert_eq!((rows[0].finger_force_n, rows.last().unwrap().finger_force_n), (0.0, 1.0));
        return;
    }
}

#[rstest]
#[case::interrupt("INT", 130)]
#[case::terminate("TERM", 143)]
fn a_signal_puts_the_real_plate_at_0_v(#[case] name: &str, #[case] expected: i32) {
    let workshop = TestFolder::new();
    write_plate_scenario(&workshop, 60_000.0, STEP, EXPECT);
    let log = workshop.path().join("log");
    let rig = board_rig(&format!("'log={}'", log.display()));
    let mut bench = bench_command(workshop.path());
    bench.args(["run", "--plate-mode", "real", "--rig", &rig, "--out", "run"]);
    let bench = bench.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let states = || fs::read_to_string(&log).unwrap_or_default();
    wait_until("the board never drove its plate", || states().contains("Running"));
    send_signal(&bench, name);
    let output = bench.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(expected), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(states().trim_end().ends_with("Safe 0"), "{}", states());
    let record: Value =
        serde_json::from_str(&fs::read_to_string(workshop.path().join("run/run.json")).unwrap()).unwrap();
    assert_eq!((&record["safe_confirmed"], &record["complete"]), (&Value::Bool(true), &Value::Bool(false)));
}

#[test]
fn after_a_killed_bench_the_board_s_watchdog_acts() {
    let workshop = TestFolder::new();
    write_plate_scenario(&workshop, 60_000.0, STEP, EXPECT);
    let log = workshop.path().join("log");
    let rig = board_rig(&format!("'log={}'", log.display()));
    let mut bench = bench_command(workshop.path());
    bench.args(["run", "--plate-mode", "real", "--rig", &rig, "--out", "run"]);
    let mut bench = ChildGuard(bench.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
    let states = || fs::read_to_string(&log).unwrap_or_default();
    wait_until("the board never drove its plate", || states().contains("Running"));
    // Stopped, not ended, so that the line stays open.
    send_signal(&bench.0, "STOP");
    wait_until("the board drives on without setpoints", || states().trim_end().ends_with("Fault 0"));
    bench.0.kill().unwrap();
}
