//! Applies the diffs of the page for contributors, so that its examples stay possible.

use crate::page::{DocumentPage, workspace_root};
use std::collections::BTreeSet;
use std::fs;
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};

/// Each block with its line in the page.
fn diffs() -> Vec<(usize, String)> {
    let page = DocumentPage::read(Path::new("docs/CONTRIBUTING.md"));
    let diffs = page.blocks.into_iter().filter(|block| block.language == "diff");
    diffs.map(|block| (block.line, block.text)).collect()
}

fn apply(folder: &Path, diff: &str, options: &[&str]) -> Result<(), String> {
    let mut git = Command::new("git");
    git.arg("apply").args(options).current_dir(folder).env("GIT_CEILING_DIRECTORIES", folder.parent().unwrap());
    let mut git = git.stdin(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    git.stdin.take().unwrap().write_all(diff.as_bytes()).unwrap();
    let output = git.wait_with_output().unwrap();
    if output.status.success() { Ok(()) } else { Err(String::from_utf8_lossy(&output.stderr).into_owned()) }
}

fn copy_tracked_files(target: &Path) {
    let listed = Command::new("git").args(["ls-files", "-z"]).current_dir(workspace_root()).output().unwrap();
    assert!(listed.status.success(), "{}", String::from_utf8_lossy(&listed.stderr));
    for file in String::from_utf8(listed.stdout).unwrap().split_terminator('\0') {
        // A file that is deleted but not committed is still tracked.
        let Ok(content) = fs::read(workspace_root().join(file)) else { continue };
        let copy = target.join(file);
        fs::create_dir_all(copy.parent().unwrap()).unwrap();
        fs::write(copy, content).unwrap();
    }
}

/// Name of the crate that contains the file.
fn package_of(root: &Path, file: &str) -> Option<String> {
    let folders = Path::new(file).ancestors().skip(1).map(|folder| root.join(folder).join("Cargo.toml"));
    let manifest = folders.into_iter().find(|path| path.exists())?;
    let manifest: toml::Table = fs::read_to_string(manifest).unwrap().parse().unwrap();
    Some(manifest.get("package")?.get("name")?.as_str()?.to_owned())
}

#[test]
fn every_diff_applies() {
    let diffs = diffs();
    assert!(!diffs.is_empty(), "docs/CONTRIBUTING.md has no block `diff`");
    for (line, diff) in diffs {
        let applied = apply(&workspace_root(), &diff, &["--check"]);
        assert_eq!(applied, Ok(()), "docs/CONTRIBUTING.md:{line}");
    }
}

/// Compiles the changed crates. The warm target folder keeps the other crates.
#[test]
#[ignore = "compiles crates; `.ci/run` runs it"]
fn every_diff_compiles() {
    let folder = tempfile::tempdir().unwrap();
    copy_tracked_files(folder.path());
    let mut packages = BTreeSet::new();
    for (line, diff) in diffs() {
        assert_eq!(apply(folder.path(), &diff, &[]), Ok(()), "docs/CONTRIBUTING.md:{line}");
        let files = diff.lines().filter_map(|line| line.strip_prefix("+++ b/"));
        packages.extend(files.filter_map(|file| package_of(folder.path(), file)));
    }
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| workspace_root().join("target"), Into::into);
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    cargo.args(["check", "--locked", "--offline", "--ignore-rust-version", "--quiet"]);
    cargo.args(packages.iter().flat_map(|package| ["--package", package]));
    let checked = cargo.current_dir(folder.path()).env("CARGO_TARGET_DIR", target).output().unwrap();
    assert!(checked.status.success(), "{packages:?}: {}", String::from_utf8_lossy(&checked.stderr));
}
