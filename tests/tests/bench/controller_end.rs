//! Checks how the bench judges a controller that ends, never confirms 0 V, or drives afterwards.

use crate::boards::inventory;
use crate::test_folder::{FAILED_SETTLING, SETTLING, TestFolder, step_scenario, workspace_root};
use platebench_model::record::{Verdict, ViolationKind};
use platebench_test_kit::python_with_pyserial;
use rstest::rstest;
use serde_json::Value;
use std::fs;

/// Holds also in real time for a controller in Python, whose replies take some milliseconds.
const ANSWERED: &str = "metric = \"overshoot_percent\"\nat_most = 100.0";

/// The bench observes the controller for ten periods after the confirmation of 0 V. With 20 ms these are
/// 200 ms, enough for a controller on a busy machine.
const SLOW: &str = "period_ms = 20.0\nresponse_time_ms = 100.0";

const LATE_DRIVE: &str = "                        if body and body[0] & 15 == SAFE:
                            time.sleep(0.002)
                            drive = 0, 900.0, 32300000, RUNNING, 0, 0
                            head = bytes([VERSION << 4 | COMMAND, body[1]])
                            port.write(encode(head + struct.pack('<IfIBBH', *drive)))
";
const END_AFTER_SAFE: &str = "                        if body and body[0] & 15 == SAFE:
                            os._exit(0)
";

/// A change of `docs/examples/controller.py`.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Change {
    /// Replaces the handling of a message.
    Message { kind: &'static str, action: &'static str },
    /// Adds lines after an answer is written.
    AfterAnswer(&'static str),
}

/// Writes the changed controller and returns its rig. `None` if Python lacks pyserial.
pub(crate) fn controller(folder: &TestFolder, change: Change) -> Option<String> {
    let python = python_with_pyserial()?;
    let example = fs::read_to_string(workspace_root().join("docs/examples/controller.py")).unwrap();
    let example = example.replace("import math\n", "import math\nimport os\n");
    let (anchor, added) = match change {
        Change::Message { kind, action } => (
            "        kind, number = body[0] & 0x0F, body[1]\n",
            format!("        if kind == {kind}:\n            {action}\n"),
        ),
        Change::AfterAnswer(lines) => {
            ("                    if answer:\n                        port.write(answer)\n", lines.to_owned())
        }
    };
    assert!(example.contains(anchor), "{anchor}");
    folder.write("controller.py", &example.replacen(anchor, &format!("{anchor}{added}"), 1));
    Some(format!("exec:{python} controller.py {{port}}"))
}

fn summary(folder: &TestFolder) -> Value {
    serde_json::from_str(&folder.read("c/summary.json")).unwrap()
}

fn write_campaign(folder: &TestFolder) {
    folder.write(
        "campaign.toml",
        "title = \"t\"\nscenario = \"scenarios/s.toml\"\n[vary]\n\
         \"profile.finger_force_n\" = { uniform = [0.0, 0.1] }\n[plan]\nmethod = \"random\"\ntrials = 2\n",
    );
}

#[test]
fn a_drive_after_confirmed_0_v_fails_the_run() {
    let folder = TestFolder::with_scenario(&step_scenario("aluminium-198x138", SLOW, "", ANSWERED));
    let Some(rig) = controller(&folder, Change::AfterAnswer(LATE_DRIVE)) else { return };
    folder.bench(["run", "--rig", &rig, "--out", "run"]).assert_message(1, &["after it had confirmed 0 V"]);
    let record = folder.record("run");
    assert_eq!((record.verdict, record.drive_after_safe, record.safe_confirmed), (Verdict::Fail, true, Some(false)));
    let mut violations = record.scenarios[0].trials[0].telemetry.violations.iter();
    let drive = violations.find(|violation| violation.kind == ViolationKind::DriveAfterSafe);
    assert_eq!(drive.and_then(|drive| drive.worst), Some(900.0));
}

#[test]
fn a_drive_after_confirmed_0_v_fails_in_real_time() {
    let folder = TestFolder::with_scenario(&step_scenario("aluminium-198x138", SLOW, "", ANSWERED));
    let Some(rig) = controller(&folder, Change::AfterAnswer(LATE_DRIVE)) else { return };
    folder.bench(["run", "--clock", "real-time", "--rig", &rig, "--out", "run"]).assert_exit(1);
    let violations = &folder.record("run").scenarios[0].trials[0].telemetry.violations;
    assert!(violations.iter().any(|violation| violation.kind == ViolationKind::DriveAfterSafe), "{violations:?}");
}

#[test]
fn a_campaign_fails_after_a_drive_after_0_v() {
    let folder = TestFolder::with_scenario(&step_scenario("aluminium-198x138", SLOW, "", ANSWERED));
    let Some(rig) = controller(&folder, Change::AfterAnswer(LATE_DRIVE)) else { return };
    write_campaign(&folder);
    folder.bench(["campaign", "run", "campaign.toml", "--out", "c", "--rig", &rig]).assert_exit(1);
    assert_eq!(summary(&folder)["verdict"], "fail");
}

#[test]
fn an_exploration_fails_after_a_drive_after_0_v() {
    let folder = TestFolder::with_step(ANSWERED);
    let Some(rig) = controller(&folder, Change::AfterAnswer(LATE_DRIVE)) else { return };
    let envelope = workspace_root().join("scenarios/envelope.toml").display().to_string();
    folder.bench(["suite", "explore", &envelope, "--rig", &rig, "--scenes", "1", "--out", "out"]).assert_exit(1);
}

#[rstest]
#[case::passing(ANSWERED, 5)]
#[case::failing(FAILED_SETTLING, 1)]
fn campaign_and_run_agree_without_confirmed_0_v(#[case] expect: &str, #[case] expected: i32) {
    let folder = TestFolder::with_scenario(&step_scenario("aluminium-198x138", "law = \"dq-pi-fixed\"", "", expect));
    let Some(rig) = controller(&folder, Change::Message { kind: "SAFE", action: "return None" }) else { return };
    folder.bench(["run", "--rig", &rig, "--out", "run"]).assert_exit(expected);
    write_campaign(&folder);
    let played = folder.bench(["campaign", "run", "campaign.toml", "--out", "c", "--rig", &rig]);
    played.assert_text(expected, &["did not confirm 0 V"]);
    assert_eq!(summary(&folder)["safe_confirmed"], false);
    // The stored parts know it, too.
    folder.bench(["campaign", "merge", "c"]).assert_exit(expected);
}

#[test]
fn a_played_shard_without_confirmed_0_v_ends_with_5() {
    let folder = TestFolder::with_step(ANSWERED);
    let Some(rig) = controller(&folder, Change::Message { kind: "SAFE", action: "return None" }) else { return };
    write_campaign(&folder);
    folder.bench(["campaign", "plan", "campaign.toml", "--out", "c", "--rig", &rig, "--shards", "1"]).assert_exit(0);
    folder.bench(["campaign", "play", "c", "--shard", "1"]).assert_message(5, &["did not confirm 0 V"]);
}

#[test]
fn a_soak_ends_without_confirmed_0_v() {
    let folder = TestFolder::with_step(ANSWERED);
    let Some(rig) = controller(&folder, Change::Message { kind: "SAFE", action: "return None" }) else { return };
    folder.write("boards.toml", &inventory(&[("left", format!("rig = \"{rig}\""))]));
    let soak =
        folder.bench(["board", "soak", "--board", "left", "--hours", "1", "--clock", "lockstep", "--out", "soak"]);
    soak.assert_text(5, &["1 runs; ended because the controller did not confirm 0 V"]);
    assert!(folder.read("soak/soak.json").contains("\"end\": \"unsafe\""));
}

#[test]
fn an_exploration_without_confirmed_0_v_fails_by_its_sequences() {
    let folder = TestFolder::with_step(ANSWERED);
    let Some(rig) = controller(&folder, Change::Message { kind: "SAFE", action: "return None" }) else { return };
    let envelope = workspace_root().join("scenarios/envelope.toml").display().to_string();
    let played = folder.bench(["suite", "explore", &envelope, "--rig", &rig, "--scenes", "1", "--out", "out"]);
    played.assert_exit(1).assert_stdout(&["did not confirm 0 V"]);
}

#[rstest]
#[case::exit_status("sys.exit(3)", "ended with exit status 3")]
#[case::signal("os.kill(os.getpid(), 9)", "was ended by signal 9")]
fn a_program_that_crashes_in_a_trial_fails(#[case] action: &'static str, #[case] how: &str) {
    let folder = TestFolder::with_step(SETTLING);
    let Some(rig) = controller(&folder, Change::Message { kind: "SAMPLE", action }) else { return };
    folder.bench(["run", "--rig", &rig, "--out", "run"]).assert_exit(1).assert_stdout(&[how]);
    let trial = &folder.record("run").scenarios[0].trials[0];
    assert_eq!(trial.cause, None, "a failure of the controller");
}

#[rstest]
#[case::configuration("scenarios/s.toml")]
#[case::protocol_check("protocol.toml")]
fn a_program_that_crashes_before_the_trial_fails(#[case] scenario: &str) {
    let folder = TestFolder::with_step(ANSWERED);
    let protocol = step_scenario("aluminium-198x138", "", "", "metric = \"protocol_differences\"\nat_most = 0.0");
    folder.write("protocol.toml", &protocol.replace("plates/", "scenarios/plates/"));
    let change = Change::Message { kind: "CONFIGURE", action: "os.kill(os.getpid(), 11)" };
    let Some(rig) = controller(&folder, change) else { return };
    folder.bench(["run", scenario, "--rig", &rig, "--out", "run"]).assert_exit(1).assert_stdout(&["signal 11"]);
}

/// A child of the program keeps the line open, so that it does not hang up.
#[rstest]
fn a_crash_counts_although_another_process_holds_the_line(#[values("lockstep", "real-time")] clock: &str) {
    let folder = TestFolder::with_step(ANSWERED);
    let action = "os.kill(os.getpid(), 11) if os.fork() else time.sleep(60)";
    let Some(rig) = controller(&folder, Change::Message { kind: "SAMPLE", action }) else { return };
    let played = folder.bench(["run", "--clock", clock, "--rig", &rig, "--out", "run"]);
    played.assert_exit(1).assert_stdout(&["signal 11"]);
    assert_eq!(folder.record("run").scenarios[0].trials[0].cause, None, "a failure of the controller");
}

/// In real time, neither the delay of the line nor a late bench excuses a crash.
#[rstest]
fn a_crash_in_the_middle_of_a_trial_fails(#[values("lockstep", "real-time")] clock: &str) {
    let folder = TestFolder::with_step(SETTLING);
    let action = "os.kill(os.getpid(), 11) if number == 21 else None";
    let Some(rig) = controller(&folder, Change::Message { kind: "SAMPLE", action }) else { return };
    let played = folder.bench(["run", "--clock", clock, "--rig", &rig, "--out", "run"]);
    played.assert_exit(1).assert_stdout(&["signal 11"]);
}

#[test]
fn the_output_of_a_program_has_its_name_and_no_control_characters() {
    let folder = TestFolder::with_step(ANSWERED);
    let action = "print('to\\x1b[2Jld', flush=True)";
    let Some(rig) = controller(&folder, Change::Message { kind: "CONFIGURE", action }) else { return };
    let played = folder.bench(["run", "--rig", &rig, "--out", "run"]);
    let name = rig.split([':', ' ', '/']).find(|word| word.starts_with("python")).unwrap();
    let line = format!("{name}: to\\u{{1b}}[2Jld");
    assert!(played.text().lines().any(|printed| printed == line), "{}", played.text());
}

/// A wrong answer is no pass of a controller that needs longer than 80 ms for each of its answers.
#[rstest]
#[case::quick("body = body[:14] + bytes(4)", 1)]
#[case::slow("time.sleep(0.1); body = body[:14] + bytes(4)", 3)]
fn a_wrong_answer_is_no_pass_of_a_slow_controller(#[case] action: &'static str, #[case] expected: i32) {
    let folder = TestFolder::new();
    let messages = "[[message]]\nkind = \"configure\"\n[[message]]\nkind = \"sample\"\nsetpoint_um = 2.0\n\
                    wd_um = 1.0\nwq_um = \"inf\"\n[[message]]\nkind = \"safe\"\n";
    let expect = "metric = \"protocol_differences\"\nat_most = 0.0";
    folder.write_scenario("s.toml", &(step_scenario("aluminium-198x138", "", "", expect) + messages));
    let Some(rig) = controller(&folder, Change::Message { kind: "SAMPLE", action }) else { return };
    let arguments = ["run", "--clock", "lockstep", "--reply-timeout", "5000", "--rig", &rig, "--out", "run"];
    folder.bench(arguments).assert_exit(expected);
    let telemetry = &folder.record("run").scenarios[0].trials[0].telemetry;
    assert_eq!(telemetry.scripts_not_decided.is_empty(), expected == 1, "{telemetry:?}");
}

#[test]
fn a_refused_configuration_fails_its_scenario_only() {
    let folder = TestFolder::with_step(ANSWERED);
    folder.write_scenario("slow.toml", &step_scenario("aluminium-198x138", "period_ms = 2.0", "", ANSWERED));
    let action = "if struct.unpack_from('<I', body, 6)[0] == 2000: return encode(bytes([VERSION << 4 | CONFIGURED, \
                  number, 1]) + bytes(17))";
    let Some(rig) = controller(&folder, Change::Message { kind: "CONFIGURE", action }) else { return };
    folder.bench(["run", "scenarios", "--rig", &rig, "--out", "run"]).assert_exit(1);
    let record = folder.record("run");
    let verdict = |file: &str| record.scenarios.iter().find(|scenario| scenario.file.ends_with(file)).unwrap().verdict;
    assert_eq!((record.complete, verdict("s.toml"), verdict("slow.toml")), (true, Verdict::Pass, Verdict::Fail));
}

#[test]
fn a_program_that_crashes_at_the_request_for_0_v_fails() {
    let folder = TestFolder::with_step(ANSWERED);
    let change = Change::Message { kind: "SAFE", action: "os.kill(os.getpid(), 11)" };
    let Some(rig) = controller(&folder, change) else { return };
    folder.bench(["run", "--rig", &rig, "--out", "run"]).assert_exit(1).assert_stdout(&["signal 11"]);
}

#[test]
fn a_crash_fails_campaign_exploration_and_replay() {
    let folder = TestFolder::with_step(ANSWERED);
    let change = Change::Message { kind: "SAMPLE", action: "sys.exit(3)" };
    let Some(rig) = controller(&folder, change) else { return };
    write_campaign(&folder);
    folder.bench(["campaign", "run", "campaign.toml", "--out", "c", "--rig", &rig]).assert_exit(1);
    folder.run_hosted("run").assert_exit(0);
    let envelope = workspace_root().join("scenarios/envelope.toml").display().to_string();
    folder.bench(["suite", "explore", &envelope, "--rig", &rig, "--scenes", "1", "--out", "out"]).assert_exit(1);
    let replayed = folder.bench(["replay", "run/traces/s/000.csv", "--rig", &rig]);
    replayed.assert_text(1, &["exit status 3"]);
}

/// As in a run, although the program did not confirm 0 V.
#[test]
fn a_crash_fails_soak_and_acceptance() {
    let folder = TestFolder::with_step(&format!("{ANSWERED}\nrequirement = \"R-1\""));
    let change = Change::Message { kind: "SAMPLE", action: "sys.exit(3)" };
    let Some(rig) = controller(&folder, change) else { return };
    folder.write("boards.toml", &inventory(&[("left", format!("rig = {rig:?}"))]));
    let soak = ["board", "soak", "--board", "left", "--hours", "0.0000001", "--out", "soak"];
    folder.bench(soak).assert_exit(1).assert_stdout(&["exit status 3"]);
    let plan = "title = \"A session\"\nrepetitions = 1\n[[requirement]]\nid = \"R-1\"\ntext = \"It settles.\"\n\
                [[scenario]]\nfile = \"scenarios/s.toml\"\n[bench]\ntiming_trials = 1\nclean_runs = 2\n";
    folder.write("plan.toml", plan);
    let session = ["acceptance", "run", "--plan", "plan.toml", "--out", "record", "--rig", &rig, "--yes"];
    folder.bench(session).assert_exit(1).assert_stdout(&["exit status 3"]);
}

#[test]
fn a_program_may_end_after_it_confirmed_0_v() {
    let text = step_scenario("aluminium-198x138", "", "", ANSWERED);
    let folder = TestFolder::with_scenario(&format!("{text}[trials]\ncount = 2\n"));
    let Some(rig) = controller(&folder, Change::AfterAnswer(END_AFTER_SAFE)) else { return };
    folder.bench(["run", "--rig", &rig, "--out", "run"]).assert_exit(0);
    assert_eq!(folder.record("run").safe_confirmed, Some(true));
}
