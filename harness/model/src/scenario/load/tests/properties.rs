//! Changes the shipped scenarios at random places. Each result is a scenario or problems with positions.

use crate::scenario::definition::Scenario;
use crate::scenario::find::{FileKind, find, list_files};
use crate::scenario::load::load;
use crate::scenario::parse::parse;
use crate::scenario::raw::RawScenario;
use proptest::prelude::*;
use proptest::test_runner::{Config, RngAlgorithm, TestRng, TestRunner};
use std::fs;
use std::path::{Path, PathBuf};

const CASES: u32 = 800;

/// Values of other types and sizes.
const VALUES: [&str; 22] = [
    "0",
    "0.0",
    "-1",
    "-0.0",
    "1",
    "1e-300",
    "1e300",
    "1e15",
    "nan",
    "inf",
    "-inf",
    "true",
    "\"\"",
    "\"x\"",
    "[]",
    "[0.0]",
    "[[0.0, 1.0]]",
    "{}",
    "{ hold = [] }",
    "9223372036854775807",
    "1979-05-27",
    "\"../plates\"",
];

#[derive(Debug, Clone)]
enum TextChange {
    RemovedLine,
    DoubledLine,
    SwappedLines,
    Value(&'static str),
    /// Share of the line after which its rest is missing.
    Cut(f64),
    /// Share of the line at which a character is replaced.
    Character(f64, char),
    /// The line is replaced by one of another file.
    Foreign(String),
}

fn change(lines: Vec<String>) -> impl Strategy<Value = TextChange> {
    prop_oneof![
        Just(TextChange::RemovedLine),
        Just(TextChange::DoubledLine),
        Just(TextChange::SwappedLines),
        proptest::sample::select(&VALUES[..]).prop_map(TextChange::Value),
        (0.0..1.0).prop_map(TextChange::Cut),
        (0.0..1.0, proptest::sample::select(&['"', '[', '}', '=', '.', '-', 'µ', ' ', '#', 'e'][..]))
            .prop_map(|(share, character)| TextChange::Character(share, character)),
        proptest::sample::select(lines).prop_map(TextChange::Foreign),
    ]
}

fn place(line: &str, share: f64) -> usize {
    line.floor_char_boundary((share * line.len() as f64) as usize)
}

fn changed(text: &str, at: f64, change: &TextChange) -> String {
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    let number = (at * lines.len() as f64) as usize;
    let line = lines[number].clone();
    match change {
        TextChange::RemovedLine => drop(lines.remove(number)),
        TextChange::DoubledLine => lines.insert(number, line),
        TextChange::SwappedLines => lines.swap(number, text.lines().count() / 2),
        TextChange::Value(value) => {
            lines[number] = line.split_once('=').map_or(line.clone(), |(key, _)| format!("{key}= {value}"));
        }
        TextChange::Cut(share) => lines[number].truncate(place(&line, *share)),
        TextChange::Character(share, character) => {
            let (before, rest) = line.split_at(place(&line, *share));
            let rest = rest.chars().skip(1);
            lines[number] = before.chars().chain([*character]).chain(rest).collect();
        }
        TextChange::Foreign(other) => lines[number].clone_from(other),
    }
    lines.join("\n") + "\n"
}

/// Copies the shipped scenarios, their plates and their tables.
fn copy_of_scenarios(to: &Path) {
    let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios");
    let mut folders = vec![PathBuf::new()];
    while let Some(folder) = folders.pop() {
        fs::create_dir_all(to.join(&folder)).unwrap();
        for entry in fs::read_dir(from.join(&folder)).unwrap() {
            let name = folder.join(entry.unwrap().file_name());
            if from.join(&name).is_dir() {
                folders.push(name);
            } else {
                fs::copy(from.join(&name), to.join(&name)).unwrap();
            }
        }
    }
}

fn scenarios_below(folder: &Path) -> Vec<PathBuf> {
    copy_of_scenarios(folder);
    let (files, problems) = list_files(&[folder.to_owned()]);
    assert!(problems.is_empty(), "{problems:?}");
    let is_scenario = |path: &PathBuf| matches!(FileKind::detect(path), Ok(FileKind::Scenario));
    files.into_iter().map(|(path, _)| path).filter(is_scenario).collect()
}

/// Exploration and campaigns write scenarios that `run` reads.
#[test]
fn a_written_scenario_is_the_one_that_was_read() {
    let folder = tempfile::tempdir().unwrap();
    let mut compared = 0;
    for path in scenarios_below(folder.path()) {
        let text = fs::read_to_string(&path).unwrap();
        if text.contains("[matrix]") || text.contains("[matrix.") {
            continue;
        }
        let raw: RawScenario = parse(&path, &text).unwrap();
        let written = path.with_file_name("written.toml");
        fs::write(&written, toml::to_string(&raw).unwrap()).unwrap();
        let [read, again] = [&path, &written].map(|path| {
            let scenario = load(path, "name.toml").unwrap_or_else(|problem| panic!("{problem}"));
            format!("{:?}", Scenario { inputs: Vec::new(), ..scenario })
        });
        fs::remove_file(&written).unwrap();
        assert_eq!(read, again, "{}", path.display());
        compared += 1;
    }
    assert!(compared > 50, "{compared}");
}

#[test]
fn a_changed_file_is_a_scenario_or_has_problems_with_positions() {
    let folder = tempfile::tempdir().unwrap();
    let scenarios = scenarios_below(folder.path());
    let read = |path: &PathBuf| fs::read_to_string(path).unwrap();
    let lines: Vec<String> =
        scenarios.iter().flat_map(|path| read(path).lines().map(str::to_owned).collect::<Vec<_>>()).collect();
    let config = Config { cases: CASES, failure_persistence: None, ..Config::default() };
    let mut runner = TestRunner::new_with_rng(config, TestRng::deterministic_rng(RngAlgorithm::ChaCha));
    let strategy = (0..scenarios.len(), proptest::bool::weighted(0.2), 0.0..1.0, change(lines));
    let outcome = runner.run(&strategy, |(number, changes_plate, at, change)| {
        let path = &scenarios[number];
        let text = read(path);
        let plate = folder.path().join("plates/aluminium-198x138.toml");
        let (target, before) = if changes_plate { (&plate, read(&plate)) } else { (path, text) };
        let after = changed(&before, at, &change);
        fs::write(target, &after).unwrap();
        let loaded = find(std::slice::from_ref(path));
        fs::write(target, &before).unwrap();
        let Err(problems) = loaded else { return Ok(()) };
        prop_assert!(!problems.is_empty());
        for problem in problems {
            prop_assert!(!problem.message.is_empty() && !problem.render(false).is_empty());
            if problem.message.starts_with("only the first ") {
                continue;
            }
            let Some((line, column)) = problem.location() else {
                return Err(TestCaseError::fail(format!("no position: {problem}\n{after}")));
            };
            let source = if problem.path.canonicalize().unwrap() == target.canonicalize().unwrap() {
                after.clone()
            } else {
                read(&problem.path)
            };
            let found = source.lines().chain([""]).nth(line - 1).unwrap_or_default();
            prop_assert!(column <= found.chars().count() + 1, "{line}:{column}: {problem}");
        }
        Ok(())
    });
    outcome.unwrap_or_else(|error| panic!("{error}"));
}
