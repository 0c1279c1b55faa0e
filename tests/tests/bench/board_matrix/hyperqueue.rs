//! Tests the `hq submit` lines of the documentation and of `campaign submit` on `HyperQueue`.

use super::{DEAD, HEALTHY, KILLED, WRONG_CHIP, boards, clear_killed, kill_first_bench, lab, start_line};
use crate::boards::state_of;
use crate::campaign_engines;
use crate::test_folder::{ChildGuard, TestFolder, lock_heavy_load};
use platebench_model::record::{RunRecord, Verdict};
use platebench_test_kit::{skip_without, workspace_root};
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

const PYTHON: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../target/test-readers/bin/python");
const SUBMIT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/bench/board_matrix/hq_submit.py");

fn has_hyperqueue() -> bool {
    let import = Command::new(PYTHON).args(["-c", "import hyperqueue"]).stderr(Stdio::null()).status();
    let exists = import.is_ok_and(|status| status.success());
    if !exists {
        skip_without(&format!("hyperqueue for {PYTHON}"));
    }
    exists
}

/// Submits `line`. `names` are the boards that the worker offers.
fn start_submission(folder: &Path, names: &str, line: &str) -> ChildGuard {
    start_line(folder, &format!("'{PYTHON}' '{SUBMIT}' {names} {line}"), &[])
}

fn failed_tasks(folder: &TestFolder) -> Vec<String> {
    folder.read("failed.txt").split(',').filter(|task| !task.is_empty()).map(str::to_owned).collect()
}

fn errors(folder: &TestFolder, tasks: &[String]) -> String {
    let errors: Vec<_> = tasks.iter().map(|task| folder.read(&format!("hq-{task}.err"))).collect();
    errors.concat()
}

fn passed_runs(folder: &TestFolder) -> Vec<String> {
    let has_passed = |run: &str| {
        RunRecord::read(&folder.join(run)).is_ok_and(|record| record.complete && record.verdict == Verdict::Pass)
    };
    let runs = fs::read_dir(folder.join("runs")).unwrap().map(|run| run.unwrap().file_name().into_string().unwrap());
    let mut passed: Vec<_> = runs.map(|run| format!("runs/{run}")).filter(|run| has_passed(run)).collect();
    passed.sort_unstable();
    passed
}

#[test]
fn the_recipe_of_the_page_plays_all_shards_on_hyperqueue() {
    if !has_hyperqueue() {
        return;
    }
    let _guard = lock_heavy_load();
    let page = fs::read_to_string(workspace_root().join("docs/several-boards.md")).unwrap();
    let recipe = page.lines().find(|line| line.starts_with("hq submit")).unwrap();
    let folder = lab(8);
    folder.write("platebench.toml", "[run]\nclock = \"lockstep\"\n");
    kill_first_bench(&folder);
    let all: Vec<_> = boards().collect();
    start_submission(folder.path(), &all.join(","), recipe).finish().assert_exit(1);
    let failed = failed_tasks(&folder);
    let first = passed_runs(&folder);
    assert_eq!((first.len() + failed.len(), failed.is_empty()), (8, false), "{}", errors(&folder, &failed));
    let part = folder.bench(["report", "--out", "part", "--merge"].into_iter().chain(first.iter().map(String::as_str)));
    let missing: Vec<_> = failed.iter().map(|task| format!("shard {task}/8 of ")).collect();
    part.assert_text(3, &missing.iter().map(String::as_str).collect::<Vec<_>>());
    for (number, board) in all.iter().enumerate() {
        let state = state_of(&folder, number)["state"].clone();
        assert!(state == "free" || [KILLED, WRONG_CHIP].contains(board), "{board}: {state}");
    }
    assert_eq!(state_of(&folder, HEALTHY.len())["state"], "quarantined", "{DEAD}");
    clear_killed(&folder);
    let usable = all.iter().filter(|board| ![DEAD, WRONG_CHIP].contains(board)).copied().collect::<Vec<_>>();
    let again = recipe.replace("--array 1-8", &format!("--array {}", failed.join(",")));
    assert_ne!(again, recipe);
    start_submission(folder.path(), &usable.join(","), &again).finish().assert_exit(0);
    let runs = passed_runs(&folder);
    let merged = folder.bench(["report", "--out", "all", "--merge"].into_iter().chain(runs.iter().map(String::as_str)));
    merged.assert_exit(0);
    let record = folder.record("all");
    let mut files: Vec<_> =
        record.scenarios.iter().filter_map(|scenario| scenario.file.rsplit('/').next()).map(str::to_owned).collect();
    files.sort_unstable();
    let expected: Vec<_> = (1..=8).map(|number| format!("s{number}.toml")).collect();
    assert_eq!((files, record.verdict), (expected, Verdict::Pass));
}

#[test]
fn shards_killed_on_hyperqueue_resume_to_the_same_bytes() {
    if has_hyperqueue() {
        let start = |folder: &Path, line: &str| start_submission(folder, "x,y", line);
        campaign_engines::assert_same_bytes("hyperqueue", "hq submit", &start, 1);
    }
}
