use crate::test_folder::{FAILED_SETTLING, TestFolder, controller_rig, step_scenario};
use platebench_model::record::Verdict;

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
