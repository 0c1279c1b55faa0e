//! Searches for scenario files, and recognises the kind of a TOML file by its top-level keys.

use crate::input;
use crate::scenario::definition::Scenario;
use crate::scenario::diagnostic::{CLOSE, Diagnostic, closeness};
use crate::scenario::load::{NOT_UTF8, REQUIREMENTS_FILE, load_with_all_errors};
use crate::scenario::matrix::{case_files, find_case, name_of_case};
use crate::scenario::parse::parse_syntax;
use crate::scenario::parse::read_text;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};
use std::{env, fs, iter};

/// A folder with `run.json` and `traces` is a run folder. The scenarios in its `inputs` are copies.
const RUN_RECORD: &str = "run.json";
const RUN_TRACES: &str = "traces";
const RUN_INPUTS: &str = "inputs";
const SCENARIOS_FOLDER: &str = "scenarios";

#[derive(Debug)]
pub struct FoundScenarios {
    pub scenarios: Vec<Scenario>,
    /// Scenarios with `only_if_named` that were not named.
    pub skipped: Vec<Scenario>,
    pub empty_folders: Vec<PathBuf>,
    /// Folders `inputs` of run folders. They are not searched, because they contain copies.
    pub copies: Vec<PathBuf>,
}

/// Nearest folder `scenarios` in a folder or above it.
struct ScenariosRoot {
    /// Path of the folder that contains it, relative to the folder of the search: empty, or `../…`.
    parent: PathBuf,
    path: PathBuf,
}

impl ScenariosRoot {
    fn find_above(folder: &Path) -> Option<Self> {
        let level = folder.ancestors().position(|ancestor| ancestor.join(SCENARIOS_FOLDER).is_dir())?;
        let parent = iter::repeat_n("..", level).collect();
        Some(Self { parent, path: folder.ancestors().nth(level)?.join(SCENARIOS_FOLDER) })
    }

    /// Returns the path of a scenario or folder `name`, relative to the folder of the search.
    fn resolve(&self, name: &Path) -> Option<PathBuf> {
        let below = name.strip_prefix(SCENARIOS_FOLDER).unwrap_or(name);
        let mut with_extension = below.as_os_str().to_owned();
        with_extension.push(".toml");
        let candidates = [below, Path::new(&with_extension)];
        let exists = |path: &Path| path.exists() || find_case(path).is_some();
        let found = candidates.into_iter().find(|below| exists(&self.path.join(below)))?;
        Some(self.parent.join(SCENARIOS_FOLDER).join(found).components().collect())
    }

    /// Returns `; did you mean …?` with the most similar name of a file, otherwise an empty text.
    fn suggestion(&self, name: &Path) -> String {
        let name = name.strip_prefix(SCENARIOS_FOLDER).unwrap_or(name).to_string_lossy();
        let known = Search::default().files_below(&self.path);
        let name_of = |path: &PathBuf| Some(path.strip_prefix(&self.path).ok()?.to_string_lossy().into_owned());
        let known = known.iter().filter_map(|path| Some(case_files(path, name_of(path)?))).flatten();
        let rated = known.map(|known| (name_closeness(&name, &known), known));
        match rated.filter(|(closeness, _)| *closeness >= CLOSE).max_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((_, known)) => format!("; did you mean `{known}`?"),
            None => String::new(),
        }
    }
}

/// Also compares the file names, because a name without its folder is a frequent mistake.
fn name_closeness(name: &str, known: &str) -> f64 {
    let file = |path: &str| {
        let file = path.rsplit('/').next().unwrap_or_default();
        file.strip_suffix(".toml").unwrap_or(file).to_owned()
    };
    closeness(name, known).max(closeness(&file(name), &file(known)))
}

/// Returns the path of `argument`. If it does not exist in `folder`, the working directory, this is
/// the path of the scenario or folder with this name below the nearest folder `scenarios`.
fn resolve_argument(argument: &Path, folder: &Path) -> Result<PathBuf, Diagnostic> {
    let is_stream = argument == Path::new(input::STANDARD_STREAM);
    let Err(error) = folder.join(argument).symlink_metadata() else { return Ok(argument.to_owned()) };
    if is_stream || find_case(&folder.join(argument)).is_some() {
        return Ok(argument.to_owned());
    }
    let root = if argument.is_absolute() { None } else { ScenariosRoot::find_above(folder) };
    if let Some(path) = root.as_ref().and_then(|root| root.resolve(argument)) {
        return Ok(path);
    }
    let hint = root.map_or_else(String::new, |root| root.suggestion(argument));
    Err(Diagnostic::for_file(argument, format!("cannot be read: {error}{hint}")))
}

#[derive(Default)]
struct Search {
    /// Canonical paths of visited folders, because a symbolic link may lead back to a folder.
    visited: BTreeSet<PathBuf>,
    copies: BTreeSet<PathBuf>,
    empty_folders: Vec<PathBuf>,
    problems: Vec<Diagnostic>,
}

struct FoundFile {
    path: PathBuf,
    /// Name in records. It distinguishes the cases of a file.
    name: String,
    /// True if the file, or the folder that contains it, is an argument.
    is_named: bool,
}

/// Loads the scenarios that are arguments or are below folders in `arguments`. An argument may also
/// be the name of a scenario or folder below the nearest folder `scenarios`. Skips a scenario
/// with `only_if_named` unless it or its own folder is an argument. Fails with all faulty scenarios
/// and with all TOML files that do not parse or are of no known kind.
pub fn find(arguments: &[PathBuf]) -> Result<FoundScenarios, Vec<Diagnostic>> {
    let mut search = Search::default();
    let files = search.files(arguments, |path| Ok(FileKind::detect(path)? == FileKind::Scenario));
    let Search { copies, empty_folders, mut problems, .. } = search;
    let copies = copies.into_iter().collect();
    let mut found = FoundScenarios { scenarios: Vec::new(), skipped: Vec::new(), empty_folders, copies };
    for FoundFile { path, name, is_named } in files {
        match load_with_all_errors(&path, &name) {
            Ok(scenario) if scenario.only_if_named.is_some() && !is_named => found.skipped.push(scenario),
            Ok(scenario) => found.scenarios.push(scenario),
            // Cases of one file may have the same error.
            Err(found) => found.into_iter().for_each(|problem| {
                if !problems.contains(&problem) {
                    problems.push(problem);
                }
            }),
        }
    }
    found.scenarios.sort_by(|a, b| a.file.cmp(&b.file));
    let path = |scenario: &Scenario| scenario.inputs.first().map(|input| input.path.clone()).unwrap_or_default();
    let named: Vec<_> = found.scenarios.iter().map(|scenario| (path(scenario), scenario.file.clone())).collect();
    problems.extend(repeated_names(&named));
    if problems.is_empty() { Ok(found) } else { Err(problems) }
}

/// Returns an error for each scenario that has the name in records of an earlier one. `files` are
/// paths and names.
pub fn repeated_names<'a>(files: impl IntoIterator<Item = &'a (PathBuf, String)>) -> Vec<Diagnostic> {
    let mut names = BTreeMap::new();
    let problem = |(path, name): &'a (PathBuf, String)| {
        let other = names.insert(name.strip_suffix(".toml").unwrap_or(name), path)?;
        let message = format!("has the name {name} in records, like {}; rename one of them", other.display());
        Some(Diagnostic::for_file(path, message))
    };
    files.into_iter().filter_map(problem).collect()
}

/// Returns each named file, and each TOML file below a named folder, with its name in records. A
/// file with a `[matrix]` occurs once per case. Also
/// returns the errors of unreadable folders. Skips the inputs of run folders.
pub fn list_files(arguments: &[PathBuf]) -> (Vec<(PathBuf, String)>, Vec<Diagnostic>) {
    let mut search = Search::default();
    let files = search.files(arguments, |_| Ok(true));
    (files.into_iter().map(|file| (file.path, file.name)).collect(), search.problems)
}

fn canonical(path: &Path) -> PathBuf {
    let is_file = path != Path::new(input::STANDARD_STREAM);
    is_file.then(|| fs::canonicalize(path).ok()).flatten().unwrap_or_else(|| path.to_owned())
}

impl Search {
    fn files(
        &mut self,
        arguments: &[PathBuf],
        is_wanted: impl Fn(&Path) -> Result<bool, Vec<Diagnostic>>,
    ) -> Vec<FoundFile> {
        let mut files: BTreeMap<(PathBuf, String), FoundFile> = BTreeMap::new();
        let folder = env::current_dir().unwrap_or_default();
        for argument in arguments {
            let argument = match resolve_argument(argument, &folder) {
                Ok(path) => path,
                Err(problem) => {
                    self.problems.push(problem);
                    continue;
                }
            };
            self.visited.clear();
            let mut below = self.files_below(&argument);
            below.retain(|path| {
                *path == argument
                    || is_wanted(path).unwrap_or_else(|problems| {
                        for problem in problems {
                            if !self.problems.contains(&problem) {
                                self.problems.push(problem);
                            }
                        }
                        false
                    })
            });
            if below.is_empty() {
                self.empty_folders.push(argument.clone());
            }
            for path in below {
                let is_named = path == argument || path.parent() == Some(argument.as_path());
                let case = find_case(&path);
                let path = case.as_ref().map_or(path, |(file, _)| file.clone());
                let canonical = canonical(&path);
                let Some(name) = record_name(&canonical, &argument) else {
                    self.problems.push(Diagnostic::for_file(&path, NOT_UTF8));
                    continue;
                };
                let names = match case {
                    Some((_, case)) => vec![name_of_case(&name, &case)],
                    None => case_files(&path, name),
                };
                for name in names {
                    let found = FoundFile { path: path.clone(), name: name.clone(), is_named: false };
                    files.entry((canonical.clone(), name)).or_insert(found).is_named |= is_named;
                }
            }
        }
        files.into_values().collect()
    }

    fn files_below(&mut self, argument: &Path) -> Vec<PathBuf> {
        if argument == Path::new(input::STANDARD_STREAM) || !argument.is_dir() {
            return vec![argument.to_owned()];
        }
        if fs::canonicalize(argument).is_ok_and(|folder| !self.visited.insert(folder)) {
            return Vec::new();
        }
        let entries = match fs::read_dir(argument).and_then(Iterator::collect::<Result<Vec<_>, _>>) {
            Ok(entries) => entries,
            Err(error) => {
                self.problems.push(Diagnostic::for_file(argument, format!("cannot be read: {error}")));
                return Vec::new();
            }
        };
        let mut files = Vec::new();
        let is_run = is_run_folder(argument);
        for path in entries.into_iter().map(|entry| entry.path()) {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if path.is_dir() {
                if is_run && name == RUN_INPUTS {
                    self.copies.insert(path);
                } else if !name.starts_with('.') {
                    files.extend(self.files_below(&path));
                }
            } else if name.starts_with('.') {
            } else if path.is_symlink() && !path.exists() {
                let message = "a broken symbolic link, expected a file";
                self.problems.push(Diagnostic::for_file(&path, message));
            } else if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("toml")) {
                files.push(path);
            }
        }
        files
    }
}

/// Parses `run.json`, because another file of this name must not hide scenarios.
fn is_run_folder(folder: &Path) -> bool {
    let parses = |text: Vec<u8>| {
        serde_json::from_slice::<serde_json::Value>(&text).is_ok_and(|record| record.get("scenarios").is_some())
    };
    folder.join(RUN_TRACES).is_dir() && input::read(&folder.join(RUN_RECORD)).is_ok_and(parses)
}

/// Returns the path below the nearest folder `scenarios`. Without one, returns the path below a
/// named folder, or the file name. `None` if this is not UTF-8.
fn record_name(path: &Path, argument: &Path) -> Option<String> {
    if argument == Path::new(input::STANDARD_STREAM) {
        return Some(input::STANDARD_INPUT_NAME.to_owned());
    }
    let components: Vec<_> = path.components().map(Component::as_os_str).collect();
    let folders = components.len().saturating_sub(1);
    let root = components.iter().take(folders).rposition(|component| *component == SCENARIOS_FOLDER);
    let below = || fs::canonicalize(argument).ok().filter(|folder| folder.is_dir() && path.starts_with(folder));
    let start = root.map(|root| root + 1).or_else(|| Some(below()?.components().count())).unwrap_or(folders);
    let parts: Option<Vec<_>> = components.get(start..).unwrap_or_default().iter().map(|part| part.to_str()).collect();
    Some(parts?.join("/"))
}

pub const SETTINGS_FILE: &str = "platebench.toml";

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, strum::IntoStaticStr)]
#[strum(const_into_str, serialize_all = "lowercase")]
pub enum FileKind {
    Scenario,
    Plate,
    Plan,
    Envelope,
    Campaign,
    #[strum(serialize = "settings file")]
    Config,
    #[strum(serialize = "board inventory")]
    Boards,
    #[strum(serialize = "list of requirements")]
    Requirements,
    Baseline,
    #[strum(serialize = "uncertainty budget")]
    Budget,
}

/// No other file has these keys, also not `platebench.toml`.
const SCENARIO_KEYS: [&str; 11] = [
    "profile",
    "expect",
    "controller",
    "duration_ms",
    "fault",
    "between",
    "other_trials",
    "trace_step_ms",
    "expected_exit",
    "only_if_named",
    "timeout_s",
];

/// The first entry with a top-level key of the file determines the kind of the file.
const KEYS: [(FileKind, &[&str]); 9] = [
    (FileKind::Plan, &["ask", "bench", "repetitions", "decision"]),
    (FileKind::Boards, &["board"]),
    (FileKind::Envelope, &["range", "count"]),
    (FileKind::Baseline, &["curves_sha256", "features", "tolerance"]),
    (FileKind::Campaign, &["vary", "scenario", "plan", "judge"]),
    (FileKind::Budget, &["instrument", "budget", "coverage_percent"]),
    (FileKind::Plate, &["mode", "drive", "sensor", "finger", "second_mode", "heating"]),
    (FileKind::Config, &["rig", "jobs", "format", "baselines", "scenarios", "runs", "out", "run"]),
    (FileKind::Scenario, &["plate", "trials"]),
];

impl FileKind {
    /// Fails if the file cannot be read, is not TOML, or has no key of a known kind.
    pub fn detect(path: &Path) -> Result<Self, Vec<Diagnostic>> {
        let text = read_text(path).map_err(|problem| vec![problem])?;
        let document = parse_syntax(path, &text)?;
        let document = document.get_ref();
        let has = |key: &&str| document.contains_key(*key);
        if SCENARIO_KEYS.iter().any(has) {
            return Ok(Self::Scenario);
        }
        if path.file_name().is_some_and(|name| name == SETTINGS_FILE) {
            return Ok(Self::Config);
        }
        let requirements = document.contains_key("requirement");
        if path.file_name().is_some_and(|name| name == REQUIREMENTS_FILE) || (requirements && document.len() == 1) {
            return Ok(Self::Requirements);
        }
        if requirements {
            return Ok(Self::Plan);
        }
        let kind = KEYS.iter().find(|(_, keys)| keys.iter().any(has));
        kind.map(|(kind, _)| *kind).ok_or_else(|| {
            let message = "is a file of no known kind, expected a top-level key of a scenario (`profile`), a plate \
                           (`mode`), a plan (`requirement`), an envelope (`range`), a campaign (`vary`), a board \
                           inventory (`board`), a baseline (`tolerance`), a budget (`budget`) or settings (`run`)";
            vec![Diagnostic::for_file(path, message)]
        })
    }

    pub const fn name(self) -> &'static str {
        self.into_str()
    }
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod file_kind_tests {
    use super::*;

    fn detect(name: &str, text: &str) -> Result<FileKind, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        FileKind::detect(&path).map_err(|problems| problems[0].to_string().replace(&path.display().to_string(), name))
    }

    #[test]
    fn the_keys_of_a_file_decide_its_kind() {
        for (text, kind) in [
            ("duration_ms = 1", FileKind::Scenario),
            ("[profile]", FileKind::Scenario),
            ("plate = \"a.toml\"", FileKind::Scenario),
            ("scenario = \"a.toml\"", FileKind::Campaign),
            ("[vary]", FileKind::Campaign),
            ("[plan]", FileKind::Campaign),
            ("plate = \"a.toml\"\n[range]", FileKind::Envelope),
            ("[bench]", FileKind::Plan),
            ("title = \"a\"\n[[requirement]]\n[[scenario]]", FileKind::Plan),
            ("[[requirement]]", FileKind::Requirements),
            ("[[board]]", FileKind::Boards),
            ("[mode]", FileKind::Plate),
            ("scenario = \"a.toml\"\ncurves_sha256 = \"\"", FileKind::Baseline),
            ("[[budget]]", FileKind::Budget),
            ("[run]", FileKind::Config),
        ] {
            assert_eq!(detect("file.toml", text), Ok(kind), "{text}");
        }
    }

    #[test]
    fn a_file_name_does_not_hide_a_scenario() {
        assert_eq!(detect(SETTINGS_FILE, "[profile]"), Ok(FileKind::Scenario));
        assert_eq!(detect(REQUIREMENTS_FILE, "[profile]"), Ok(FileKind::Scenario));
        assert_eq!(detect(SETTINGS_FILE, ""), Ok(FileKind::Config));
        assert_eq!(detect(REQUIREMENTS_FILE, ""), Ok(FileKind::Requirements));
    }

    #[test]
    fn rejects_a_file_of_no_known_kind() {
        let error = detect("Cargo.toml", "[package]").unwrap_err();
        assert!(error.starts_with("Cargo.toml: is a file of no known kind, expected "), "{error}");
        let error = detect("a.toml", "[mode]\n[profile\n").unwrap_err();
        assert!(error.starts_with("a.toml:2:9: "), "{error}");
    }
}
