//! Checks the direction of imports between crates and between modules.

mod modules;

use crate::test_folder::workspace_root;
use modules::SourceTree;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::process::Command;
use toml::Table;

/// Known import cycles between modules. The list may only become shorter.
const OPEN: &str = include_str!("crate_layers/open.txt");

/// Level of each crate's folder: the table in `docs/architecture.md`.
fn levels() -> BTreeMap<String, u8> {
    let page = fs::read_to_string(workspace_root().join("docs/architecture.md")).unwrap();
    let row = |line: &str| {
        let mut cells = line.split('|').skip(1).map(str::trim);
        let level = cells.next()?.parse().ok()?;
        Some((cells.next()?.trim_matches('`').to_owned(), level))
    };
    page.lines().filter_map(row).collect()
}

/// Folder of each workspace crate, with the folders of the crates that it imports outside of tests.
fn crates() -> BTreeMap<String, Vec<String>> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut metadata = Command::new(cargo);
    metadata.args(["metadata", "--no-deps", "--format-version", "1"]).current_dir(workspace_root());
    let metadata: Value = serde_json::from_slice(&metadata.output().unwrap().stdout).unwrap();
    let folder = |path: &str| path.strip_prefix(workspace_root().to_str().unwrap()).unwrap()[1..].to_owned();
    let packages = metadata["packages"].as_array().unwrap().iter().map(|package| {
        let manifest = package["manifest_path"].as_str().unwrap().strip_suffix("/Cargo.toml").unwrap();
        let imports = package["dependencies"].as_array().unwrap().iter().filter(|import| import["kind"].is_null());
        (folder(manifest), imports.filter_map(|import| import["path"].as_str()).map(folder).collect())
    });
    packages.collect()
}

#[test]
fn crates_import_only_lower_levels() {
    let (levels, crates) = (levels(), crates());
    let product = crates.iter().filter(|(folder, _)| !folder.starts_with("tests"));
    let offences: Vec<_> = product
        .flat_map(|(folder, imports)| imports.iter().map(move |import| (folder, import)))
        .filter(|&(folder, import)| levels[import] >= levels[folder])
        .collect();
    assert!(offences.is_empty(), "not on a lower level: {offences:?}");
}

#[test]
fn every_crate_uses_the_shared_lints() {
    let has_lints = |folder: &str| {
        let text = fs::read_to_string(workspace_root().join(folder).join("Cargo.toml")).unwrap();
        text.parse::<Table>().unwrap().contains_key("lints")
    };
    let without: Vec<_> = crates().into_keys().filter(|folder| !has_lints(folder)).collect();
    assert!(without.is_empty(), "no [lints] workspace = true: {without:?}");
}

#[test]
fn modules_have_no_import_cycles() {
    let product = crates().into_keys().filter(|folder| !folder.starts_with("tests"));
    let found: BTreeSet<String> = product
        .flat_map(|folder| {
            let tree = SourceTree::read(&workspace_root().join(&folder));
            let offences = tree.imports_of_ancestors().into_iter().chain(tree.cycles_between_siblings());
            offences.map(|offence| format!("{folder}: {offence}")).collect::<Vec<_>>()
        })
        .collect();
    let open: BTreeSet<String> = OPEN.lines().map(str::to_owned).collect();
    let new: Vec<_> = found.difference(&open).collect();
    let closed: Vec<_> = open.difference(&found).collect();
    assert!(new.is_empty(), "imports that run the wrong way: {new:#?}");
    assert!(closed.is_empty(), "no longer open, delete from crate_layers/open.txt: {closed:#?}");
}
