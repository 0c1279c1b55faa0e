//! Which way imports may run: held by the manifests themselves.

use crate::bench::root;
use std::collections::BTreeMap;
use std::fs;
use toml::Table;

/// Crates from the bottom up. A crate may import only what stands before it.
const ORDER: [&str; 19] = [
    "firmware-under-test/wire",
    "firmware-under-test/controller",
    "firmware-under-test/host",
    "harness/plate",
    "harness/trace",
    "harness/scenario",
    "harness/verdict",
    "harness/rig",
    "harness/runner",
    "harness/live",
    "harness/trust",
    "harness/methods",
    "harness/analysis",
    "harness/identify",
    "harness/report",
    "harness/export",
    "harness/acceptance",
    "harness/native-tests",
    "harness/cli",
];

/// What may be imported, where that is less than everything before.
const ALLOWED: [(&str, &[&str]); 12] = [
    ("firmware-under-test/wire", &[]),
    ("firmware-under-test/controller", &["platebench-wire"]),
    ("firmware-under-test/host", &["platebench-wire", "platebench-controller"]),
    ("harness/plate", &[]),
    ("harness/trace", &[]),
    ("harness/scenario", &["platebench-plate"]),
    ("harness/verdict", &["platebench-plate", "platebench-trace", "platebench-scenario"]),
    ("harness/rig", &["platebench-wire", "platebench-controller"]),
    ("harness/methods", &["platebench-plate"]),
    ("harness/identify", &["platebench-plate", "platebench-trace", "platebench-verdict"]),
    ("harness/report", &["platebench-trace", "platebench-verdict"]),
    ("harness/export", &["platebench-trace", "platebench-verdict"]),
];

fn manifest(folder: &str) -> Table {
    fs::read_to_string(root().join(folder).join("Cargo.toml")).unwrap().parse().unwrap()
}

fn name(manifest: &Table) -> String {
    manifest["package"]["name"].as_str().unwrap().to_owned()
}

fn own_imports(manifest: &Table) -> Vec<String> {
    let dependencies = manifest.get("dependencies").and_then(|table| table.as_table());
    let names = dependencies.into_iter().flat_map(|table| table.keys());
    names.filter(|name| name.starts_with("platebench-")).cloned().collect()
}

#[test]
fn imports_run_one_way() {
    let manifests: Vec<_> = ORDER.iter().map(|folder| (*folder, manifest(folder))).collect();
    let rank: BTreeMap<_, _> =
        manifests.iter().enumerate().map(|(rank, (_, manifest))| (name(manifest), rank)).collect();
    for (own, (folder, manifest)) in manifests.iter().enumerate() {
        for import in own_imports(manifest) {
            let rank = rank.get(&import).unwrap_or_else(|| panic!("{folder} imports {import}, which nobody knows"));
            assert!(*rank < own, "{folder} imports {import}, which stands above it");
        }
    }
}

#[test]
fn some_crates_see_less_than_all_below_them() {
    for (folder, allowed) in ALLOWED {
        for import in own_imports(&manifest(folder)) {
            assert!(allowed.contains(&import.as_str()), "{folder} imports {import}");
        }
    }
}

#[test]
fn every_crate_is_in_the_list_and_under_the_shared_lints() {
    let workspace = manifest(".");
    let members = workspace["workspace"]["members"].as_array().unwrap();
    for member in members {
        let folder = member.as_str().unwrap();
        assert!(folder == "tests" || ORDER.contains(&folder), "{folder} has no place in the order");
        let manifest = manifest(folder);
        assert!(manifest.contains_key("lints"), "{folder} sets no lints");
    }
}
