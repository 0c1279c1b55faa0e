//! Tests which ends of a run put a board into quarantine and which do not.

use crate::boards::{inventory, state_of};
use crate::test_folder::{SETTLING, TestFolder, controller_rig, start_bench, wait_until};
use std::fs;
use std::process::Command;

const LEFT: usize = 0;

fn lab(rig: &str) -> TestFolder {
    let folder = TestFolder::with_step(SETTLING);
    folder.write(
        "boards.toml",
        &inventory(&[("left", format!("rig = \"{rig}\"")), ("right", "rig = \"hosted\"".to_owned())]),
    );
    folder
}

#[track_caller]
fn assert_only_left_is_quarantined(folder: &TestFolder, reason: &str) {
    let left = state_of(folder, LEFT);
    assert_eq!(left["state"], "quarantined", "{left}");
    assert!(left["reason"].as_str().unwrap().contains(reason), "{left}");
    folder.bench(["run", "--board", "left", "--out", "refused"]).assert_message(5, &["clear left"]);
    assert!(!folder.exists("refused"));
    folder.bench(["run", "--board", "right", "--out", "right"]).assert_exit(0);
    folder.bench(["board", "clear", "left", "--reason", "0 V measured"]).assert_exit(0);
    assert_eq!(state_of(folder, LEFT)["state"], "free");
}

#[test]
fn a_controller_that_ends_leaves_0_v_unconfirmed() {
    let minute = TestFolder::with_minute();
    let log = minute.join("controller.log");
    let folder = lab(&controller_rig(Some(&log)));
    folder.write("minute.toml", &minute.read("scenarios/s.toml").replace("\"plates/", "\"scenarios/plates/"));
    let bench = start_bench(folder.path(), ["run", "minute.toml", "--board", "left", "--out", "run"]);
    wait_until("no trial began", || fs::read_to_string(&log).is_ok_and(|text| text.contains("\"running\"")));
    assert!(Command::new("kill").args(["-KILL", &bench.child_id()]).status().unwrap().success());
    bench.finish().assert_exit(1);
    assert_only_left_is_quarantined(&folder, "did not confirm 0 V");
}

#[test]
fn a_board_lost_during_a_trial_is_quarantined_despite_0_v() {
    let program = env!("CARGO_BIN_EXE_real-plate-under-test");
    let folder = lab(&format!("exec:'{program}' {{port}} mute=20"));
    folder
        .bench(["run", "--plate-mode", "real", "--board", "left", "--reply-timeout", "5000", "--out", "run"])
        .assert_exit(5);
    assert_eq!(folder.record("run").safe_confirmed, Some(true));
    assert_only_left_is_quarantined(&folder, "lost during a trial");
}
