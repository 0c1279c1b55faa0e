//! Tests `--plate-mode real` with a simulated board and plate, with and without an operator.

use crate::test_folder::{ChildGuard, PLATE, ProgramOutput, TestFolder, bench_command, start_bench, wait_until};
use platebench_model::record::{Cause, ClockKind, RealPlateRecord, RunRecord, TrialRecord, Verdict};
use platebench_model::trace::{Flags, Row};
use rstest::rstest;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::Stdio;

/// On a busy machine the bench may exclude a trial; the test then tries again, at most this often, and
/// prints how often.
const ATTEMPTS: u32 = 5;

const EXPECT: &str = "[[expect]]\nmetric = \"settling_time_ms\"\nat_most = 3.0\n\
    [[expect]]\nmetric = \"static_error_percent\"\nat_most = 1.0\nwindow_ms = 50.0\nover = \"each\"\n";
const STEP: &str = "setpoint_um = { hold = [[0.0, 0.0], [100.0, 2.0]] }";
const RUN: [&str; 6] = ["run", "--plate-mode", "real", "--out", "run", "--rig"];

fn board_rig(options: &str) -> String {
    format!("exec:'{}' {{port}} {options}", env!("CARGO_BIN_EXE_real-plate-under-test"))
}

fn plate_folder(duration_ms: f64, profile: &str, expect: &str) -> TestFolder {
    let plate = Path::new(PLATE).strip_prefix("scenarios").unwrap().display();
    TestFolder::with_scenario(&format!(
        "title = \"real\"\nplate = \"{plate}\"\nduration_ms = {duration_ms:?}\n\
         [controller]\nlaw = \"dq-pi\"\n[profile]\n{profile}\n{expect}"
    ))
}

#[track_caller]
fn run_on_board(folder: &TestFolder, options: &str) -> (ProgramOutput, RunRecord) {
    let _ = fs::remove_dir_all(folder.join("run"));
    let output = folder.bench(RUN.iter().chain(&[&*board_rig(options)]));
    let record = RunRecord::read(&folder.join("run")).unwrap_or_else(|_| panic!("{}", output.stderr));
    (output, record)
}

fn only_trial(record: &RunRecord) -> &TrialRecord {
    &record.scenarios[0].trials[0]
}

fn real_plate_record(record: &RunRecord) -> &RealPlateRecord {
    only_trial(record).telemetry.real_plate.as_ref().unwrap()
}

fn read_rows(folder: &TestFolder, record: &RunRecord) -> Vec<Row> {
    folder.rows("run", only_trial(record))
}

fn repeat_until_counted<T>(run: impl FnMut() -> (T, RunRecord)) -> (T, RunRecord) {
    repeat_until(run, |_| true)
}

/// Repeats trials that are excluded, or that a stalled host disturbed.
fn repeat_until<T>(mut run: impl FnMut() -> (T, RunRecord), is_undisturbed: fn(&RunRecord) -> bool) -> (T, RunRecord) {
    let mut last = run();
    let mut attempts = 1;
    while attempts < ATTEMPTS && (only_trial(&last.1).cause.is_some() || !is_undisturbed(&last.1)) {
        println!("attempt {attempts} of {ATTEMPTS} does not count: {:?}", only_trial(&last.1).reason);
        last = run();
        attempts += 1;
    }
    println!("{attempts} of {ATTEMPTS} attempts");
    last
}

#[track_caller]
fn rejudge(folder: &TestFolder) -> RunRecord {
    serde_json::from_value(folder.bench(["report", "run", "--rejudge", "--format", "json"]).json()).unwrap()
}

#[test]
fn a_step_of_a_real_plate_is_recorded_and_judged() {
    let unmeasured = "[[expect]]\nmetric = \"frequency_error_hz\"\nat_most = 1.0\n";
    let folder = plate_folder(300.0, STEP, &format!("{EXPECT}{unmeasured}"));
    // A setpoint is repeated every 50 ms, unless the host stalls.
    let all_repeated = |record: &RunRecord| real_plate_record(record).setpoints >= 6;
    let play = || {
        let (output, record) = run_on_board(&folder, "");
        assert_eq!(record.clock, ClockKind::RealPlate);
        assert_ne!(record.verdict, Verdict::Fail, "{}", output.stdout);
        assert_eq!(rejudge(&folder).scenarios[0].expectations, record.scenarios[0].expectations);
        (output, record)
    };
    let (output, record) = repeat_until(play, all_repeated);
    assert_eq!(only_trial(&record).cause, None, "{:?}", only_trial(&record).reason);
    let real = real_plate_record(&record);
    assert_eq!((real.missing, real.unacknowledged, real.safe_confirmed), (0, 0, true));
    assert!(real.periods >= 300 && real.setpoints >= 6 && real.acknowledged_us.is_some() && real.asked.is_empty());
    let [settling, error, unmeasured] = &record.scenarios[0].expectations[..] else { panic!() };
    assert_eq!((settling.verdict, error.verdict), (Verdict::Pass, Verdict::Pass), "{settling:?} {error:?}");
    // The plate settles after 1.9 ms, between two samples, so the result is an interval.
    assert_eq!(settling.interval, Some([1.0, 2.0]));
    assert!(settling.evidence.observed.as_deref().unwrap().contains("sensor"));
    assert_eq!((unmeasured.verdict, unmeasured.cause), (Verdict::Inconclusive, Some(Cause::Evidence)));
    output.assert_exit(3);
    let rows = read_rows(&folder, &record);
    assert!(rows.iter().all(|row| row.flags.contains(Flags::SENSED) && row.resonance_hz.is_nan()));
    assert!(rows.iter().all(|row| row.wd_um == row.sensed_wd_um && row.finger_force_n == 0.0));
    assert!(rows.windows(2).all(|pair| ((pair[1].t_s - pair[0].t_s) * 1e3 - 1.0).abs() < 1e-6));
    assert_eq!(record.safe_confirmed, Some(true));
}

#[rstest]
#[case::gap("skip=150", "no telemetry between 149 and 151 ms", 3)]
#[case::silence("mute=150", "the telemetry ends at 149 ms", 5)]
#[case::reset("reset=150", "the telemetry ends at 149 ms", 5)]
#[case::deaf("deaf=50", "a setpoint was not acknowledged by", 3)]
#[case::fast_clock("clock=2", "the controller's clock differs by", 3)]
#[case::slow_clock("clock=0.5", "the controller's clock differs by", 3)]
#[case::other_setpoint("hold=1.0", "the controller held a setpoint of 1 µm at 0 ms", 3)]
fn missing_telemetry_is_inconclusive(#[case] options: &str, #[case] reason: &str, #[case] expected: i32) {
    let folder = plate_folder(400.0, STEP, EXPECT);
    let (output, record) = run_on_board(&folder, options);
    let trial = only_trial(&record);
    assert_eq!((record.verdict, trial.cause), (Verdict::Inconclusive, Some(Cause::Rig)), "{trial:?}");
    // On a busy machine, a late acknowledgement or a stall that falsifies the clock may be the reason instead.
    let text = trial.reason.as_ref().unwrap().to_string();
    let reasons = [reason, "was not acknowledged", "the controller's clock differs by"];
    assert!(reasons.iter().any(|reason| text.contains(reason)), "{trial:?}");
    output.assert_exit(expected);
    if options == "skip=150" {
        assert_eq!(real_plate_record(&record).missing, 1);
    }
    if options == "reset=150" {
        assert!(trial.telemetry.ended.as_deref().is_some_and(|ended| ended.contains("restarted")), "{trial:?}");
    }
    assert_eq!(rejudge(&folder).verdict, Verdict::Inconclusive);
}

#[rstest]
#[case::by_itself("stop=150")]
#[case::trap("trap=150")]
fn a_controller_that_stops_fails(#[case] options: &str) {
    let folder = plate_folder(400.0, STEP, EXPECT);
    let (output, record) = repeat_until_counted(|| run_on_board(&folder, options));
    assert_eq!((record.verdict, output.exit), (Verdict::Fail, 1), "{:?}", only_trial(&record));
    let last = *read_rows(&folder, &record).last().unwrap();
    assert!(last.flags.contains(Flags::SAFE) && last.drive_vpp == 0.0, "{last:?}");
    assert_eq!(rejudge(&folder).verdict, Verdict::Fail);
}

#[test]
fn a_real_plate_has_no_faults_of_the_line() {
    let fault = "[[fault]]\nkind = \"drop\"\nfrom_ms = 30.0\nuntil_ms = 34.0\n";
    let folder = plate_folder(400.0, STEP, &format!("{EXPECT}{fault}"));
    folder.bench(RUN.iter().chain(&[&*board_rig("")])).assert_message(2, &["expected no [[fault]]"]);
}

const TOUCHED_PROFILE: &str =
    "setpoint_um = { hold = [[0.0, 0.0], [100.0, 1.0]] }\nfinger_force_n = 1.0\ntemperature_offset_k = 2.0";
const STATIC_ERROR: &str =
    "[[expect]]\nmetric = \"static_error_percent\"\nat_most = 1.0\nwindow_ms = 50.0\nover = \"each\"\n";

#[rstest]
#[case::not_asked(&["--yes"])]
#[case::no_input(&[])]
fn without_an_operator_manual_steps_are_inconclusive(#[case] more: &[&str]) {
    let folder = plate_folder(300.0, TOUCHED_PROFILE, STATIC_ERROR);
    start_bench(folder.path(), RUN.iter().chain(&[&*board_rig("")]).chain(more)).finish().assert_exit(3);
    let record = folder.record("run");
    assert_eq!(record.verdict, Verdict::Inconclusive);
    let trial = only_trial(&record);
    assert_eq!(trial.cause, Some(Cause::Rig));
    assert!(trial.reason.as_ref().unwrap().to_string().contains("no operator was present"), "{trial:?}");
    assert_eq!(rejudge(&folder).verdict, Verdict::Inconclusive);
}

type OperatorRun = (i32, Vec<String>);

/// `act` receives each prompt and the path of the file with force in N and temperature offset in K.
fn run_with_operator(folder: &TestFolder, mut act: impl FnMut(&str, &Path)) -> (OperatorRun, RunRecord) {
    let _ = fs::remove_dir_all(folder.join("run"));
    let conditions = folder.join("conditions");
    fs::write(&conditions, "0 0").unwrap();
    let mut bench = bench_command(folder.path());
    bench.args(RUN).arg(board_rig(&format!("'conditions={}'", conditions.display())));
    bench.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut bench = ChildGuard(bench.spawn().unwrap());
    let mut answers = bench.0.stdin.take().unwrap();
    let mut messages = Vec::new();
    for line in BufReader::new(bench.0.stderr.take().unwrap()).lines().map(Result::unwrap) {
        if line.starts_with("please ") || line.starts_with("now: ") {
            act(&line, &conditions);
        }
        if line.starts_with("please ") {
            answers.write_all(b"\n").unwrap();
        }
        messages.push(line);
    }
    let code = bench.0.wait().unwrap().code().unwrap();
    ((code, messages), folder.record("run"))
}

#[test]
fn an_operator_warms_and_presses_the_plate() {
    let folder = plate_folder(300.0, TOUCHED_PROFILE, STATIC_ERROR);
    let act = |prompt: &str, conditions: &Path| {
        if prompt.contains("26 °C") {
            fs::write(conditions, "0 2").unwrap();
        } else if prompt.contains("1 N") {
            fs::write(conditions, "1.1 2").unwrap();
        }
    };
    let ((code, messages), record) = repeat_until_counted(|| run_with_operator(&folder, act));
    assert_eq!((record.verdict, code), (Verdict::Pass, 0), "{:?}\n{messages:#?}", only_trial(&record));
    let requests = &real_plate_record(&record).asked;
    let requests: Vec<_> = requests.iter().map(|request| (request.what.as_str(), request.done)).collect();
    assert_eq!(requests, [("bring the plate to 26 °C (+2 K)", true), ("press the plate with 1 N and hold", true)]);
    assert!(messages.iter().any(|line| line == "in 3 s: the trial starts"), "{messages:#?}");
    let rows = read_rows(&folder, &record);
    assert!(rows.iter().all(|row| (row.finger_force_n - 1.1).abs() < 1e-6 && row.temperature_offset_k.is_nan()));
}

#[test]
fn a_measured_force_contradicts_a_false_confirmation() {
    let folder = plate_folder(300.0, TOUCHED_PROFILE, STATIC_ERROR);
    let ((code, _), record) = run_with_operator(&folder, |_, _| {});
    assert_eq!((record.verdict, code), (Verdict::Inconclusive, 3));
    let trial = only_trial(&record);
    assert_eq!(trial.cause, Some(Cause::Rig));
    let reason = trial.reason.as_ref().unwrap().to_string();
    assert!(reason.starts_with("the finger pressed with 0.00 N at 0 ms"), "{trial:?}");
}

#[test]
fn a_finger_within_the_trial_has_a_countdown() {
    let profile = "setpoint_um = 1.0\nfinger_force_n = { hold = [[0.0, 0.0], [1500.0, 1.0]] }";
    let folder = plate_folder(3_000.0, profile, STATIC_ERROR);
    let act = |prompt: &str, conditions: &Path| {
        if prompt == "now: press the plate with 1 N and hold" {
            fs::write(conditions, "1.0 0").unwrap();
        }
    };
    let ((code, messages), record) = repeat_until_counted(|| run_with_operator(&folder, act));
    assert_eq!((record.verdict, code), (Verdict::Pass, 0), "{:?}\n{messages:#?}", only_trial(&record));
    assert!(messages.iter().any(|line| line == "in 1 s: press the plate with 1 N and hold"), "{messages:#?}");
    let rows = read_rows(&folder, &record);
    assert_eq!((rows[0].finger_force_n, rows.last().unwrap().finger_force_n), (0.0, 1.0));
}

fn running_board(folder: &TestFolder) -> (ChildGuard, PathBuf) {
    let log = folder.join("log");
    let rig = board_rig(&format!("'log={}'", log.display()));
    let bench = start_bench(folder.path(), RUN.iter().chain(&[&*rig]));
    wait_until("the board never drove its plate", || log_text(&log).contains("Running"));
    (bench, log)
}

fn log_text(log: &Path) -> String {
    fs::read_to_string(log).unwrap_or_default()
}

#[rstest]
#[case::interrupt("INT", 130)]
#[case::terminate("TERM", 143)]
fn a_signal_puts_the_real_plate_at_0_v(#[case] name: &str, #[case] expected: i32) {
    let folder = plate_folder(60_000.0, STEP, EXPECT);
    let (bench, log) = running_board(&folder);
    bench.signal(name);
    bench.finish().assert_exit(expected);
    assert!(log_text(&log).trim_end().ends_with("Safe 0"), "{}", log_text(&log));
    let record = folder.record("run");
    assert_eq!((record.safe_confirmed, record.complete), (Some(true), false));
}

#[test]
fn after_a_killed_bench_the_board_s_watchdog_acts() {
    let folder = plate_folder(60_000.0, STEP, EXPECT);
    let (mut bench, log) = running_board(&folder);
    // The bench is stopped but not ended, so that its line stays open.
    bench.signal("STOP");
    wait_until("the board drives without setpoints", || log_text(&log).trim_end().ends_with("Fault 0"));
    bench.kill();
}
