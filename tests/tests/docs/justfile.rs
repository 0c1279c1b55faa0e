//! Compares the recipes of the justfile with the page for contributors and with CI.

use crate::command::command_fault;
use crate::page::workspace_root;
use std::fs;

fn recipes() -> Vec<(String, String)> {
    let text = fs::read_to_string(workspace_root().join("justfile")).unwrap();
    let lines: Vec<_> = text.lines().collect();
    let pairs = lines.windows(2).filter_map(|pair| Some((pair[0].split_once(':')?, pair[1].strip_prefix("    ")?)));
    let recipes = pairs.map(|((head, _), command)| (head.split_whitespace().next().unwrap(), command));
    recipes
        .filter(|(name, _)| *name != "default")
        .map(|(name, command)| (name.to_owned(), command.to_owned()))
        .collect()
}

#[test]
fn contributors_page_lists_every_recipe() {
    let page = fs::read_to_string(workspace_root().join("docs/CONTRIBUTING.md")).unwrap();
    let recipes = recipes();
    assert!(recipes.len() > 10, "{recipes:?}");
    for (name, command) in recipes {
        let command = command.replace(" {{ARGS}}", "").replace("{{NAME}}", "<NAME>");
        assert!(page.contains(&format!("`just {name}")), "docs/CONTRIBUTING.md has no recipe `{name}`");
        let listed = [format!("`{command}`"), format!("`{command} [ARGS]`")].iter().any(|text| page.contains(text));
        assert!(listed, "docs/CONTRIBUTING.md has no command `{command}`");
    }
}

#[test]
fn recipes_are_valid_commands() {
    for (name, command) in recipes().into_iter().filter(|(_, command)| !command.starts_with(".ci/")) {
        let command = command.replace("{{ARGS}}", "").replace("{{NAME}}", "plate");
        assert_eq!(command_fault(&command, &workspace_root()), None, "{name}");
    }
}

#[test]
fn ci_runs_the_recipes() {
    let ci = fs::read_to_string(workspace_root().join(".ci/run")).unwrap();
    let recipes = recipes();
    for name in ["check", "test", "tools", "firmware", "counts", "book"] {
        let (_, command) = recipes.iter().find(|(recipe, _)| recipe == name).unwrap();
        let command = command.replace(" {{ARGS}}", "");
        assert!(ci.contains(&command), ".ci/run does not run `{command}`, the recipe `{name}`");
    }
}
