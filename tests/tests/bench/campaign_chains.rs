//! Tests the methods `search` and `rare` of `platebench campaign`.

use crate::campaign::{folder, plan, play, results, summary};
use crate::test_folder::TestFolder;
use rstest::rstest;
use serde_json::Value;

fn folder_with(vary: &str, plan: &str) -> TestFolder {
    let folder = folder("");
    let text = format!("title = \"x\"\nscenario = \"step.toml\"\n[vary]\n{vary}{plan}");
    folder.write("campaign.toml", &text);
    folder
}

const SEARCH: &str = "[plan]\nmethod = \"search\"\ntrials = 200\n";

#[test]
fn a_search_writes_a_counterexample_that_fails() {
    let vary = "\"plate.mode.gain_um_per_vpp\" = { normal = { mean = 0.00698, sd_percent = 3.0 } }\n\
                \"plate.mode.time_constant_ms\" = { uniform = [1.5, 2.3] }\n";
    let folder = folder_with(vary, SEARCH);
    let run = folder.bench(["campaign", "run", "campaign.toml", "--out", "c"]);
    let summary = summary(&folder, "c");
    let search = &summary["search"];
    let smallest = folder.read("c/results.csv");
    let smallest = smallest.lines().skip(1).map(|line| {
        let fields: Vec<_> = line.split(',').collect();
        fields[5].parse::<f64>().unwrap().min(fields[7].parse().unwrap())
    });
    let smallest = smallest.fold(f64::INFINITY, f64::min);
    assert_eq!(search["margin"].as_f64().unwrap_or(f64::NEG_INFINITY), smallest);
    let trials = search["trials"].as_u64().unwrap();
    assert!((1..=200).contains(&trials), "{search}");
    let counterexample = search["counterexample"].as_str().unwrap();
    run.assert_exit(1).assert_stdout(&["worst case", counterexample, "in 200 trials"]);
    let file = format!("c/{counterexample}");
    folder.bench(["run", &file, "--rig", "hosted", "--out", "again"]).assert_exit(1);
}

#[rstest]
#[case::with_demand("[judge]\nat_most = 0.01\n", 3)]
#[case::without_demand("", 0)]
fn a_search_without_a_failure_proves_no_share(#[case] judge: &str, #[case] exit: i32) {
    let vary = "\"plate.mode.gain_um_per_vpp\" = { uniform = [0.00697, 0.00699] }\n";
    let folder = folder_with(vary, &format!("{SEARCH}{judge}"));
    let run = folder.bench(["campaign", "run", "campaign.toml", "--out", "c"]);
    run.assert_exit(exit).assert_stdout(&["no failing trial found"]);
    assert!(summary(&folder, "c")["search"]["counterexample"].is_null());
}

const RARE_VARY: &str = "\"plate.mode.gain_um_per_vpp\" = { normal = { mean = 0.00698, sd_percent = 1.0 } }\n\
    \"plate.mode.time_constant_ms\" = { lognormal = { mean = 1.88, sd_percent = 1.0 } }\n";

#[test]
fn rare_and_random_trials_agree() {
    let correlation = "[[correlate]]\nkeys = [\"plate.mode.gain_um_per_vpp\", \"plate.mode.time_constant_ms\"]\n\
                       coefficient = 0.5\n";
    let judge = "[judge]\nat_most = 0.5\n";
    let rare = format!("[plan]\nmethod = \"rare\"\ntrials = 3000\n{judge}{correlation}");
    let folder = folder_with(RARE_VARY, &rare);
    let mut merged = Vec::new();
    for (out, shards) in [("a", 1), ("b", 3)] {
        plan(&folder, out, shards);
        (1..=shards).rev().for_each(|shard| play(&folder, out, shard, 2));
        folder.bench(["campaign", "merge", out]);
        merged.push(results(&folder, out));
    }
    assert!(merged[0] == merged[1], "results depend on shards");
    let rare = summary(&folder, "a")["rare"].clone();
    assert_eq!(rare["trials"], 3_000);
    assert!(!rare["methods"].as_array().unwrap().is_empty() && rare["coefficient_of_variation"].is_f64(), "{rare}");
    let random = format!("[plan]\nmethod = \"random\"\ntrials = 20000\n{judge}{correlation}");
    let vary = format!("title = \"x\"\nscenario = \"step.toml\"\n[vary]\n{RARE_VARY}");
    folder.write("campaign.toml", &format!("{vary}{random}"));
    folder.bench(["campaign", "run", "campaign.toml", "--out", "c"]);
    let random = summary(&folder, "c")["overall"].clone();
    let end = |interval: &Value, end: usize| interval[end].as_f64().unwrap();
    let (rare, random) = (&rare["interval"], &random["interval"]);
    assert!(end(rare, 0) <= end(random, 1) && end(random, 0) <= end(rare, 1), "{rare} {random}");
}
