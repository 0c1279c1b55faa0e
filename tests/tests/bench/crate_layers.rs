//! Checks the direction of imports between crates.

use crate::test_folder::workspace_root;
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs;
use std::process::Command;

const WRITE_LINT: &str = "#![cfg_attr(not(test), warn(clippy::disallowed_methods))]";

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

#[test]
fn crates_import_only_lower_levels_and_use_the_shared_lints() {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut metadata = Command::new(cargo);
    metadata.args(["metadata", "--no-deps", "--format-version", "1"]).current_dir(workspace_root());
    let metadata: Value = serde_json::from_slice(&metadata.output().unwrap().stdout).unwrap();
    let folder = |path: &str| path.strip_prefix(workspace_root().to_str().unwrap()).unwrap()[1..].to_owned();
    let levels = levels();
    for package in metadata["packages"].as_array().unwrap() {
        let manifest = package["manifest_path"].as_str().unwrap();
        let table: toml::Table = fs::read_to_string(manifest).unwrap().parse().unwrap();
        assert!(table.contains_key("lints"), "{manifest}: expected [lints] workspace = true");
        let crate_folder = folder(manifest.strip_suffix("/Cargo.toml").unwrap());
        if crate_folder.starts_with("tests") {
            continue;
        }
        // The lint that refuses functions which write files, see `clippy.toml`.
        if crate_folder.starts_with("harness") {
            let root = workspace_root().join(&crate_folder).join("src/lib.rs");
            let is_enabled = fs::read_to_string(&root).unwrap().contains(WRITE_LINT);
            assert!(is_enabled, "{}: expected {WRITE_LINT}", root.display());
        }
        let imports = package["dependencies"].as_array().unwrap().iter().filter(|import| import["kind"].is_null());
        for import in imports.filter_map(|import| import["path"].as_str()).map(folder) {
            assert!(levels[&import] < levels[&crate_folder], "{crate_folder} imports {import}, expected a lower level");
        }
    }
}
