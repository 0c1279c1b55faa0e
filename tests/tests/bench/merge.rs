use crate::test_folder::{TestFolder, controller_rig, step_scenario};

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
        .bench(["merge", "one", "--out", "part"])
        .assert_exit(3)
        .assert_stderr(&["inconclusive: evidence: shard 2/2 of a is missing"]);
    folder.bench(["merge", "one", "two", "--out", "all"]).assert_exit(0);
    let files: Vec<_> = folder.record("all").scenarios.iter().map(|scenario| scenario.file.clone()).collect();
    assert_eq!(files, ["s.toml", "t.toml"]);
    folder.bench(["judge", "all"]).assert_exit(0);
    folder.bench(["judge", "part"]).assert_exit(3);
    folder.bench(["report", "all"]).assert_exit(0);
    folder.bench(["merge", "one", "two", "one", "--out", "twice"]).assert_exit(2).assert_stderr(&["trial 0 of s.toml"]);
    assert!(!folder.exists("twice"));
    folder
        .bench(["merge", "all", "--out", "again"])
        .assert_exit(2)
        .assert_stderr(&["is a run that `platebench merge` wrote"]);
}

#[test]
fn boards_are_compared_with_intervals() {
    let folder = lab();
    folder.bench(["run", "--board", "a", "--out", "a"]).assert_exit(0);
    folder.bench(["run", "--board", "b", "--clock", "lockstep", "--out", "b"]).assert_exit(0);
    folder.bench(["run", "--board", "dead", "--clock", "lockstep", "--out", "dead"]).assert_exit(5);
    folder.bench(["merge", "a", "b", "--out", "both"]).assert_exit(0).assert_stdout(&[
        "scenario  a     b",
        "s.toml    pass  pass",
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
    folder.bench(["judge", "both"]).assert_exit(0);
    assert!(folder.read("both/report.html").contains("Differences between boards"));
    folder.replace("both/traces/b/s/000.csv", "control", "");
    folder.bench(["judge", "both"]).assert_exit(2).assert_stderr(&["SHA-256"]);
    folder.replace("b/traces/s/000.csv", "control", "");
    folder.bench(["merge", "a", "b", "--out", "changed"]).assert_exit(2).assert_stderr(&["SHA-256"]);
}
