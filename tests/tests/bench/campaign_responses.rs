//! Tests the links from the maps of a campaign to the responses of its worst trials.

use crate::campaign::{GRID, folder, summary};
use crate::test_folder::workspace_root;
use serde_json::Value;
use std::fs;

#[test]
fn a_cell_opens_the_response_of_its_worst_trial() {
    let folder = folder(GRID);
    folder.bench(["campaign", "run", "campaign.toml", "--out", "c"]);
    let summary = summary(&folder, "c");
    let read = |name: &str| fs::read_to_string(folder.join("c").join(name)).unwrap();
    let (csv, maps, responses) = (read("results.csv"), read("report.html"), read("worst/run/report.html"));
    let played: Value = serde_json::from_str(&read("worst/run/run.json")).unwrap();
    let played = played["scenarios"].as_array().unwrap();
    for cell in summary["cells"].as_array().unwrap() {
        let trial = cell["worst_trial"].to_string();
        let index = played.iter().position(|scenario| scenario["file"] == *format!("{trial}.toml")).unwrap();
        let row = csv.lines().find(|line| line.starts_with(&format!("{trial},"))).unwrap();
        let row: Vec<_> = row.split(',').collect();
        for (expectation, value) in played[index]["expectations"].as_array().unwrap().iter().zip([row[6], row[8]]) {
            assert_eq!(expectation["value"].as_f64(), value.parse().ok(), "{trial}: {expectation}");
        }
        let (law, force) = (row[2], row[3].trim_end_matches(".0"));
        let link = format!(
            "href=\"worst/run/report.html#scenario-{index}\" title=\"law {law}, finger_force_n {force}; trial {trial}\""
        );
        // Four maps: the share of failing trials, the smallest margin, and one per expectation.
        assert_eq!(maps.matches(&link).count(), 4, "{link}");
        assert!(responses.contains(&format!("id=\"scenario-{index}\"")), "{trial}");
    }
    let headings: Vec<_> = maps.split("<h2>").skip(1).filter_map(|text| text.split_once('<')).collect();
    let headings: Vec<_> = headings.into_iter().map(|(heading, _)| heading).collect();
    assert_eq!(
        headings[..2],
        ["Maps", "Largest profile.finger_force_n that passes with all smaller ones"],
        "{headings:?}"
    );
}

#[test]
fn a_merge_without_the_firmware_of_the_plan_shows_no_responses() {
    let folder = folder("[plan]\nmethod = \"random\"\ntrials = 2\n");
    let elf = folder.join("firmware.elf");
    fs::copy(workspace_root().join("firmware-under-test/images/platebench-stm32f4.elf"), &elf).unwrap();
    let run = ["campaign", "run", "campaign.toml", "--rig", "emulated:firmware.elf", "--out", "c"];
    let exit = folder.bench(run).exit;
    let page = || folder.read("c/report.html");
    assert!(page().contains("href=\"worst/run/report.html#scenario-"));
    fs::write(&elf, [fs::read(&elf).unwrap(), vec![0]].concat()).unwrap();
    let merged = folder.bench(["campaign", "merge", "c"]);
    assert_eq!(merged.assert_stderr(&["no responses of the worst trials", "not the one of the plan"]).exit, exit);
    assert!(!page().contains("href=\"worst/run"));
}
