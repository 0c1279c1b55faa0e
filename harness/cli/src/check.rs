//! `platebench check`: what is wrong with the files that people write, without playing anything.

use crate::config::{self, Config};
use crate::exit::Exit;
use crate::output;
use clap::Args;
use platebench_acceptance::Plan;
use platebench_runner::law;
use platebench_scenario::{Diagnostic, every_file, examine, input, load};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use toml::de::DeTable;

/// `platebench check`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench check                          every scenario, plate and plan below scenarios/
  platebench check scenarios/paper my.toml
  platebench check platebench.toml

Exit codes: 0 nothing wrong, 2 something is, 4 there was nothing to check")]
pub(crate) struct Check {
    /// Scenario, plate, plan and configuration files, or folders with everything below them
    #[arg(value_name = "FILE|FOLDER", default_value = "scenarios")]
    scenarios: Vec<PathBuf>,
}

/// What a file is, by its name and its keys.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Scenario,
    Plate,
    Plan,
    Config,
}

impl Kind {
    const ALL: [Self; 4] = [Self::Scenario, Self::Plate, Self::Plan, Self::Config];

    fn of(path: &Path) -> Self {
        if path.file_name().is_some_and(|name| name == config::FILE) {
            return Self::Config;
        }
        let text = input::read(path).map(|content| String::from_utf8_lossy(&content).into_owned()).unwrap_or_default();
        let (document, _) = DeTable::parse_recoverable(&text);
        let has = |key: &str| document.get_ref().contains_key(key);
        let is_played = has("profile") || has("expect") || has("controller");
        if is_played {
            Self::Scenario
        } else if has("requirement") || has("ask") || has("bench") {
            Self::Plan
        } else if has("mode") || has("drive") || has("sensor") {
            Self::Plate
        } else {
            Self::Scenario
        }
    }

    /// Everything that is wrong with a file of this kind.
    fn faults(self, path: &Path, name: &str) -> Vec<Diagnostic> {
        match self {
            Self::Scenario => match examine(path, name) {
                Ok(scenario) => law(&scenario).err().into_iter().collect(),
                Err(faults) => faults,
            },
            Self::Plate => load::plate(path).err().unwrap_or_default(),
            Self::Plan => Plan::load(path).err().unwrap_or_default(),
            Self::Config => Config::read(path).err().unwrap_or_default(),
        }
    }

    const fn words(self) -> [&'static str; 2] {
        match self {
            Self::Scenario => ["scenario", "scenarios"],
            Self::Plate => ["plate", "plates"],
            Self::Plan => ["plan", "plans"],
            Self::Config => ["configuration", "configurations"],
        }
    }
}

/// Checks files and says all that is wrong with them.
pub(crate) fn check(arguments: &Check) -> Exit {
    let (files, mut faults) = every_file(&arguments.scenarios);
    let kinds: Vec<_> = files.iter().map(|(path, _)| Kind::of(path)).collect();
    for ((path, name), kind) in files.iter().zip(&kinds) {
        for fault in kind.faults(path, name) {
            // Two scenarios may share a broken plate.
            if !faults.contains(&fault) {
                faults.push(fault);
            }
        }
    }
    // What only shows between files.
    let mut names = BTreeMap::new();
    for ((path, name), _) in files.iter().zip(&kinds).filter(|(_, kind)| **kind == Kind::Scenario) {
        if let Some(other) = names.insert(name, path) {
            let message = format!("would be filed as {name}, as would {}", other.display());
            faults.push(Diagnostic::of_file(path, message));
        }
    }
    faults.iter().for_each(output::diagnostic);
    if !faults.is_empty() {
        let (faults, files) = (faults.len(), files.len());
        output::note(&format!(
            "{faults} {} in {files} {}",
            if faults == 1 { "fault" } else { "faults" },
            if files == 1 { "file" } else { "files" }
        ));
        return Exit::Invalid;
    }
    if files.is_empty() {
        output::error("there is nothing to check");
        return Exit::Nothing;
    }
    let counted = Kind::ALL.into_iter().filter_map(|kind| {
        let count = kinds.iter().filter(|found| **found == kind).count();
        let [one, many] = kind.words();
        (count > 0).then(|| format!("{count} {}", if count == 1 { one } else { many }))
    });
    output::show(&format!("nothing wrong with {}\n", counted.collect::<Vec<_>>().join(", ")));
    Exit::Passed
}
