//! Tests locks, quarantine and identity of boards with the program.

use crate::test_folder::{ChildGuard, SETTLING, TestFolder, controller_rig, start_bench, wait_until};
use std::fs;

const CHIP: &str = "0102030405060708090a0b0c";

pub(crate) fn inventory(boards: &[(&str, String)]) -> String {
    let board = |(name, keys): &(&str, String)| format!("[[board]]\nname = \"{name}\"\n{keys}\n");
    boards.iter().map(board).collect::<Vec<_>>().concat()
}

fn rig(rig: &str) -> String {
    format!("rig = \"{rig}\"")
}

fn lab(keys: &str) -> TestFolder {
    let folder = TestFolder::with_step(SETTLING);
    folder.write("boards.toml", &inventory(&[("left", keys.to_owned())]));
    let minute = TestFolder::with_minute();
    folder.write("minute.toml", &minute.read("scenarios/s.toml").replace("\"plates/", "\"scenarios/plates/"));
    folder
}

fn start_minute(folder: &TestFolder) -> ChildGuard {
    let words = ["run", "minute.toml", "--clock", "real-time", "--board", "left", "--out", "minute"];
    let bench = start_bench(folder.path(), words);
    wait_until("the run never began", || folder.exists("minute/run.json"));
    bench
}

pub(crate) fn state_of(folder: &TestFolder, board: usize) -> serde_json::Value {
    folder.bench(["board", "list", "--format", "json"]).assert_exit(0).json()[board].clone()
}

#[test]
fn a_killed_run_leaves_the_board_in_quarantine() {
    let folder = lab(&rig("hosted"));
    let mut first = start_minute(&folder);
    let process = first.0.id();
    folder
        .bench(["run", "--board", "left", "--out", "second"])
        .assert_message(5, &["board left is held by", &format!("process {process} "), "since 20"]);
    assert!(!folder.exists("second"));
    assert_eq!(state_of(&folder, 0)["state"], "held");
    folder.bench(["board", "clear", "left", "--reason", "x"]).assert_exit(5);
    first.kill();
    let quarantined = state_of(&folder, 0);
    assert_eq!(quarantined["state"], "quarantined");
    assert!(quarantined["reason"].as_str().unwrap().contains("without confirmed 0 V"), "{quarantined}");
    folder.bench(["run", "--board", "left", "--wait", "1"]).assert_message(5, &["quarantine", "clear left"]);
    folder.bench(["board", "clear", "left", "--reason", " "]).assert_exit(2);
    folder.bench(["board", "clear", "left", "--reason", "0 V measured"]).assert_exit(0);
    folder.bench(["run", "--board", "left", "--out", "third"]).assert_exit(0);
    let free = state_of(&folder, 0);
    assert_eq!((&free["state"], &free["last_run"]["verdict"]), (&"free".into(), &"pass".into()));
    assert!(free["last_run"]["folder"].as_str().unwrap().ends_with("third"));
    folder.bench(["board", "clear", "left", "--reason", "x"]).assert_message(2, &["not in quarantine"]);
    assert!(folder.read("boards.state/left.json").contains("0 V measured"));
}

#[test]
fn a_cancelled_or_failed_run_leaves_the_board_free() {
    let folder = lab(&rig("hosted"));
    let first = start_minute(&folder);
    first.signal("INT");
    first.finish().assert_exit(130);
    assert_eq!(state_of(&folder, 0)["state"], "free");
    folder.bench(["run", "--board", "left", "--out", "minute"]).assert_message(2, &["already contains"]);
    folder.replace("scenarios/s.toml", "at_most = 2.0", "at_most = 1.9");
    folder.bench(["run", "--board", "left", "--out", "failed"]).assert_exit(1);
    let free = state_of(&folder, 0);
    assert_eq!((&free["state"], &free["last_run"]["verdict"]), (&"free".into(), &"fail".into()));
}

#[test]
fn a_run_that_waits_starts_when_the_board_is_free() {
    let folder = lab(&rig("hosted"));
    let first = start_minute(&folder);
    let mut second = start_bench(folder.path(), ["run", "--board", "left", "--wait", "60", "--out", "second"]);
    let stderr = second.0.stderr.take().unwrap();
    let mut lines = std::io::BufRead::lines(std::io::BufReader::new(stderr));
    let waiting = lines.next().unwrap().unwrap();
    assert!(waiting.contains("waiting: board left is held by process"), "{waiting}");
    first.signal("TERM");
    first.finish().assert_exit(143);
    let rest: Vec<_> = lines.map_while(Result::ok).collect();
    assert_eq!(second.0.wait().unwrap().code(), Some(0), "{rest:?}");
}

#[test]
fn a_board_with_another_chip_is_not_configured() {
    let folder = lab("");
    let log = folder.join("controller.log");
    let rig = controller_rig(Some(&log)).replace("{port}", "{port} --unique ffffffffffffffffffffffff");
    let keys = format!("rig = \"{rig}\"\nchip_id = \"{CHIP}\"");
    folder.write("boards.toml", &inventory(&[("left", keys.clone())]));
    folder
        .bench(["run", "--board", "left", "--out", "run"])
        .assert_message(5, &["has the number ffffffffffffffffffffffff, boards.toml has 0102030405060708090a0b0c"]);
    let states = fs::read_to_string(&log).unwrap();
    assert!(states.contains("\"start\"") && !states.contains("running"), "{states}");
    assert!(!folder.exists("run"));
    assert_eq!(state_of(&folder, 0)["state"], "quarantined");
    folder.write("boards.toml", &inventory(&[("left", keys.replace(CHIP, &"F".repeat(24)))]));
    folder.bench(["board", "clear", "left", "--reason", "inventory corrected"]).assert_exit(0);
    folder.bench(["run", "--board", "left", "--out", "run"]).assert_exit(0);
    assert_eq!(folder.record("run").overrides.board.as_deref(), Some("left"));
}

#[test]
fn a_dead_board_stops_no_other_board() {
    let folder = lab("");
    let dead = rig("exec:false {port}");
    let probe = |rig: &str| format!("rig = \"{rig}\"\nprobe_serial = \"066DFF\"");
    folder.write("boards.toml", &inventory(&[("dead", dead), ("left", probe("hosted")), ("right", probe("hosted"))]));
    folder.bench(["run", "--board", "dead", "--out", "a"]).assert_exit(5);
    assert_eq!(state_of(&folder, 0)["state"], "free", "no voltage was applied");
    let first = start_minute(&folder);
    folder.bench(["run", "--board", "right", "--out", "b"]).assert_message(5, &["right is held"]);
    first.signal("TERM");
    first.finish().assert_exit(143);
    folder.bench(["run", "--board", "right", "--out", "b"]).assert_exit(0);
}

#[test]
fn a_soak_advances_its_seeds_and_ends_at_0_volt() {
    let folder = lab(&rig("hosted"));
    let soak = start_bench(folder.path(), ["board", "soak", "--board", "left", "--hours", "1", "--out", "soak"]);
    wait_until("too few runs", || {
        let text = fs::read_to_string(folder.join("soak/soak.json")).unwrap_or_default();
        serde_json::from_str::<serde_json::Value>(&text).is_ok_and(|soak| soak["runs"].as_u64() >= Some(4))
    });
    folder.bench(["report", "soak"]).assert_exit(0);
    assert!(folder.read("soak/report.html").contains("not ended"));
    soak.signal("INT");
    soak.finish().assert_exit(130);
    let record: serde_json::Value = serde_json::from_str(&folder.read("soak/soak.json")).unwrap();
    let runs = record["runs"].as_u64().unwrap();
    assert_eq!((&record["end"], &record["safe_confirmed"]), (&"cancelled".into(), &true.into()));
    assert_eq!(record["scenarios"]["s.toml"]["metrics"]["settling_time_ms"]["count"], runs);
    assert_eq!(state_of(&folder, 0)["state"], "free");
    let newest = folder.record(&format!("soak/{}", record["newest"].as_str().unwrap()));
    assert_eq!(newest.scenarios[0].trials[0].seed, runs, "the first seed is 1");
    assert!(fs::read_dir(folder.join("soak/runs")).unwrap().count() <= 2);
    folder.bench(["board", "soak", "--board", "left", "--hours", "1", "--out", "soak"]).assert_exit(2);
}
