//! Checks the recipes for continuous integration: YAML, commands and files of a run.

use crate::command::{bench_arguments, command_fault, commands};
use crate::page::workspace_root;
use std::fs;
use std::process::Command;
use yaml_serde::Value;

const RUN_FOLDER_FILES: [&str; 4] = ["comparison/", "junit.xml", "report.html", "run.json"];

fn recipe(name: &str) -> Value {
    yaml_serde::from_str(&fs::read_to_string(workspace_root().join("docs/examples/ci").join(name)).unwrap()).unwrap()
}

fn collect_texts(value: &Value, keys: &[&str], found: &mut Vec<String>) {
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
                collect_texts(value, keys, found);
            }
        }
        Value::Sequence(list) => list.iter().for_each(|value| collect_texts(value, keys, found)),
        _ => {}
    }
}

fn check_recipe(recipe: &Value, script: &[&str], kept: &[&str]) {
    let mut scripts = Vec::new();
    collect_texts(recipe, script, &mut scripts);
    let lines: Vec<String> = scripts.iter().flat_map(|script| commands(script, false)).collect();
    let mut out = None;
    let mut called = Vec::new();
    for line in &lines {
        // In the project of a recipe, the bench is a submodule in the folder `platebench`.
        let own = line.replace("platebench/harness/cli", "harness/cli");
        if let Some(fault) = command_fault(&own, &workspace_root()) {
            panic!("{line}: {fault}");
        }
        let words = shlex::split(line).unwrap();
        if let Some([command, arguments @ ..]) = bench_arguments(&words) {
            called.push(command.clone());
            if command == "run" {
                let at = arguments.iter().position(|word| word == "--out").expect("--out is missing");
                out = arguments.get(at + 1).cloned();
                assert!(arguments.iter().any(|word| word == "emulated:$ELF"), "another firmware is tested: {line}");
            }
        }
    }
    assert!(lines.iter().any(|line| line.starts_with("cargo install ")), "{lines:?}");
    let check = lines.iter().find(|line| line.contains("${ELF:?")).expect("no line checks ELF");
    for (elf, is_accepted) in [("", false), ("build/firmware.elf", true)] {
        let output = Command::new("bash").args(["-c", check]).env("ELF", elf).output().unwrap();
        assert_eq!(output.status.success(), is_accepted, "{check}");
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(message.contains("set ELF to the file of your firmware"), !is_accepted, "{message}");
    }
    for command in ["run", "compare", "baseline"] {
        assert!(called.iter().any(|called| called == command), "{command} is not called: {called:?}");
    }
    let out = out.expect("`run` is missing");
    let mut paths = Vec::new();
    collect_texts(recipe, kept, &mut paths);
    let paths: Vec<&str> = paths.iter().flat_map(|text| text.lines()).map(str::trim).collect();
    assert!(paths.contains(&&*format!("{out}/")), "the run folder is not kept: {paths:?}");
    for path in paths.iter().filter_map(|path| path.strip_prefix(&format!("{out}/"))) {
        assert!(path.is_empty() || RUN_FOLDER_FILES.contains(&path), "a run writes no {path}");
    }
}

#[test]
fn the_recipe_for_github() {
    let recipe = recipe("github.yml");
    check_recipe(&recipe, &["run"], &["path", "report_paths"]);
    let steps = recipe["jobs"]["bench"]["steps"].as_sequence().unwrap();
    for step in steps {
        assert!(step.get("run").is_some() != step.get("uses").is_some(), "a step has either `run` or `uses`: {step:?}");
    }
    let kept =
        steps.iter().find(|step| step["with"]["path"].as_str().is_some_and(|path| path.contains("run/"))).unwrap();
    assert_eq!(kept["if"].as_str(), Some("always()"), "a failed run must be kept");
}

#[test]
fn the_recipe_for_gitlab() {
    let recipe = recipe("gitlab.yml");
    check_recipe(&recipe, &["script", "before_script"], &["paths", "junit"]);
    let stages = recipe["stages"].as_sequence().unwrap();
    for (name, job) in recipe.as_mapping().unwrap() {
        if job.get("script").is_some() {
            assert!(stages.contains(&job["stage"]), "{name:?} is in no stage");
        }
    }
    let artifacts = &recipe["bench"]["artifacts"];
    assert_eq!(artifacts["when"].as_str(), Some("always"), "a failed run must be kept");
    assert_eq!(artifacts["reports"]["junit"].as_str(), Some("run/junit.xml"));
}
