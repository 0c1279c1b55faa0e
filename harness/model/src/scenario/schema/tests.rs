use super::{plate_schema, scenario_schema};
use crate::scenario::find::FileKind;
use std::fs;
use std::path::{Path, PathBuf};

fn tomls(folder: &Path, into: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            tomls(&path, into);
        } else if path.extension().is_some_and(|extension| extension == "toml") {
            into.push(path);
        }
    }
}

#[test]
fn accepts_every_scenario_and_plate_of_the_project() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios");
    let mut files = Vec::new();
    tomls(&root, &mut files);
    let validator = |schema: schemars::Schema| jsonschema::validator_for(schema.as_value()).unwrap();
    let (scenario, plate) = (validator(scenario_schema()), validator(plate_schema()));
    let mut counted = [0; 2];
    for file in files {
        let (validator, count) = match FileKind::detect(&file).unwrap() {
            FileKind::Scenario => (&scenario, &mut counted[0]),
            FileKind::Plate => (&plate, &mut counted[1]),
            _ => continue,
        };
        let document: toml::Table = fs::read_to_string(&file).unwrap().parse().unwrap();
        if let Err(fault) = validator.validate(&serde_json::to_value(document).unwrap()) {
            panic!("{}: {fault}", file.display());
        }
        *count += 1;
    }
    assert!(counted[0] > 100 && counted[1] > 5, "{counted:?}");
}

#[test]
fn every_key_has_a_description() {
    for schema in [scenario_schema(), plate_schema()] {
        let value = schema.as_value();
        let tables = value["$defs"].as_object().unwrap().values().chain([value]);
        for (key, about) in tables.filter_map(|table| table["properties"].as_object()).flatten() {
            assert!(about["description"].is_string(), "{key}");
        }
    }
}

/// Checks `text` against a committed schema. Other crates check that these schemas are current.
fn accepts(schema: &str, text: &str) -> bool {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/schema").join(schema);
    let schema: serde_json::Value = serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap();
    jsonschema::is_valid(&schema, &serde_json::to_value(text.parse::<toml::Table>().unwrap()).unwrap())
}

#[test]
fn accepts_the_plan_of_the_project_and_no_broken_one() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/plans/acceptance.toml");
    let plan = fs::read_to_string(path).unwrap();
    assert!(accepts("plan.json", &plan));
    assert!(accepts("plan.json", &plan.replacen("repetitions = 30", "repetitions = 100000", 1)));
    for (good, bad) in [
        ("title = ", "titel = "),
        ("repetitions = 30", "repetitions = 0"),
        ("repetitions = 30", "repetitions = 100001"),
        ("id = \"ACC-1\"", "id = \"ACC 1\""),
        ("when = \"after\"", "when = \"later\""),
        ("file = \"../paper/fig13-closed-loop.toml\"", "files = \"../paper/fig13-closed-loop.toml\""),
        ("least_kill_rate_percent = 36.0", "least_kill_rate_percent = 100.1"),
    ] {
        assert!(plan.contains(good), "{good}");
        assert!(!accepts("plan.json", &plan.replacen(good, bad, 1)), "{bad}");
    }
}

#[test]
fn accepts_only_known_settings() {
    assert!(accepts("config.json", "rig = \"hosted\"\njobs = 1024\nscenarios = [\"a\"]\n[run]\ntime_scale = 0.001"));
    for bad in
        ["rigs = \"hosted\"", "jobs = 0", "jobs = 1025", "format = \"xml\"", "[run]\ntime_scale = 0.0009", "[runs]"]
    {
        assert!(!accepts("config.json", bad), "{bad}");
    }
}
