//! The recipes for continuous integration: valid YAML, commands that can be typed, and files that the run writes.

use crate::command::{commands, fault, of_bench};
use crate::page::root;
use std::fs;
use yaml_serde::Value;

/// What a run folder has for people and machines.
const WRITTEN: [&str; 3] = ["junit.xml", "report.html", "run.json"];

fn recipe(name: &str) -> Value {
    yaml_serde::from_str(&fs::read_to_string(root().join("docs/examples/ci").join(name)).unwrap()).unwrap()
}

/// Every text below `key`, also in lists.
fn texts(value: &Value, keys: &[&str], found: &mut Vec<String>) {
    match value {
        Value::Mapping(mapping) => {
            for (key, value) in mapping {
                if key.as_str().is_some_and(|key| keys.contains(&key)) {
                    match value {
                        Value::String(text) => found.push(text.clone()),
                        Value::Sequence(list) => {
                            found.extend(list.iter().filter_map(Value::as_str).map(str::to_owned));
                        }
                        _ => {}
                    }
                }
                texts(value, keys, found);
            }
        }
        Value::Sequence(list) => list.iter().for_each(|value| texts(value, keys, found)),
        _ => {}
    }
}

/// Holds a recipe's commands, of which there are some of the bench's, and what it keeps of a run.
fn hold(recipe: &Value, script: &[&str], kept: &[&str]) {
    let mut scripts = Vec::new();
    texts(recipe, script, &mut scripts);
    let lines: Vec<String> = scripts.iter().flat_map(|script| commands(script, false)).collect();
    let mut out = None;
    let mut told = Vec::new();
    for line in &lines {
        // The project that a recipe is copied to has scenarios, firmware and the bench in folders of its own.
        let elsewhere = line.replace("platebench/harness/cli", "harness/cli");
        if let Some(fault) = fault(&elsewhere, &root()) {
            panic!("{line}: {fault}");
        }
        let words = shlex::split(line).unwrap();
        if let Some([command, arguments @ ..]) = of_bench(&words) {
            told.push(command.clone());
            if command == "run" {
                let at = arguments.iter().position(|word| word == "--out").expect("the run folder is named");
                out = arguments.get(at + 1).cloned();
            }
        }
    }
    assert!(lines.iter().any(|line| line.starts_with("cargo install ")), "{lines:?}");
    for command in ["run", "compare", "baseline"] {
        assert!(told.iter().any(|told| told == command), "{command} is not called: {told:?}");
    }
    let out = out.expect("the suite is played");
    let mut paths = Vec::new();
    texts(recipe, kept, &mut paths);
    let paths: Vec<&str> = paths.iter().flat_map(|text| text.lines()).map(str::trim).collect();
    assert!(paths.contains(&&*format!("{out}/")), "the run folder is not kept: {paths:?}");
    for path in paths.iter().filter_map(|path| path.strip_prefix(&format!("{out}/"))) {
        assert!(path.is_empty() || WRITTEN.contains(&path), "no run writes {path}");
    }
}

#[test]
fn the_recipe_for_github() {
    let recipe = recipe("github.yml");
    hold(&recipe, &["run"], &["path", "report_paths"]);
    let steps = recipe["jobs"]["bench"]["steps"].as_sequence().unwrap();
    for step in steps {
        assert!(
            step.get("run").is_some() != step.get("uses").is_some(),
            "a step runs something or uses something: {step:?}"
        );
    }
    let kept =
        steps.iter().find(|step| step["with"]["path"].as_str().is_some_and(|path| path.contains("run/"))).unwrap();
    assert_eq!(kept["if"].as_str(), Some("always()"), "a failed run is the one to look at");
}

#[test]
fn the_recipe_for_gitlab() {
    let recipe = recipe("gitlab.yml");
    hold(&recipe, &["script", "before_script"], &["paths", "junit"]);
    let stages = recipe["stages"].as_sequence().unwrap();
    for (name, job) in recipe.as_mapping().unwrap() {
        if job.get("script").is_some() {
            assert!(stages.contains(&job["stage"]), "{name:?} is in no stage");
        }
    }
    let artifacts = &recipe["bench"]["artifacts"];
    assert_eq!(artifacts["when"].as_str(), Some("always"), "a failed run is the one to look at");
    assert_eq!(artifacts["reports"]["junit"].as_str(), Some("run/junit.xml"));
}
