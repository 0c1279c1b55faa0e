//! Checks code blocks: scenarios, plates and plans load, other TOML parses, commands are valid.

use crate::command::{command_fault, commands};
use crate::page::{DocumentPage, read_pages, workspace_root};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

#[derive(Debug, PartialEq, Eq)]
enum TomlKind {
    Scenario,
    Plate,
    Plan,
    /// Part of a file, or a file of another program.
    Other,
}

fn toml_kind(table: &toml::Table) -> TomlKind {
    let has = |keys: &[&str]| keys.iter().all(|key| table.contains_key(*key));
    match () {
        () if has(&["title", "plate"]) => TomlKind::Scenario,
        () if has(&["name", "mode"]) => TomlKind::Plate,
        () if has(&["title", "requirement"]) => TomlKind::Plan,
        () => TomlKind::Other,
    }
}

fn example_folder() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let scenarios = folder.path().join("scenarios");
    fs::create_dir_all(scenarios.join("own")).unwrap();
    for entry in fs::read_dir(workspace_root().join("scenarios")).unwrap() {
        let path = entry.unwrap().path();
        std::os::unix::fs::symlink(&path, scenarios.join(path.file_name().unwrap())).unwrap();
    }
    folder
}

fn check_toml(text: &str) -> Result<TomlKind, String> {
    let table: toml::Table = match text.parse() {
        Ok(table) => table,
        // The block is no table, but it may list possible values of a key, one per line.
        Err(error) => {
            let values = text.lines().all(|line| format!("value = {line}").parse::<toml::Table>().is_ok());
            return if values { Ok(TomlKind::Other) } else { Err(error.to_string()) };
        }
    };
    let kind = toml_kind(&table);
    let root = example_folder();
    let plate = table.get("plate").and_then(toml::Value::as_str).unwrap_or_default();
    // A scenario with a plate `plates/…` belongs in `scenarios`, others in a subfolder of it.
    let folder = root.path().join(if plate.starts_with("plates/") { "scenarios" } else { "scenarios/own" });
    let path = folder.join("block.toml");
    fs::write(&path, text).unwrap();
    let loaded = match kind {
        TomlKind::Scenario => {
            let faults = platebench_model::scenario::find(std::slice::from_ref(&path)).map(drop);
            faults.map_err(|faults| faults.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))
        }
        TomlKind::Plate => check_plate(&path, &folder),
        TomlKind::Plan => platebench_lab::acceptance::AcceptancePlan::load(&path)
            .map(drop)
            .map_err(|faults| faults.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")),
        TomlKind::Other => Ok(()),
    };
    loaded.map(|()| kind)
}

fn check_plate(plate: &Path, folder: &Path) -> Result<(), String> {
    let text = format!(
        "title = \"t\"\nplate = \"{}\"\nduration_ms = 60.0\n[profile]\nsetpoint_um = 1.0\n\
         [[expect]]\nmetric = \"overruns\"\nat_most = 0\n",
        plate.display()
    );
    let scenario = folder.join("scenario.toml");
    fs::write(&scenario, text).unwrap();
    platebench_model::scenario::load(&scenario, "scenario.toml").map(drop).map_err(|fault| fault.to_string())
}

#[test]
fn every_toml_block_loads() {
    let mut found = Vec::new();
    let mut faults = Vec::new();
    // The tutorial has a test of its own, because one of its files is invalid on purpose.
    for page in read_pages().into_iter().filter(|page| !page.file.ends_with("docs/tutorial.md")) {
        for block in page.blocks.iter().filter(|block| block.language == "toml") {
            match check_toml(&block.text) {
                Ok(kind) => found.push(kind),
                Err(fault) => faults.push(format!("{}:{}: {fault}", page.file.display(), block.line)),
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    for kind in [TomlKind::Scenario, TomlKind::Plate, TomlKind::Plan, TomlKind::Other] {
        assert!(found.contains(&kind), "no block is a {kind:?}");
    }
}

#[test]
fn finds_blocks_that_do_not_load() {
    let scenario = DocumentPage::read(Path::new("docs/scenarios.md"))
        .blocks
        .into_iter()
        .find(|block| block.language == "toml")
        .unwrap()
        .text;
    assert_eq!(check_toml(&scenario), Ok(TomlKind::Scenario));
    assert!(check_toml(&scenario.replace("at_most", "at_mots")).is_err());
    assert!(check_toml(&scenario.replace("198x138", "198x139")).is_err());
    let plate = fs::read_to_string(workspace_root().join("scenarios/plates/aluminium-198x138.toml")).unwrap();
    assert_eq!(check_toml(&plate), Ok(TomlKind::Plate));
    assert!(check_toml(&plate.replace("time_constant_ms = ", "time_constant_ms = -")).is_err());
    assert!(check_toml("title = \"t\"\nrequirement = []\n").is_err(), "a plan without requirements");
    assert_eq!(check_toml("{ a = 1 }   # so\n[1, 2]\n"), Ok(TomlKind::Other));
    assert!(check_toml("{ a = 1 }\n] 2\n").is_err());
}

/// False for bare names of commands, and for text with alternatives, options or placeholders.
fn is_own_command(text: &str) -> bool {
    let words = text.split_whitespace().count();
    let own = text.starts_with("cargo ") || text.starts_with("platebench ");
    let complete = !text.contains(['[', '|', '<', '…']) && !text.contains("...");
    complete && (own && words > 2 || text.starts_with("ci/"))
}

#[test]
fn every_command_parses() {
    let mut checked = 0;
    let mut faults = Vec::new();
    for page in read_pages() {
        for block in &page.blocks {
            let (prompted, complete) = match &*block.language {
                "console" => (true, true),
                "sh" | "bash" => (false, true),
                "" | "indented" => (false, false),
                _ => continue,
            };
            for line in commands(&block.text, prompted).iter().filter(|line| complete || is_own_command(line)) {
                checked += 1;
                let fault = command_fault(line, &workspace_root());
                faults.extend(fault.map(|fault| format!("{}:{}: {line}: {fault}", page.file.display(), block.line)));
            }
        }
        for (code, line) in page.code_spans.iter().filter(|(code, _)| is_own_command(code)) {
            checked += 1;
            let fault = command_fault(code, &workspace_root());
            faults.extend(fault.map(|fault| format!("{}:{line}: {code}: {fault}", page.file.display())));
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(checked > 60, "only {checked} commands were found");
}
