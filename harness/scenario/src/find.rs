//! Which scenario files a command line means.

use crate::diagnostic::Diagnostic;
use crate::load::examine;
use crate::scenario::Scenario;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Folders that are only looked into where they are named themselves: they hold other things than scenarios, or scenarios that are played to record a plate
/// and not to judge a controller.
const OTHER_FOLDERS: [&str; 4] = ["plates", "baselines", "plans", "identify"];
/// Folders without anything that people write.
const WRITTEN_BY_THE_BENCH: [&str; 1] = ["baselines"];
/// A folder with this file is a run's; the scenarios in it are copies.
const RUN_RECORD: &str = "run.json";
/// A run's folder of copies.
const RUN_INPUTS: &str = "inputs";
/// Scenarios are called by their path below a folder of this name.
const ROOT: &str = "scenarios";

/// What was found.
#[derive(Debug)]
pub struct Found {
    /// The scenarios, by name.
    pub scenarios: Vec<Scenario>,
    /// Scenarios that show a limit and were left out because neither they nor their own folder were named.
    pub left_out: Vec<String>,
    /// Folders that were named and hold no scenario file: whoever named them meant something else.
    pub empty: Vec<PathBuf>,
}

/// Loads every scenario that `arguments` name: files as they are, folders with everything below them.
///
/// A scenario with `expected_exit` is meant to end otherwise than in a pass; it is only taken where it or its own folder is named.
///
/// # Errors
/// Every [`Diagnostic`] of every file, so that all can be mended at once.
pub fn find(arguments: &[PathBuf]) -> Result<Found, Vec<Diagnostic>> {
    let mut faults = Vec::new();
    // By canonical path: a file that is named twice is played once.
    let mut files: BTreeMap<PathBuf, (PathBuf, String, bool)> = BTreeMap::new();
    let mut empty = Vec::new();
    for argument in arguments {
        let below = files_below(argument, &OTHER_FOLDERS, &mut BTreeSet::new(), &mut faults);
        if below.is_empty() {
            empty.push(argument.clone());
        }
        for path in below {
            let own = path == *argument || path.parent() == Some(argument.as_path());
            let canonical = fs::canonicalize(&path).unwrap_or_else(|_| path.clone());
            let name = name_of(&canonical, argument);
            let entry = files.entry(canonical).or_insert((path, name, own));
            entry.2 |= own;
        }
    }
    let mut found = Found { scenarios: Vec::new(), left_out: Vec::new(), empty };
    for (path, name, own) in files.into_values() {
        match examine(&path, &name) {
            Ok(scenario) if scenario.expected_exit.is_some() && !own => found.left_out.push(name),
            Ok(scenario) => found.scenarios.push(scenario),
            Err(found) => faults.extend(found),
        }
    }
    found.scenarios.sort_by(|a, b| a.file.cmp(&b.file));
    for pair in found.scenarios.windows(2) {
        if let [first, second] = pair
            && first.name() == second.name()
        {
            let other = first.inputs.first().map_or(Path::new(""), |input| &input.path).display();
            let message = format!("two scenarios would be filed as {}, the other one is {other}", first.file);
            faults.push(second.diagnose("title", message));
        }
    }
    if faults.is_empty() { Ok(found) } else { Err(faults) }
}

/// Every TOML file that `arguments` name or that stands below a folder that they name, scenario or not, with the name that it has in records; baselines and
/// what lies in run folders are left out. And the folders that cannot be read.
pub fn every_file(arguments: &[PathBuf]) -> (Vec<(PathBuf, String)>, Vec<Diagnostic>) {
    let mut faults = Vec::new();
    let mut files = BTreeMap::new();
    for argument in arguments {
        for path in files_below(argument, &WRITTEN_BY_THE_BENCH, &mut BTreeSet::new(), &mut faults) {
            let canonical = fs::canonicalize(&path).unwrap_or_else(|_| path.clone());
            let name = name_of(&canonical, argument);
            files.entry(canonical).or_insert((path, name));
        }
    }
    (files.into_values().collect(), faults)
}

/// `others` are the folders that are not looked into, `visited` are the folders already looked into: a link may lead back to one.
fn files_below(
    argument: &Path,
    others: &[&str],
    visited: &mut BTreeSet<PathBuf>,
    faults: &mut Vec<Diagnostic>,
) -> Vec<PathBuf> {
    if !argument.is_dir() {
        return vec![argument.to_owned()];
    }
    if fs::canonicalize(argument).is_ok_and(|folder| !visited.insert(folder)) {
        return Vec::new();
    }
    let entries = match fs::read_dir(argument).and_then(Iterator::collect::<Result<Vec<_>, _>>) {
        Ok(entries) => entries,
        Err(error) => {
            faults.push(Diagnostic::of_file(argument, format!("cannot be read: {error}")));
            return Vec::new();
        }
    };
    let mut files = Vec::new();
    // Who writes a run among scenarios does not mean its copies of them.
    let is_run = argument.join(RUN_RECORD).exists();
    for path in entries.into_iter().map(|entry| entry.path()) {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if path.is_dir() {
            let is_other = others.contains(&&*name) || path.join(RUN_RECORD).exists() || is_run && name == RUN_INPUTS;
            if !is_other && !name.starts_with('.') {
                files.extend(files_below(&path, others, visited, faults));
            }
        } else if name.starts_with('.') {
            // Hidden, as editors leave them.
        } else if path.is_symlink() && !path.exists() {
            faults.push(Diagnostic::of_file(&path, "a link that leads nowhere: nobody knows what is not played"));
        } else if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("toml")) {
            files.push(path);
        }
    }
    files
}

/// What a scenario is called in records: its path below the nearest folder called `scenarios`, else below the folder that was
/// named, else its file name.
fn name_of(path: &Path, argument: &Path) -> String {
    let components: Vec<_> = path.components().map(|component| component.as_os_str().to_string_lossy()).collect();
    let folders = components.len().saturating_sub(1);
    if let Some(root) = components.iter().take(folders).rposition(|component| component == ROOT) {
        return components.get(root + 1..).unwrap_or_default().join("/");
    }
    let below = fs::canonicalize(argument).ok().filter(|folder| folder.is_dir());
    let relative = below.and_then(|folder| path.strip_prefix(folder).ok().map(Path::to_path_buf));
    match relative {
        Some(relative) => {
            relative.components().map(|part| part.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/")
        }
        None => components.last().map(ToString::to_string).unwrap_or_default(),
    }
}

#[cfg(test)]
mod tests;
