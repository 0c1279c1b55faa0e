//! Checks the direction of imports between crates and between modules.

mod modules;

use crate::test_folder::workspace_root;
use modules::SourceTree;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use toml::Table;

/// Level of each crate. A crate may import only crates of lower levels.
const LEVELS: [(&str, u8); 25] = [
    ("firmware-under-test/wire", 0),
    ("firmware-under-test/controller", 0),
    ("firmware-under-test/host", 0),
    ("harness/plate", 0),
    ("harness/model/src/trace", 0),
    ("harness/rig", 1),
    ("harness/model/src/scenario", 1),
    ("harness/model/src/record", 2),
    ("harness/fmi", 1),
    ("harness/verdict/src/uncertainty", 2),
    ("harness/design/src/identify", 3),
    ("harness/verdict", 3),
    ("harness/engine", 4),
    ("harness/report", 4),
    ("harness/report/src/export", 4),
    ("harness/design", 5),
    ("harness/experiments/src/explore", 6),
    ("harness/experiments/src/campaign", 5),
    ("harness/lab/src/boards", 5),
    ("harness/experiments/src/trust", 5),
    ("harness/experiments/src/firmware_analysis", 5),
    ("harness/report/src/live", 5),
    ("harness/native-tests", 5),
    ("harness/lab/src/acceptance", 6),
    ("harness/cli", 7),
];

const WITHIN_LEVEL_0: [(&str, &str); 3] = [
    ("firmware-under-test/controller", "firmware-under-test/wire"),
    ("firmware-under-test/host", "firmware-under-test/wire"),
    ("firmware-under-test/host", "firmware-under-test/controller"),
];

const TEST_CRATES: [&str; 2] = ["tests", "tests/kit"];

/// Known violations of the rule. The list may only become shorter.
const OPEN: &str = include_str!("crate_layers/open.txt");

fn manifest(folder: &str) -> Table {
    fs::read_to_string(workspace_root().join(folder).join("Cargo.toml")).unwrap().parse().unwrap()
}

fn imported_crates(folder: &str, folders: &BTreeMap<String, String>) -> Vec<String> {
    let manifest = manifest(folder);
    let dependencies = manifest.get("dependencies").and_then(toml::Value::as_table);
    let names = dependencies.into_iter().flat_map(Table::keys).filter(|name| name.starts_with("platebench-"));
    names.map(|name| folders[name].clone()).collect()
}

fn crate_offences() -> Vec<String> {
    let workspace = manifest(".");
    let members = workspace["workspace"]["members"].as_array().unwrap().iter().map(|member| member.as_str().unwrap());
    let folders: BTreeMap<String, String> = members
        .map(|folder| (manifest(folder)["package"]["name"].as_str().unwrap().to_owned(), folder.to_owned()))
        .collect();
    let levels: BTreeMap<&str, u8> = LEVELS.into_iter().collect();
    let mut offences = Vec::new();
    for folder in folders.values().filter(|folder| !TEST_CRATES.contains(&folder.as_str())) {
        let Some(own) = levels.get(folder.as_str()) else {
            offences.push(format!("{folder}: has no level"));
            continue;
        };
        for import in imported_crates(folder, &folders) {
            let is_listed = WITHIN_LEVEL_0.contains(&(folder, &import));
            if !is_listed && levels.get(import.as_str()).is_none_or(|level| level >= own) {
                offences.push(format!("{folder}: imports {import}, which is not on a lower level"));
            }
        }
    }
    offences
}

#[track_caller]
fn assert_only_open(offences: Vec<String>, is_of_this_test: impl Fn(&str) -> bool) {
    let found: BTreeSet<String> = offences.into_iter().collect();
    let open: BTreeSet<String> = OPEN.lines().filter(|line| is_of_this_test(line)).map(str::to_owned).collect();
    let new: Vec<_> = found.difference(&open).cloned().collect();
    let closed: Vec<_> = open.difference(&found).cloned().collect();
    assert!(new.is_empty(), "imports that run the wrong way:\n{}", new.join("\n"));
    assert!(closed.is_empty(), "no longer open, delete from crate_layers/open.txt:\n{}", closed.join("\n"));
}

fn is_about_crates(line: &str) -> bool {
    line.contains("level")
}

#[test]
fn crates_import_only_lower_levels() {
    assert_only_open(crate_offences(), is_about_crates);
}

#[test]
fn every_crate_uses_the_shared_lints() {
    let workspace = manifest(".");
    let members = workspace["workspace"]["members"].as_array().unwrap().iter().map(|member| member.as_str().unwrap());
    let without: Vec<_> = members.filter(|folder| !manifest(folder).contains_key("lints")).collect();
    assert!(without.is_empty(), "no [lints] workspace = true: {without:?}");
}

#[test]
fn modules_have_no_import_cycles() {
    let offences = LEVELS.iter().flat_map(|(folder, _)| {
        let tree = SourceTree::read(&workspace_root().join(folder));
        let mut offences = tree.imports_of_ancestors();
        offences.extend(tree.cycles_between_siblings());
        offences.into_iter().map(move |offence| format!("{folder}: {offence}"))
    });
    assert_only_open(offences.collect(), |line| !is_about_crates(line));
}
