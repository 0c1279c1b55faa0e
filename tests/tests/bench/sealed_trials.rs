//! Tests that a verdict has one source, the sealed record of each trial: after a kill, a change of the
//! folder, a merge of shards, and for runs of 0.3.

use crate::boards::inventory;
use crate::controller_end::{Change, controller};
use crate::test_folder::{
    ChildGuard, FAILED_SETTLING, SETTLING, TestFolder, bench_command, controller_rig, step_text, workspace_root,
};
use platebench_model::record::{JOURNAL_FILE, RunRecord, Verdict};
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader};
use std::process::Stdio;

const SECOND_ANSWER: &str = "                        port.write(answer)\n";
const ANSWERED: &str = "metric = \"overshoot_percent\"\nat_most = 100.0";

/// Ends the bench with SIGKILL right after the event of the first trial.
fn kill_after_first_trial(folder: &TestFolder, rig: &str) -> Value {
    let mut bench = bench_command(folder.path());
    bench.args(["run", "--rig", rig, "--jobs", "2", "--format", "json", "--out", "run"]);
    let mut bench =
        ChildGuard(bench.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap());
    let lines = BufReader::new(bench.0.stdout.take().unwrap()).lines();
    let mut events = lines.map(|line| serde_json::from_str::<Value>(&line.unwrap()).unwrap());
    let event = events.find(|event| event["event"] == "trial-finished").unwrap();
    bench.kill();
    event
}

#[test]
fn a_printed_failure_stays_a_failure_after_a_kill() {
    let with_duration = |ms: &str| step_text(ANSWERED).replace("duration_ms = 60.0", &format!("duration_ms = {ms}"));
    let folder = TestFolder::with_scenario(&with_duration("6.0"));
    folder.write_scenario("z.toml", &with_duration("600000.0"));
    let Some(rig) = controller(&folder, Change::AfterAnswer(SECOND_ANSWER)) else { return };
    let event = kill_after_first_trial(&folder, &rig);
    assert_eq!(event["scenario"], "s.toml");
    assert!(!event["trial"]["telemetry"]["violations"].as_array().unwrap().is_empty(), "{event}");
    let judged = folder.bench(["report", "run", "--rejudge", "--format", "json"]).assert_exit(1).json();
    let verdicts = ["s.toml", "z.toml"].map(|file| {
        let scenarios = judged["scenarios"].as_array().unwrap();
        scenarios.iter().find(|scenario| scenario["file"] == file).unwrap()["verdict"].clone()
    });
    assert_eq!(verdicts, ["fail", "inconclusive"]);
    assert!(!folder.record("run").complete);
}

#[test]
fn a_trace_without_a_sealed_trial_is_not_played() {
    let folder = TestFolder::with_step(SETTLING);
    folder.run_hosted("run").assert_exit(0);
    folder.interrupt("run", 0);
    assert!(folder.exists("run/traces/s/000.csv"));
    folder.bench(["report", "run", "--rejudge"]).assert_exit(3);
    let again = platebench_engine::rejudge(&folder.join("run"), None).unwrap();
    assert_eq!((again.verdict, again.scenarios[0].trials.len()), (Verdict::Inconclusive, 0));
}

#[rstest]
#[case::edited(|lines: &mut Vec<String>| lines[1] = lines[1].replace("\"wall_ms\":", "\"wall_ms\":1"), "trials.jsonl:2: the seal")]
#[case::removed(|lines: &mut Vec<String>| drop(lines.remove(1)), "trials.jsonl:2: the seal")]
#[case::exchanged(|lines: &mut Vec<String>| lines.swap(0, 1), "trials.jsonl:1: the seal")]
#[case::cut_at_the_end(|lines: &mut Vec<String>| drop(lines.pop()), "trials.jsonl:2: expected the last seal")]
#[case::not_sealed(|lines: &mut Vec<String>| lines.push("{}".to_owned()), "trials.jsonl:4: not a sealed trial")]
fn a_changed_journal_is_refused(#[case] change: fn(&mut Vec<String>), #[case] expected: &str) {
    let folder = TestFolder::with_scenario(&(step_text(SETTLING) + "[trials]\ncount = 3\n"));
    folder.run_hosted("run").assert_exit(0);
    let file = format!("run/{JOURNAL_FILE}");
    let mut lines: Vec<String> = folder.read(&file).lines().map(str::to_owned).collect();
    assert_eq!(lines.len(), 3);
    change(&mut lines);
    folder.write(&file, &(lines.join("\n") + "\n"));
    folder.bench(["report", "run", "--rejudge"]).assert_message(2, &[expected]);
}

#[test]
fn changed_trials_in_the_record_are_refused() {
    let folder = TestFolder::with_step(SETTLING);
    folder.run_hosted("run").assert_exit(0);
    folder.replace("run/run.json", "\"seed\": 1,", "\"seed\": 9,");
    folder.bench(["report", "run"]).assert_message(2, &["the trials of run.json differ from the sealed trials"]);
}

#[test]
fn a_torn_line_is_an_interrupted_trial() {
    let folder = TestFolder::with_scenario(&(step_text(SETTLING) + "[trials]\ncount = 3\n"));
    folder.run_hosted("run").assert_exit(0);
    folder.interrupt("run", 3);
    let file = format!("run/{JOURNAL_FILE}");
    let text = folder.read(&file);
    folder.write(&file, &text[..text.len() - 1]);
    assert_eq!(folder.record("run").scenarios[0].trials.len(), 2);
    folder.bench(["report", "run", "--rejudge"]).assert_exit(3);
    folder.write(&file, &text);
    assert_eq!(folder.record("run").scenarios[0].trials.len(), 3);
}

#[test]
fn shards_of_different_controllers_are_not_joined() {
    let folder = TestFolder::with_step(SETTLING);
    folder.write_scenario("t.toml", &step_text(SETTLING));
    let own = controller_rig(None);
    let run = |rig: &str, shard: &str, out: &str| {
        folder.bench(["run", "--rig", rig, "--clock", "lockstep", "--shard", shard, "--out", out]).assert_exit(0);
    };
    run(&own, "1/2", "first");
    run("hosted", "2/2", "forgotten");
    run(&own, "2/2", "second");
    let both = ["controller of the shard is hosted (\"platebench-host\"", "but exec:"];
    folder.bench(["report", "--merge", "first", "forgotten", "--out", "all"]).assert_message(2, &both);
    assert!(!folder.exists("all/run.json"));
    folder.bench(["report", "--merge", "first", "second", "--out", "same"]).assert_exit(0);
    folder.bench(["report", "same", "--rejudge"]).assert_exit(0);
}

/// The program of the second shard has the same identity and other bytes.
#[test]
fn shards_of_another_program_are_not_joined() {
    let folder = TestFolder::with_step(SETTLING);
    folder.write_scenario("t.toml", &step_text(SETTLING));
    let program = controller_rig(None).split('\'').nth(1).unwrap().to_owned();
    for (shard, out, more) in [("1/2", "first", ""), ("2/2", "second", "changed")] {
        let copy = folder.join("controller");
        let _ = fs::remove_file(&copy);
        fs::copy(&program, &copy).unwrap();
        fs::write(&copy, [fs::read(&program).unwrap(), more.into()].concat()).unwrap();
        let run = ["run", "--rig", "exec:./controller {port}", "--clock", "lockstep", "--shard", shard, "--out", out];
        folder.bench(run).assert_exit(0);
    }
    folder.bench(["report", "--merge", "first", "second", "--out", "all"]).assert_message(2, &["SHA-256"]);
}

#[test]
fn named_boards_may_have_different_controllers() {
    let folder = TestFolder::with_step(SETTLING);
    folder.write_scenario("t.toml", &step_text(SETTLING));
    let rigs = [("a", controller_rig(None)), ("b", "hosted".to_owned())];
    let rigs = rigs.map(|(name, rig)| (name, format!("rig = \"{rig}\"")));
    folder.write("boards.toml", &inventory(&rigs));
    for (board, shard) in [("a", "1/2"), ("b", "2/2")] {
        let run = ["run", "--board", board, "--clock", "lockstep", "--shard", shard, "--out", board];
        folder.bench(run).assert_exit(0);
    }
    folder.bench(["report", "--merge", "a", "b", "--out", "all"]).assert_exit(0);
}

/// Copies the run that platebench 0.3.0 wrote.
fn folder_with_run_of_0_3() -> TestFolder {
    let folder = TestFolder::new();
    let source = workspace_root().join("tests/tests/bench/run-of-0.3");
    for file in
        ["run.json", "inputs/s.toml", "inputs/plates/aluminium-198x138.toml", "traces/s/000.csv", "traces/s/001.csv"]
    {
        let target = folder.join("old").join(file);
        fs::create_dir_all(target.parent().unwrap()).unwrap();
        fs::copy(source.join(file), target).unwrap();
    }
    folder
}

#[test]
fn a_run_of_0_3_is_judged_with_what_it_contains() {
    let folder = folder_with_run_of_0_3();
    folder.bench(["report", "old", "--rejudge"]).assert_exit(0);
    folder.bench(["report", "old"]).assert_exit(0);
    folder.bench(["report", "--merge", "old", "--out", "all"]).assert_exit(0);
    folder.replace("old/traces/s/001.csv", "control", "");
    folder.bench(["report", "old", "--rejudge"]).assert_message(2, &["SHA-256"]);
}

#[test]
fn an_unfinished_run_of_0_3_is_no_pass() {
    let folder = folder_with_run_of_0_3();
    let mut record = folder.record("old");
    record.complete = false;
    record.scenarios[0].trials.truncate(1);
    record.write(&folder.join("old")).unwrap();
    let again = platebench_engine::rejudge(&folder.join("old"), None).unwrap();
    assert_eq!((again.scenarios[0].verdict, again.scenarios[0].trials.len()), (Verdict::Inconclusive, 1));
}

#[test]
fn the_last_failed_are_those_that_fail_with_require_all() {
    let folder = TestFolder::with_step(SETTLING);
    folder.write_scenario("chip.toml", &(step_text(SETTLING) + "[[fault]]\nkind = \"reset\"\nat_ms = 10.0\n"));
    let list = ["run", "--rig", "hosted", "--last-failed", "--list", "-q"];
    folder.bench(["run", "--rig", "hosted"]).assert_exit(0);
    folder.bench(list).assert_exit(4);
    folder.bench(["run", "--rig", "hosted", "--require-all"]).assert_exit(1);
    assert_eq!(folder.bench(list).assert_exit(0).stdout, "chip.toml\n");
}

#[test]
fn a_joined_run_names_every_controller() {
    let folder = TestFolder::with_step(SETTLING);
    folder.run_hosted("a").assert_exit(0);
    let rig = controller_rig(None);
    folder.write_scenario("t.toml", &step_text(SETTLING));
    let second = ["run", "scenarios/t.toml", "--clock", "lockstep", "--rig", &rig, "--out", "b"];
    folder.bench(second).assert_exit(0);
    let joined = folder.bench(["report", "--merge", "a", "b", "--out", "joined"]);
    let text = joined.text().split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(text.contains("(the bench's own firmware), ") && !text.contains("firmware unknown"), "{text}");
    assert!(text.contains("(the bench's own firmware on the rig hosted; name yours with --rig)"), "{text}");
}

/// The start of the record decides whether a run is the newest.
#[rstest]
#[case::start(20, "this may be the newest run")]
#[case::rest(2_000, "run.json")]
fn a_damaged_newest_run_is_no_pass_of_the_last_failed(#[case] length: usize, #[case] message: &str) {
    let folder = TestFolder::with_step(SETTLING);
    folder.run_below_runs(0);
    folder.write_scenario("s.toml", &step_text(FAILED_SETTLING));
    folder.run_below_runs(1);
    let record = folder.newest_run().join("run.json");
    let text = fs::read_to_string(&record).unwrap();
    fs::write(&record, &text[..length]).unwrap();
    folder.bench(["run", "--rig", "hosted", "--last-failed"]).assert_message(2, &["run.json", message]);
}

#[test]
fn a_run_without_scenarios_is_no_pass_of_the_last_failed() {
    let folder = TestFolder::with_scenario(&(step_text(SETTLING) + "[[fault]]\nkind = \"reset\"\nat_ms = 10.0\n"));
    folder.bench(["run", "--rig", "hosted"]).assert_exit(4);
    folder.bench(["run", "--rig", "hosted", "--last-failed"]).assert_message(4, &["no scenario was played in"]);
}

#[test]
fn a_renamed_scenario_is_no_pass_of_the_last_failed() {
    let folder = TestFolder::with_step(FAILED_SETTLING);
    folder.run_below_runs(1);
    fs::rename(folder.join("scenarios/s.toml"), folder.join("scenarios/t.toml")).unwrap();
    folder.bench(["run", "--rig", "hosted", "--last-failed"]).assert_message(2, &["s.toml did not pass in runs/"]);
    fs::rename(folder.join("scenarios/t.toml"), folder.join("scenarios/s.toml")).unwrap();
    // A scenario that exists and was not named is not an error.
    folder.write_scenario("u.toml", &step_text(SETTLING));
    let note = "s.toml did not pass in runs/";
    folder.bench(["run", "--rig", "hosted", "--last-failed", "--list", "scenarios/u.toml"]).assert_stderr(&[note]);
}

#[test]
fn the_newest_run_does_not_depend_on_the_clock() {
    let folder = TestFolder::with_step(FAILED_SETTLING);
    folder.run_below_runs(1);
    let first = folder.newest_run();
    folder.write_scenario("s.toml", &step_text(SETTLING));
    folder.run_below_runs(0);
    let second = folder.newest_run();
    assert_ne!(first, second);
    let mut record = RunRecord::read(&second).unwrap();
    "2001-01-01T00:00:00Z".clone_into(&mut record.started);
    record.write(&second).unwrap();
    folder.bench(["run", "--rig", "hosted", "--last-failed"]).assert_message(4, &["every scenario passed in"]);
}

/// Answers every sample twice from its fifth trial on.
const WRONG_AFTER_4_TRIALS: &str = "self.trials = getattr(self, 'trials', 0) + 1
        if kind == SAMPLE and getattr(self, 'trials', 0) > 4:
            return self.command(number) * 2";

#[test]
fn a_soak_finds_a_controller_that_fails_later() {
    let folder = TestFolder::with_step(ANSWERED);
    let change = Change::Message { kind: "CONFIGURE", action: WRONG_AFTER_4_TRIALS };
    let Some(rig) = controller(&folder, change) else { return };
    folder.write("boards.toml", &inventory(&[("left", format!("rig = \"{rig}\"\n"))]));
    let soak = ["board", "soak", "--board", "left", "--hours", "0.1", "--fail-fast", "--out", "soak"];
    folder.bench(soak).assert_exit(1);
    let record: Value = serde_json::from_str(&folder.read("soak/soak.json")).unwrap();
    assert_eq!((&record["end"], &record["verdict"], &record["runs"]), (&"failed".into(), &"fail".into(), &5.into()));
}

#[test]
fn a_killed_soak_is_no_pass() {
    let folder = TestFolder::with_step(SETTLING);
    folder.write("boards.toml", &inventory(&[("left", "rig = \"hosted\"".to_owned())]));
    let mut bench = bench_command(folder.path());
    bench.args(["board", "soak", "--board", "left", "--hours", "1", "--out", "soak"]);
    let mut bench = ChildGuard(bench.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
    let read = || serde_json::from_str::<Value>(&fs::read_to_string(folder.join("soak/soak.json")).unwrap_or_default());
    crate::test_folder::wait_until("too few runs", || read().is_ok_and(|soak| soak["runs"].as_u64() >= Some(2)));
    bench.kill();
    let record = read().unwrap();
    assert_eq!((&record["end"], &record["verdict"]), (&Value::Null, &"inconclusive".into()));
    // 0.3 wrote a pass before the end.
    folder.replace("soak/soak.json", "\"inconclusive\"", "\"pass\"");
    folder.bench(["report", "soak"]).assert_exit(0);
    assert!(folder.read("soak/report.html").contains("runs on left, inconclusive, from"));
}
