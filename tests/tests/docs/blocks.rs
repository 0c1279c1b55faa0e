//! Code blocks: a whole scenario, plate or plan loads, every other TOML parses, and every command can be typed.

use crate::command::{commands, fault};
use crate::page::{Page, pages, root};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

/// What a TOML block is.
#[derive(Debug, PartialEq, Eq)]
enum Kind {
    Scenario,
    Plate,
    Plan,
    /// Part of a file, or of another program's.
    Other,
}

fn kind(table: &toml::Table) -> Kind {
    let has = |keys: &[&str]| keys.iter().all(|key| table.contains_key(*key));
    match () {
        () if has(&["title", "plate"]) => Kind::Scenario,
        () if has(&["name", "mode"]) => Kind::Plate,
        () if has(&["title", "requirement"]) => Kind::Plan,
        () => Kind::Other,
    }
}

/// A folder in which what pages name is where they say.
fn desk() -> TempDir {
    let desk = tempfile::tempdir().unwrap();
    let scenarios = desk.path().join("scenarios");
    fs::create_dir_all(scenarios.join("own")).unwrap();
    for folder in fs::read_dir(root().join("scenarios")).unwrap() {
        let path = folder.unwrap().path();
        std::os::unix::fs::symlink(&path, scenarios.join(path.file_name().unwrap())).unwrap();
    }
    desk
}

/// What is wrong with a TOML block.
fn toml_fault(text: &str) -> Result<Kind, String> {
    let table: toml::Table = match text.parse() {
        Ok(table) => table,
        // A list of values that a key may have, one a line.
        Err(error) => {
            let values = text.lines().all(|line| format!("value = {line}").parse::<toml::Table>().is_ok());
            return if values { Ok(Kind::Other) } else { Err(error.to_string()) };
        }
    };
    let kind = kind(&table);
    let desk = desk();
    let plate = table.get("plate").and_then(toml::Value::as_str).unwrap_or_default();
    // Pages write scenarios as they stand in a folder below `scenarios`, or beside `plates`.
    let folder = desk.path().join(if plate.starts_with("plates/") { "scenarios" } else { "scenarios/own" });
    let path = folder.join("block.toml");
    fs::write(&path, text).unwrap();
    let told = match kind {
        Kind::Scenario => platebench_scenario::load(&path, "block.toml").map(drop).map_err(|fault| fault.to_string()),
        Kind::Plate => plate_fault(&path, &folder),
        Kind::Plan => platebench_acceptance::Plan::load(&path)
            .map(drop)
            .map_err(|faults| faults.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")),
        Kind::Other => Ok(()),
    };
    told.map(|()| kind)
}

/// A plate is loaded by a scenario that names it.
fn plate_fault(plate: &Path, folder: &Path) -> Result<(), String> {
    let text = format!(
        "title = \"t\"\nplate = \"{}\"\nduration_ms = 60.0\n[profile]\nsetpoint_um = 1.0\n[[expect]]\nmetric = \"overruns\"\nat_most = 0\n",
        plate.display()
    );
    let scenario = folder.join("scenario.toml");
    fs::write(&scenario, text).unwrap();
    platebench_scenario::load(&scenario, "scenario.toml").map(drop).map_err(|fault| fault.to_string())
}

#[test]
fn every_toml_block_is_a_file_that_loads() {
    let mut found = Vec::new();
    let mut faults = Vec::new();
    // The tutorial's own test holds its files: one of them is refused on purpose.
    for page in pages().into_iter().filter(|page| !page.file.ends_with("docs/tutorial.md")) {
        for block in page.blocks.iter().filter(|block| block.language == "toml") {
            match toml_fault(&block.text) {
                Ok(kind) => found.push(kind),
                Err(fault) => faults.push(format!("{}:{}: {fault}", page.file.display(), block.line)),
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    for kind in [Kind::Scenario, Kind::Plate, Kind::Plan, Kind::Other] {
        assert!(found.contains(&kind), "no block is a {kind:?}: what is recognised?");
    }
}

#[test]
fn blocks_that_do_not_load_are_seen() {
    let scenario =
        Page::read(Path::new("README.md")).blocks.into_iter().find(|block| block.language == "toml").unwrap().text;
    assert_eq!(toml_fault(&scenario), Ok(Kind::Scenario));
    assert!(toml_fault(&scenario.replace("at_most", "at_mots")).is_err());
    assert!(toml_fault(&scenario.replace("198x138", "198x139")).is_err());
    let plate = fs::read_to_string(root().join("scenarios/plates/aluminium-198x138.toml")).unwrap();
    assert_eq!(toml_fault(&plate), Ok(Kind::Plate));
    assert!(toml_fault(&plate.replace("time_constant_ms = ", "time_constant_ms = -")).is_err());
    assert!(toml_fault("title = \"t\"\nrequirement = []\n").is_err(), "a plan without requirements");
    assert_eq!(toml_fault("{ a = 1 }   # so\n[1, 2]\n"), Ok(Kind::Other));
    assert!(toml_fault("{ a = 1 }\n] 2\n").is_err());
}

#[test]
fn every_command_can_be_typed() {
    let mut checked = 0;
    let mut faults = Vec::new();
    for page in pages() {
        for block in &page.blocks {
            let prompted = match &*block.language {
                "console" => true,
                "sh" | "bash" => false,
                _ => continue,
            };
            for line in commands(&block.text, prompted) {
                checked += 1;
                let fault = fault(&line, &root());
                faults.extend(fault.map(|fault| format!("{}:{}: {line}: {fault}", page.file.display(), block.line)));
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(checked > 10, "only {checked} commands were found");
}
