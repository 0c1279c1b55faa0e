//! Tests what a report of real runs contains: texts of requirements, and the example in
//! docs/report.md.

use crate::test_folder::{SETTLING, TestFolder, run_bench, step_text, workspace_root};
use std::collections::BTreeMap;
use std::fs;

const TEXT: &str = "It settles in two periods.";

fn requirement_texts(file: &str) -> BTreeMap<String, String> {
    let text = fs::read_to_string(workspace_root().join("scenarios").join(file)).unwrap();
    let table: toml::Table = text.parse().unwrap();
    let requirements = table["requirement"].as_array().unwrap().iter();
    requirements.map(|one| ["id", "text"].map(|key| one[key].as_str().unwrap().to_owned()).into()).collect()
}

#[test]
fn the_report_has_the_texts_of_requirements() {
    let folder = TestFolder::new();
    folder.write_scenario("s.toml", &step_text(&format!("{SETTLING}\nrequirement = \"R-1\"")));
    folder.bench(["run", "--rig", "hosted", "--out", "without"]).assert_exit(0);
    assert!(!folder.read("without/report.html").contains("<dt>R-1"));
    folder.write("scenarios/requirements.toml", &format!("[[requirement]]\nid = \"R-1\"\ntext = \"{TEXT}\"\n"));
    folder.bench(["run", "--rig", "hosted", "--out", "run"]).assert_exit(0);
    // The text occurs at the scenario and in the table of requirements.
    assert_eq!(folder.read("run/report.html").matches(TEXT).count(), 2);
    assert_eq!(folder.record("run").scenarios[0].requirement_texts["R-1"], TEXT);
    // The record contains the texts, so the file of requirements may be deleted.
    fs::remove_file(folder.join("scenarios/requirements.toml")).unwrap();
    folder.bench(["report", "run", "--rejudge"]).assert_exit(0);
    folder.bench(["report", "run"]).assert_exit(0);
    assert_eq!(folder.read("run/report.html").matches(TEXT).count(), 2);
}

/// The plan of an acceptance session repeats the texts of its requirements.
#[test]
fn plan_and_list_have_the_same_texts() {
    let list = requirement_texts("requirements.toml");
    for (id, text) in requirement_texts("plans/acceptance.toml") {
        assert_eq!(list.get(&id), Some(&text), "{id}");
    }
}

/// docs/report.md explains the report of this scenario.
#[test]
fn the_report_of_three_taps_leads_to_the_cause() {
    let folder = TestFolder::new();
    let example = workspace_root().join("docs/examples/three-taps.toml");
    let out = folder.join("run");
    let arguments = ["run", "--rig", "hosted", "--out"].map(std::ffi::OsString::from);
    run_bench(&workspace_root(), arguments.into_iter().chain([out.into(), example.into()])).assert_exit(1);
    let page = folder.read("run/report.html");
    for text in
        ["recovery_time_ms ≤ 6 ms, window 460 … 600 ms", "Finger force", "Excitation frequency against resonance"]
    {
        assert!(page.contains(text), "{text}");
    }
    // The overshoot occurs after the third tap, so it must not be reported for the first step.
    assert!(!page.contains("The settling time passes, but"));
    let rows = platebench_model::trace::read_trace(&folder.join("run/traces/three-taps/000.csv")).unwrap();
    let last = rows.last().unwrap();
    assert!((last.frequency_hz - 32_277.6).abs() < 1e-3 && last.resonance_hz < 32_255.0, "{last:?}");
}
