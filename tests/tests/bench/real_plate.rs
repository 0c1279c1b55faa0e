//! A plate that the controller drives itself, over a pseudo-terminal: with and without somebody at it, and with what goes wrong.

use crate::bench::{Guarded, Workshop, await_that, call, code, program, signal};
use platebench_trace::{Flags, Row};
use platebench_verdict::record::RealPlate;
use platebench_verdict::{Cause, RunRecord, TrialRecord, Verdict};
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
fn board(wishes: &str) -> String {
    format!("exec:'{}' {{port}} {wishes}", env!("CARGO_BIN_EXE_real-plate-under-test"))
}

fn scenario(workshop: &Workshop, duration_ms: f64, profile: &str, expect: &str) {
    let text = format!(
        "title = \"real\"\nplate = \"plates/aluminium-198x138.toml\"\nduration_ms = {duration_ms:?}\n\
         [controller]\nlaw = \"dq-pi\"\n[profile]\n{profile}\n{expect}"
    );
    workshop.scenario("s.toml", &text);
}

fn played(workshop: &Workshop, wishes: &str, arguments: &[&str]) -> (Output, RunRecord) {
    let out = workshop.path().join("run");
    let _ = fs::remove_dir_all(&out);
    let rig = board(wishes);
    let fixed = ["run", "--plate-mode", "real", "--rig", &rig, "--out", "run"];
    let output = call(workshop.path(), fixed.iter().chain(arguments));
    let record = RunRecord::read(&out).unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&output.stderr)));
    (output, record)
}

fn trial(record: &RunRecord) -> &TrialRecord {
    &record.scenarios[0].trials[0]
}

fn told(record: &RunRecord) -> &RealPlate {
    trial(record).telemetry.real_plate.as_ref().unwrap()
}

fn rows(workshop: &Workshop, record: &RunRecord) -> Vec<Row> {
    platebench_trace::read(&workshop.path().join("run").join(&trial(record).trace)).unwrap()
}

/// What `platebench judge` makes of the stored traces.
fn judged_again(workshop: &Workshop) -> RunRecord {
    let again = call(workshop.path(), ["judge", "run", "--format", "json"]);
    serde_json::from_slice(&again.stdout)
        .unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&again.stderr)))
}

#[test]
fn a_step_of_a_real_plate_is_recorded_judged_and_judged_again() {
    let workshop = Workshop::new();
    let unseen = "[[expect]]\nmetric = \"frequency_error_hz\"\nat_most = 1.0\n";
    scenario(&workshop, 300.0, STEP, &format!("{EXPECT}{unseen}"));
    for attempt in 1..=ATTEMPTS {
        let (output, record) = played(&workshop, "", &[]);
        let real = told(&record);
        assert_eq!(record.clock, "real-plate");
        assert_ne!(record.verdict, Verdict::Fail, "{}", String::from_utf8_lossy(&output.stdout));
        let again = judged_again(&workshop);
        assert_eq!(again.scenarios[0].expectations, record.scenarios[0].expectations);
        if trial(&record).cause.is_some() && attempt < ATTEMPTS {
            continue;
        }
        assert_eq!(trial(&record).cause, None, "{:?}", trial(&record).reason);
        assert_eq!((real.missing, real.unacknowledged, real.safe_confirmed), (0, 0, true));
        assert!(real.periods >= 300 && real.setpoints >= 6 && real.acknowledged_us.is_some() && real.asked.is_empty());
        let [settled, error, unseen] = &record.scenarios[0].expectations[..] else { panic!() };
        assert_eq!((settled.verdict, error.verdict), (Verdict::Pass, Verdict::Pass), "{settled:?} {error:?}");
        // The law settles after 1.9 ms: between the samples at one and at two, as long as nobody knows more.
        assert_eq!(settled.interval, Some([1.0, 2.0]));
        assert!(settled.evidence.observed.as_deref().unwrap().contains("sensor"));
        assert_eq!((unseen.verdict, unseen.cause), (Verdict::Inconclusive, Some(Cause::Evidence)));
        assert_eq!(code(&output), 3);
        let rows = rows(&workshop, &record);
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
#[case::fast_clock("clock=2", "the controller's clock runs", 3)]
#[case::slow_clock("clock=0.5", "the controller's clock runs", 3)]
#[case::other_setpoint("hold=1.0", "the controller held a setpoint of 1 µm at 0 ms", 3)]
fn what_was_not_heard_is_no_verdict(#[case] wishes: &str, #[case] reason: &str, #[case] expected: i32) {
    let workshop = Workshop::new();
    scenario(&workshop, 400.0, STEP, EXPECT);
    let (output, record) = played(&workshop, wishes, &[]);
    let trial = trial(&record);
    assert_eq!((record.verdict, trial.cause), (Verdict::Inconclusive, Some(Cause::Rig)), "{trial:?}");
    // On a busy machine an acknowledgement may be missed besides.
    let is_told = |what: &str| what.contains(reason) || what.contains("was not acknowledged");
    assert!(trial.reason.as_deref().is_some_and(is_told), "{trial:?}");
    assert_eq!(code(&output), expected, "{}", String::from_utf8_lossy(&output.stderr));
    if wishes == "skip=150" {
        assert_eq!(told(&record).missing, 1);
    }
    if wishes == "reset=150" {
        assert!(trial.telemetry.ended.as_deref().is_some_and(|ended| ended.contains("restarted")), "{trial:?}");
    }
    assert_eq!(judged_again(&workshop).verdict, Verdict::Inconclusive);
}

#[rstest]
#[case::by_itself("stop=150")]
#[case::trap("trap=150")]
fn a_controller_that_gives_up_fails(#[case] wishes: &str) {
    let workshop = Workshop::new();
    scenario(&workshop, 400.0, STEP, EXPECT);
    for attempt in 1..=ATTEMPTS {
        let (output, record) = played(&workshop, wishes, &[]);
        if trial(&record).cause.is_some() && attempt < ATTEMPTS {
            continue;
        }
        assert_eq!((record.verdict, code(&output)), (Verdict::Fail, 1), "{:?}", trial(&record));
        let last = *rows(&workshop, &record).last().unwrap();
        assert!(last.flags.contains(Flags::SAFE) && last.drive_vpp == 0.0, "{last:?}");
        assert_eq!(judged_again(&workshop).verdict, Verdict::Fail);
        return;
    }
}

#[rstest]
#[case::hosted("hosted", &[], "--plate-mode real is for a controller with a plate of its own")]
#[case::emulated("emulated", &[], "--plate-mode real is for a controller with a plate of its own")]
#[case::lockstep("serial:/dev/null", &["--clock", "lockstep"], "controller's own clock")]
#[case::scaled("serial:/dev/null", &["--time-scale", "0.1"], "controller's own clock")]
fn a_real_plate_needs_a_line_and_its_own_clock(#[case] rig: &str, #[case] more: &[&str], #[case] reason: &str) {
    let workshop = Workshop::new();
    scenario(&workshop, 400.0, STEP, EXPECT);
    let output = call(workshop.path(), ["run", "--plate-mode", "real", "--rig", rig].iter().chain(more));
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(code(&output), 2, "{said}");
    assert!(said.contains(reason), "{said}");
}

#[test]
fn a_controller_without_a_plate_and_a_scenario_with_faults_are_refused() {
    let workshop = Workshop::new();
    scenario(&workshop, 400.0, STEP, EXPECT);
    let refused = |rig: &str, reason: &str| {
        let output = call(workshop.path(), ["run", "--plate-mode", "real", "--rig", rig, "--out", "refused"]);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(code(&output), 2, "{said}");
        assert!(said.contains(reason), "{said}");
    };
    refused(&board("capability=no"), "does not say that it drives a plate of its own");
    let fault = "[[fault]]\nkind = \"drop\"\nfrom_ms = 30.0\nuntil_ms = 34.0\n";
    scenario(&workshop, 400.0, STEP, &format!("{EXPECT}{fault}"));
    refused(&board(""), "expected no [[fault]]");
}

/// Under a finger of 1 N and 2 K above the reference.
const TOUCHED: &str =
    "setpoint_um = { hold = [[0.0, 0.0], [100.0, 1.0]] }\nfinger_force_n = 1.0\ntemperature_offset_k = 2.0";
const HOLDS: &str = "[[expect]]\nmetric = \"static_error_percent\"\nat_most = 1.0\nwindow_ms = 50.0\nover = \"each\"\n";

#[rstest]
#[case::not_asked(&["--yes"])]
#[case::no_input(&[])]
fn without_a_person_what_needs_one_is_never_decided(#[case] more: &[&str]) {
    let workshop = Workshop::new();
    scenario(&workshop, 300.0, TOUCHED, HOLDS);
    let mut bench = program(workshop.path());
    let rig = board("");
    bench.args(["run", "--plate-mode", "real", "--rig", &rig, "--out", "run"]).args(more).stdin(Stdio::null());
    let output = bench.output().unwrap();
    let record = RunRecord::read(&workshop.path().join("run")).unwrap();
    assert_eq!((record.verdict, code(&output)), (Verdict::Inconclusive, 3));
    let trial = trial(&record);
    assert_eq!(trial.cause, Some(Cause::Rig));
    assert!(trial.reason.as_deref().unwrap().starts_with("nobody was there"), "{trial:?}");
    assert_eq!(judged_again(&workshop).verdict, Verdict::Inconclusive);
}

/// A person who does what `hand` says to a prompt, and what came of it. `hand` gets the prompt and writes the surroundings.
fn attended(workshop: &Workshop, wishes: &str, mut hand: impl FnMut(&str, &Path)) -> (i32, RunRecord, Vec<String>) {
    let _ = fs::remove_dir_all(workshop.path().join("run"));
    let surroundings = workshop.path().join("surroundings");
    fs::write(&surroundings, "0 0").unwrap();
    let rig = board(&format!("'surroundings={}' {wishes}", surroundings.display()));
    let mut bench = program(workshop.path());
    bench.args(["run", "--plate-mode", "real", "--rig", &rig, "--out", "run"]);
    let bench = bench.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut bench = Guarded(bench);
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
fn a_person_warms_and_presses_and_the_force_is_measured() {
    let workshop = Workshop::new();
    scenario(&workshop, 300.0, TOUCHED, HOLDS);
    for attempt in 1..=ATTEMPTS {
        let (code, record, said) = attended(&workshop, "", |prompt, surroundings| {
            if prompt.contains("26 °C") {
                fs::write(surroundings, "0 2").unwrap();
            } else if prompt.contains("1 N") {
                fs::write(surroundings, "1.1 2").unwrap();
            }
        });
        if trial(&record).cause.is_some() && attempt < ATTEMPTS {
            continue;
        }
        assert_eq!((record.verdict, code), (Verdict::Pass, 0), "{:?}\n{said:#?}", trial(&record));
        let asked: Vec<_> = told(&record).asked.iter().map(|asked| (asked.what.as_str(), asked.done)).collect();
        assert_eq!(asked, [("bring the plate to 26 °C (+2 K)", true), ("press the plate with 1 N and hold", true)]);
        assert!(said.iter().any(|line| line == "in 3 s: the trial starts"), "{said:#?}");
        let rows = rows(&workshop, &record);
        assert!(rows.iter().all(|row| (row.finger_force_n - 1.1).abs() < 1e-6 && row.temperature_offset_k.is_nan()));
        return;
    }
}

#[test]
fn a_person_who_says_so_and_does_not_press_is_seen_where_the_force_is_measured() {
    let workshop = Workshop::new();
    scenario(&workshop, 300.0, TOUCHED, HOLDS);
    let (code, record, _) = attended(&workshop, "", |_, _| {});
    assert_eq!((record.verdict, code), (Verdict::Inconclusive, 3));
    let trial = trial(&record);
    assert_eq!(trial.cause, Some(Cause::Rig));
    assert!(trial.reason.as_deref().unwrap().starts_with("the finger pressed with 0.00 N at 0 ms"), "{trial:?}");
}

#[test]
fn a_finger_that_comes_within_the_trial_is_counted_down() {
    let workshop = Workshop::new();
    let profile = "setpoint_um = 1.0\nfinger_force_n = { hold = [[0.0, 0.0], [1500.0, 1.0]] }";
    scenario(&workshop, 3_000.0, profile, HOLDS);
    for attempt in 1..=ATTEMPTS {
        let (code, record, said) = attended(&workshop, "", |prompt, surroundings| {
            if prompt == "now: press the plate with 1 N and hold" {
                fs::write(surroundings, "1.0 0").unwrap();
            }
        });
        if trial(&record).cause.is_some() && attempt < ATTEMPTS {
            continue;
        }
        assert_eq!((record.verdict, code), (Verdict::Pass, 0), "{:?}\n{said:#?}", trial(&record));
        assert!(said.iter().any(|line| line == "in 1 s: press the plate with 1 N and hold"), "{said:#?}");
        let rows = rows(&workshop, &record);
        assert_eq!((rows[0].finger_force_n, rows.last().unwrap().finger_force_n), (0.0, 1.0));
        return;
    }
}

#[rstest]
#[case::interrupt("INT", 130)]
#[case::terminate("TERM", 143)]
fn a_polite_end_puts_the_real_plate_at_0_v(#[case] name: &str, #[case] expected: i32) {
    let workshop = Workshop::new();
    scenario(&workshop, 60_000.0, STEP, EXPECT);
    let log = workshop.path().join("log");
    let rig = board(&format!("'log={}'", log.display()));
    let mut bench = program(workshop.path());
    bench.args(["run", "--plate-mode", "real", "--rig", &rig, "--out", "run"]);
    let bench = bench.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let states = || fs::read_to_string(&log).unwrap_or_default();
    await_that("the board never drove its plate", || states().contains("Running"));
    signal(&bench, name);
    let output = bench.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(expected), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(states().trim_end().ends_with("Safe 0"), "{}", states());
    let record: Value =
        serde_json::from_str(&fs::read_to_string(workshop.path().join("run/run.json")).unwrap()).unwrap();
    assert_eq!((&record["safe_confirmed"], &record["complete"]), (&Value::Bool(true), &Value::Bool(false)));
}

#[test]
fn a_bench_that_is_killed_leaves_the_board_s_own_patience() {
    let workshop = Workshop::new();
    scenario(&workshop, 60_000.0, STEP, EXPECT);
    let log = workshop.path().join("log");
    let rig = board(&format!("'log={}'", log.display()));
    let mut bench = program(workshop.path());
    bench.args(["run", "--plate-mode", "real", "--rig", &rig, "--out", "run"]);
    let mut bench = Guarded(bench.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
    let states = || fs::read_to_string(&log).unwrap_or_default();
    await_that("the board never drove its plate", || states().contains("Running"));
    // Stopped, not ended, so that the line stays open.
    signal(&bench.0, "STOP");
    await_that("the board drives on without setpoints", || states().trim_end().ends_with("Fault 0"));
    bench.0.kill().unwrap();
}
