use crate::test_folder::{FAILED_SETTLING, SETTLING, TestFolder, controller_rig, step_scenario, step_text};
use platebench_model::record::{RunRecord, Verdict};
use rstest::rstest;

fn noisy(expect: &str) -> String {
    step_scenario("aluminium-198x138-noisy", "", "", expect) + "[trials]\ncount = 5\n"
}

fn lab() -> TestFolder {
    let folder = TestFolder::with_scenario(&noisy("metric = \"final_amplitude_um\"\nat_least = 0.5"));
    folder.write_scenario("t.toml", &noisy("metric = \"overshoot_percent\"\nat_most = 60.0"));
    let rig = controller_rig(None);
    let board = |name: &str, rig: &str| format!("[[board]]\nname = \"{name}\"\nrig = \"{rig}\"\n");
    folder.write("boards.toml", &(board("a", "hosted") + &board("b", &rig) + &board("dead", "exec:false {port}")));
    folder
}

#[test]
fn shards_are_joined_and_a_missing_one_is_reported() {
    let folder = lab();
    for (shard, out) in [("1/2", "one"), ("2/2", "two")] {
        folder.bench(["run", "--board", "a", "--shard", shard, "--out", out]).assert_exit(0);
    }
    folder
        .bench(["report", "--merge", "one", "--out", "part"])
        .assert_text(3, &["inconclusive: evidence: shard 2/2 of a is missing"]);
    folder.bench(["report", "--merge", "one", "two", "--out", "all"]).assert_exit(0);
    let files: Vec<_> = folder.record("all").scenarios.iter().map(|scenario| scenario.file.clone()).collect();
    assert_eq!(files, ["s.toml", "t.toml"]);
    folder.bench(["report", "all", "--rejudge"]).assert_exit(0);
    folder.bench(["report", "part", "--rejudge"]).assert_exit(3);
    folder.bench(["report", "all"]).assert_exit(0);
    folder
        .bench(["report", "--merge", "one", "two", "one", "--out", "twice"])
        .assert_message(2, &["trial 0 of s.toml"]);
    assert!(!folder.exists("twice"));
    folder
        .bench(["report", "--merge", "all", "--out", "again"])
        .assert_message(2, &["is a run that `platebench report --merge` wrote"]);
}

#[test]
fn boards_are_compared_with_intervals() {
    let folder = lab();
    folder.bench(["run", "--board", "a", "--out", "a"]).assert_exit(0);
    folder.bench(["run", "--board", "b", "--clock", "lockstep", "--out", "b"]).assert_exit(0);
    folder.bench(["run", "--board", "dead", "--clock", "lockstep", "--out", "dead"]).assert_exit(5);
    folder.bench(["report", "--merge", "a", "b", "--out", "both"]).assert_exit(0).assert_stdout(&[
        "scenario  a       b",
        "s.toml    ✓ pass  ✓ pass",
        "final_amplitude_um",
    ]);
    let record = folder.record("both");
    let differences = &record.merge.as_ref().unwrap().differences;
    assert_eq!(differences.len(), 2, "{differences:?}");
    for found in differences {
        let [low, high] = found.interval.unwrap();
        assert_eq!((found.board.as_str(), found.reference.as_str()), ("b", "a"));
        assert!(low < found.difference && found.difference < high, "{found:?}");
    }
    folder.bench(["report", "both", "--rejudge"]).assert_exit(0);
    assert!(folder.read("both/report.html").contains("Differences between boards"));
    folder.replace("both/traces/b/s/000.csv", "control", "");
    folder.bench(["report", "both", "--rejudge"]).assert_message(2, &["SHA-256"]);
    folder.replace("b/traces/s/000.csv", "control", "");
    folder.bench(["report", "--merge", "a", "b", "--out", "changed"]).assert_message(2, &["SHA-256"]);
}

/// Sets every verdict of the run to pass, as an edited record may have.
fn edit_verdicts(folder: &TestFolder, run: &str) {
    let mut record = folder.record(run);
    for scenario in &mut record.scenarios {
        scenario.verdict = Verdict::Pass;
        for expectation in &mut scenario.expectations {
            (expectation.verdict, expectation.cause, expectation.reason) = (Verdict::Pass, None, None);
        }
    }
    record.verdict = Verdict::Pass;
    record.write(&folder.join(run)).unwrap();
}

#[test]
fn shards_of_different_selections_are_refused() {
    let folder = TestFolder::new();
    for (name, expect) in [("a", SETTLING), ("b", SETTLING), ("c", FAILED_SETTLING), ("d", SETTLING)] {
        folder.write_scenario(&format!("{name}.toml"), &format!("tags = [\"{name}\"]\n{}", step_text(expect)));
    }
    let shard = |shard: &str, out: &str, more: &[&str]| {
        let run = ["run", "--rig", "hosted", "--shard", shard, "--out", out];
        folder.bench(run.iter().chain(more)).assert_exit_in(&[0, 1]);
    };
    shard("1/2", "first", &["scenarios/a.toml", "scenarios/b.toml", "scenarios/c.toml"]);
    shard("1/2", "one", &["--not-tag", "c"]);
    shard("2/2", "two", &[]);
    shard("2/2", "filtered", &["--not-tag", "c"]);
    for [one, two] in [["first", "two"], ["one", "two"], ["first", "filtered"]] {
        let merge = folder.bench(["report", "--merge", one, two, "--out", "all"]).assert_exit(2);
        merge
            .assert_stderr(&[&format!("{two}: the selection of scenarios (SHA-256) is "), &format!(" in {one}; only")]);
        assert!(!folder.exists("all"));
    }
    folder.bench(["report", "--merge", "one", "filtered", "--out", "all"]).assert_exit(0);
    let mut record: RunRecord = folder.record("one");
    record.overrides.selection = None;
    record.write(&folder.join("one")).unwrap();
    let merge = folder.bench(["report", "--merge", "one", "filtered", "--out", "other"]).assert_exit(2);
    merge.assert_stderr(&["one: is shard 1 and does not record the selection"]);
}

#[rstest]
#[case::law(&["--law", "dq-pi-fixed"], "--law dq-pi-fixed")]
#[case::trials(&["--trials", "2"], "--trials 2")]
#[case::seed(&["--seed", "9"], "--seed 9")]
fn shards_with_different_options_are_refused(#[case] options: &[&str], #[case] found: &str) {
    let folder = lab();
    let shard = |shard: &str, out: &str, more: &[&str]| {
        let run = ["run", "--rig", "hosted", "--shard", shard, "--out", out];
        folder.bench(run.iter().chain(more)).assert_exit_in(&[0, 1]);
    };
    shard("1/2", "one", &[]);
    shard("2/2", "two", options);
    let message = format!("two: the set of options of the shard is {found}");
    folder.bench(["report", "--merge", "one", "two", "--out", "all"]).assert_message(2, &[&message]);
}

#[test]
fn a_selection_depends_on_the_content_of_its_scenarios() {
    let folder = lab();
    let shard = |shard: &str, out: &str| {
        folder.bench(["run", "--rig", "hosted", "--shard", shard, "--out", out]).assert_exit(0);
    };
    shard("1/2", "one");
    folder.replace("scenarios/s.toml", "at_least = 0.5", "at_least = 0.4");
    shard("2/2", "two");
    folder
        .bench(["report", "--merge", "one", "two", "--out", "all"])
        .assert_message(2, &["the selection of scenarios"]);
}

#[test]
fn edited_verdicts_have_no_effect() {
    let folder = TestFolder::with_step(&format!("{FAILED_SETTLING}\nrequirement = \"R-1\""));
    folder.run_hosted("run").assert_exit(1);
    edit_verdicts(&folder, "run");
    folder.bench(["report", "--merge", "run", "--out", "all"]).assert_exit(1);
    assert_eq!(folder.record("all").verdict, Verdict::Fail);
    let accept = folder.bench(["baseline", "accept", "run"]).assert_exit(1);
    accept.assert_output(&["✗ not accepted  s.toml: it did not pass (fail)"]);
    let note = "s.toml: settling_time_ms: pass in the record, fail now";
    folder.bench(["report", "run"]).assert_message(0, &[note]);
    assert!(folder.read("run/traceability.csv").contains("fail"));
    folder.bench(["report", "run", "--export", "csv"]).assert_message(0, &[note]);
}

#[test]
fn a_run_without_all_traces_is_not_joined() {
    let folder = TestFolder::with_step(SETTLING);
    folder.bench(["run", "--rig", "hosted", "--keep-traces", "failing", "--out", "run"]).assert_exit(0);
    folder.bench(["report", "--merge", "run", "--out", "all"]).assert_message(2, &["did not keep all traces"]);
}
