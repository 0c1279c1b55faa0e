//! Checks real results against their JSON Schemas, and all schemas with a strict validator.

use crate::test_folder::{TestFolder, run_bench, step_text, workspace_root};
use platebench_test_kit::skip_without;
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::process::Command;

const MIXED: &str =
    "metric = \"settling_time_ms\"\nat_most = 2.0\n\n[[expect]]\nmetric = \"overshoot_percent\"\nat_least = 90.0";
const AJV: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/bench/ajv.mjs");
const NODE_MODULES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../target/test-node");

fn schema(kind: &str) -> Value {
    run_bench(&workspace_root(), ["generate", "schema", kind]).assert_exit(0).json()
}

/// Returns record and event lines of a failed run with a scenario that is not applicable.
fn mixed_run(folder: &TestFolder) -> (Value, Vec<Value>) {
    folder.write_scenario("s.toml", &step_text(MIXED));
    let output = folder.bench(["run", "--rig", "hosted", "--trials", "2", "--format", "json", "--out", "run"]);
    let lines = output.assert_exit(1).stdout.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    (serde_json::from_str(&folder.read("run/run.json")).unwrap(), lines)
}

#[test]
fn a_record_and_its_events_conform() {
    let folder = TestFolder::new();
    let (record, events) = mixed_run(&folder);
    let validator = jsonschema::validator_for(&schema("run")).unwrap();
    assert!(validator.is_valid(&record), "{:?}", validator.iter_errors(&record).collect::<Vec<_>>());
    for (pointer, value) in [("/verdict", "green".into()), ("/scenarios/0/trials/0/seed", Value::Null)] {
        let mut broken = record.clone();
        *broken.pointer_mut(pointer).unwrap() = value;
        assert!(!validator.is_valid(&broken), "{pointer}");
    }
    let validator = jsonschema::validator_for(&schema("events")).unwrap();
    assert_eq!(events.len(), 6);
    for event in events {
        assert!(validator.is_valid(&event), "{event}");
        let mut broken = event;
        broken["event"] = "other".into();
        assert!(!validator.is_valid(&broken));
    }
}

#[rstest]
#[case("list", &["run", "--list"])]
#[case("comparison", &["compare", "run", "run"])]
#[case("replay", &["replay", "run/traces/s/000.csv", "--rig", "hosted"])]
#[case("tuning", &["tune", "--plate", "scenarios/plates/aluminium-198x138.toml", "--samples", "2"])]
#[case("margins", &["stability", "--rig", "hosted", "--scenario", "scenarios/s.toml", "--margin", "force"])]
#[case("board-list", &["board", "list"])]
fn a_result_conforms(#[case] kind: &str, #[case] arguments: &[&str]) {
    let folder = TestFolder::with_step(MIXED);
    fs::write(folder.join("boards.toml"), "[[board]]\nname = \"a\"\nrig = \"hosted\"\n").unwrap();
    folder.run_hosted("run");
    let result = folder.bench(arguments.iter().chain(&["--format", "json"])).assert_exit(0).json();
    let validator = jsonschema::validator_for(&schema(kind)).unwrap();
    assert!(validator.is_valid(&result), "{result:#}: {:?}", validator.iter_errors(&result).collect::<Vec<_>>());
    assert!(!validator.is_valid(&Value::Null), "{kind}");
}

#[test]
fn the_record_names_build_and_computer() {
    let folder = TestFolder::new();
    let (record, _) = mixed_run(&folder);
    let version = folder.bench(["--version"]).assert_exit(0).stdout;
    let tool = &record["tool"];
    for key in ["version", "commit", "profile"] {
        let value = tool[key].as_str().unwrap_or_else(|| panic!("{key}: {tool}"));
        assert!(version.contains(value), "{value} is not in {version}");
    }
    assert!(record["host"]["kernel"].is_string(), "{}", record["host"]);
}

/// In strict mode, ajv refuses unknown formats and keywords and requires an identifier per schema.
#[test]
fn a_strict_validator_accepts_every_schema() {
    if !std::path::Path::new(NODE_MODULES).join("node_modules/ajv").exists() {
        return skip_without("ajv in target/test-node");
    }
    let folder = TestFolder::new();
    let (record, events) = mixed_run(&folder);
    let plan = fs::read_to_string(workspace_root().join("scenarios/plans/acceptance.toml")).unwrap();
    let plan = serde_json::to_value(plan.parse::<toml::Table>().unwrap()).unwrap();
    let documents = serde_json::json!({ "run": [record], "events": events, "plan": [plan] });
    let path = folder.join("documents.json");
    fs::write(&path, documents.to_string()).unwrap();
    let schemas = workspace_root().join("scenarios/schema");
    let output = Command::new("node").args([AJV, NODE_MODULES]).args([&schemas, &path]).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    assert!(text.contains("8 documents"), "{text}");
}
