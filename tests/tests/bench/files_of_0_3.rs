//! Reads campaigns and baselines that platebench 0.3.0 wrote (`campaign-of-0.3`). Stored runs of 0.3
//! are in `sealed_trials.rs`.

use crate::campaign::summary;
use crate::test_folder::{TestFolder, workspace_root};
use std::fs;
use std::path::Path;

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target);
        } else {
            fs::copy(entry.path(), target).unwrap();
        }
    }
}

fn folder_of_0_3() -> TestFolder {
    let folder = TestFolder::new();
    copy(&workspace_root().join("tests/tests/bench/campaign-of-0.3"), folder.path());
    folder
}

#[test]
fn a_random_campaign_of_0_3_is_merged() {
    let folder = folder_of_0_3();
    folder.bench(["campaign", "merge", "random"]).assert_exit(0);
    assert_eq!(summary(&folder, "random")["overall"]["trials"], 8);
}

/// 0.4 has another method, which would read the stored scores as those of other points.
#[test]
fn a_rare_campaign_of_0_3_is_refused() {
    let folder = folder_of_0_3();
    let merged = folder.bench(["campaign", "merge", "rare"]);
    merged.assert_message(2, &["rare/parts/1.parquet", "from trial 0 on", "another version played it"]);
    assert!(!folder.exists("rare/summary.json"));
}

#[test]
fn a_baseline_of_0_3_is_compared() {
    let folder = folder_of_0_3();
    folder.bench(["run", "scenarios/step.toml", "--rig", "hosted", "--out", "run"]).assert_exit(0);
    folder.bench(["baseline", "diff", "run", "--baselines", "baselines"]).assert_exit(0);
}
