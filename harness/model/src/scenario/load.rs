//! Reads and checks scenario files, converts them to [`Scenario`] and points at every wrong value.
//! Loads scenarios with changed values, and the texts of their requirements.

mod checker;
mod csv_profile;
mod expectation;
mod fault;
mod profile;
mod scenario;

use crate::scenario::definition::{InputFile, Scenario};
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::file_checker::FileChecker;
use crate::scenario::matrix::{Source, SourceFile};
use crate::scenario::parse::{parse_source, range_errors, read_text, with_truncation_note};
use crate::scenario::raw::RawScenario;
use crate::scenario::schema::{PLATE_SCHEMA, SCENARIO_SCHEMA};
pub(crate) use checker::Checker;
use checker::{KnownPlate, check_plate};
pub use checker::{implausible_values, load_plate, parse_plate, require_no_effects};
use platebench_plate::RawPlate;
use schemars::{JsonSchema, Schema};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use toml::de::Deserializer;
use toml::{Table, Value};

/// `file` is the name of the scenario in records. Returns only the first error.
pub fn load(path: &Path, file: &str) -> Result<Scenario, Diagnostic> {
    load_with_all_errors(path, file).map_err(|problems| first_diagnostic(path, problems))
}

/// Like [`load()`], but returns all independent errors, one per `[[fault]]` and `[[expect]]`.
pub fn load_with_all_errors(path: &Path, file: &str) -> Result<Scenario, Vec<Diagnostic>> {
    load_from(path, file, &[])
}

/// Loads a scenario whose values can be replaced. `edit` first changes the scenario's table.
pub fn load_template(
    path: &Path,
    file: &str,
    edit: impl FnOnce(&mut toml::Table),
) -> Result<ScenarioTemplate, Vec<Diagnostic>> {
    ScenarioTemplate::new(path, load_with_all_errors(path, file)?, edit)
}

/// Loads a scenario from copies of its inputs, in the order of [`Scenario::inputs`].
pub fn load_copies(copies: &[PathBuf], file: &str) -> Result<Scenario, Diagnostic> {
    let [path, named @ ..] = copies else {
        return Err(Diagnostic::for_file(Path::new(file), "the run folder contains no copy of this scenario"));
    };
    load_from(path, file, named).map_err(|problems| first_diagnostic(path, problems))
}

/// Checks a scenario that no file contains. `plates` are its plates by their path in `raw`. CSV
/// profiles are relative to the working directory.
pub fn check_raw(raw: RawScenario, file: &str, plates: &BTreeMap<PathBuf, RawPlate>) -> Result<Scenario, Diagnostic> {
    let path = Path::new(file);
    let checked = || {
        check_ranges(&SCENARIO_SCHEMA, &raw, path)?;
        let known = |(path, raw): (&PathBuf, &RawPlate)| {
            check_ranges(&PLATE_SCHEMA, raw, path)?;
            let plate = check_plate(path, "", raw.clone())?;
            Ok(KnownPlate { path: path.clone(), plate, text: String::new() })
        };
        let plates = plates.iter().map(known).collect::<Result<Vec<_>, Vec<Diagnostic>>>()?;
        Checker { source: Source::file(path, ""), prefix: String::new(), plates: &plates }.check(raw, file)
    };
    checked().map_err(|problems| first_diagnostic(path, problems))
}

fn check_ranges(schema: &Schema, raw: &impl Serialize, path: &Path) -> Result<(), Vec<Diagnostic>> {
    let table = Table::try_from(raw).map_err(|error| vec![Diagnostic::for_file(path, error.to_string())])?;
    let problems = range_errors(schema, &table, None, &Source::file(path, ""));
    if problems.is_empty() { Ok(()) } else { Err(problems) }
}

fn first_diagnostic(path: &Path, problems: Vec<Diagnostic>) -> Diagnostic {
    problems.into_iter().next().unwrap_or_else(|| Diagnostic::for_file(path, "rejected without a reason"))
}

fn load_from(path: &Path, file: &str, copies: &[PathBuf]) -> Result<Scenario, Vec<Diagnostic>> {
    if path.to_str().is_none() {
        return Err(vec![Diagnostic::for_file(path, NOT_UTF8)]);
    }
    let opened = SourceFile::read(path, file)?;
    let mut raw: RawScenario = parse_source(&opened.source())?;
    for (named, copy) in raw.files().zip(copies) {
        // A relative path would be resolved from the scenario's folder.
        *named = std::path::absolute(copy).unwrap_or_else(|_| copy.clone());
    }
    let checker = Checker { source: opened.source(), prefix: String::new(), plates: &[] };
    let mut scenario = checker.check(raw, file).map_err(|problems| with_truncation_note(&opened.path, problems))?;
    // The run record contains the texts. There is no `requirements.toml` above the copies.
    if copies.is_empty() {
        let used = scenario.expectations.iter().filter_map(|expectation| expectation.requirement.as_deref());
        scenario.requirement_texts = requirement_texts(path, used)?;
    }
    Ok(scenario)
}

/// The record of a run is JSON, so it could not name the file.
pub(crate) const NOT_UTF8: &str = "the name is not UTF-8, so a record cannot contain it; rename the file or its folder";

pub const PLATE_PREFIX: &str = "plate.";
/// Name of a changed plate in the scenario's folder. No file has this name.
const CHANGED_PLATE: &str = "changed-plate.toml";
const SEED: &str = "trials.seed";

#[derive(Debug, Clone)]
pub struct ScenarioTemplate {
    opened: SourceFile,
    file: String,
    table: Table,
    /// `table` after its check.
    raw: RawScenario,
    plate_name: String,
    plate: KnownPlate,
    plate_table: Table,
    pub scenario: Scenario,
}

/// Replaced values of a template.
#[derive(Debug, Clone, Default)]
pub struct ScenarioTables {
    /// `None` if nothing but the plate and the seed changes.
    scenario: Option<Table>,
    seed: Option<i64>,
    /// `None` if the plate is unchanged.
    pub plate: Option<Table>,
}

impl ScenarioTemplate {
    /// `scenario` must be loaded from `path`. `edit` changes the table of the scenario file first.
    pub(super) fn new(path: &Path, scenario: Scenario, edit: impl FnOnce(&mut Table)) -> Result<Self, Vec<Diagnostic>> {
        let read = |path: &Path| read_text(path).map_err(|problem| vec![problem]);
        let parse = |path: &Path, text: &str| {
            text.parse::<Table>().map_err(|error| vec![Diagnostic::from_toml(path, text, &error)])
        };
        let opened = SourceFile::read(path, &scenario.file)?;
        let document = opened.source().document()?;
        let mut table = Table::deserialize(Deserializer::from(document))
            .map_err(|error| vec![Diagnostic::from_toml(&opened.path, &opened.text, &error)])?;
        edit(&mut table);
        // Later checks skip the values of this table.
        let problems = range_errors(&SCENARIO_SCHEMA, &table, None, &opened.source());
        if !problems.is_empty() {
            return Err(problems);
        }
        let raw = RawScenario::deserialize(table.clone())
            .map_err(|error| vec![Diagnostic::from_toml(&opened.path, &opened.text, &error)])?;
        let plate_name = table.get("plate").and_then(Value::as_str).unwrap_or_default().to_owned();
        let plate_path = path.parent().unwrap_or_else(|| Path::new(".")).join(&plate_name);
        let plate_text = read(&plate_path)?;
        let plate_table = parse(&plate_path, &plate_text)?;
        let plate = load_plate(&plate_path)?;
        let plate = KnownPlate { path: plate_path, plate, text: plate_text };
        let file = scenario.file.clone();
        Ok(Self { opened, file, table, raw, plate_name, plate, plate_table, scenario })
    }

    /// Replaces the values at dotted keys. Fails if a key leads through a number, a text or a
    /// missing element of a list.
    pub fn tables<'a>(&self, changes: impl IntoIterator<Item = (&'a str, Value)>) -> Result<ScenarioTables, String> {
        let mut tables = ScenarioTables::default();
        for (key, value) in changes {
            match (key.strip_prefix(PLATE_PREFIX), &value) {
                (Some(key), _) => set(tables.plate.get_or_insert_with(|| self.plate_table.clone()), key, value)?,
                (None, Value::Integer(seed @ 0..)) if key == SEED => tables.seed = Some(*seed),
                (None, _) => set(tables.scenario.get_or_insert_with(|| self.table.clone()), key, value)?,
            }
        }
        Ok(tables)
    }

    /// The table of the scenario file with the replaced values.
    pub fn scenario_table(&self, tables: &ScenarioTables) -> Table {
        let mut scenario = tables.scenario.as_ref().unwrap_or(&self.table).clone();
        let table_of = |scenario: &mut Table, name: &str, change: &dyn Fn(&mut Table)| {
            // A value that is no table is an error of the check.
            if let Value::Table(table) = scenario.entry(name).or_insert_with(|| Value::Table(Table::new())) {
                change(table);
            }
        };
        if let Some(seed) = tables.seed {
            table_of(&mut scenario, "trials", &|trials| {
                trials.insert("seed".to_owned(), Value::Integer(seed));
            });
        }
        if tables.plate.is_some() {
            // Keeps the controller configured for the unchanged plate.
            table_of(&mut scenario, "controller", &|controller| {
                controller.entry("design_plate").or_insert_with(|| Value::String(self.plate_name.clone()));
            });
            scenario.insert("plate".to_owned(), Value::String(CHANGED_PLATE.to_owned()));
        }
        scenario
    }

    /// [`Self::scenario_table`] after its check.
    fn raw_scenario(&self, tables: &ScenarioTables) -> Result<RawScenario, Vec<Diagnostic>> {
        if tables.scenario.is_some() {
            return from_table(&self.scenario_table(tables), &self.table, &SCENARIO_SCHEMA, &self.opened.source());
        }
        let mut raw = self.raw.clone();
        raw.trials.seed = tables.seed.unwrap_or(raw.trials.seed);
        if tables.plate.is_some() {
            raw.controller.design_plate.get_or_insert_with(|| PathBuf::from(&self.plate_name));
            raw.plate = PathBuf::from(CHANGED_PLATE);
        }
        Ok(raw)
    }

    /// Checks the tables like [`super::load()`]. Diagnostics point into the unchanged files.
    pub fn check(&self, tables: &ScenarioTables) -> Result<Scenario, Vec<Diagnostic>> {
        let folder = self.opened.path.parent().unwrap_or_else(|| Path::new("."));
        let mut known = vec![self.plate.clone()];
        if let Some(table) = &tables.plate {
            known.push(KnownPlate { path: folder.join(CHANGED_PLATE), ..self.changed_plate(table)? });
        }
        let raw = self.raw_scenario(tables)?;
        Checker { source: self.opened.source(), prefix: String::new(), plates: &known }.check(raw, &self.file)
    }

    fn changed_plate(&self, table: &Table) -> Result<KnownPlate, Vec<Diagnostic>> {
        let KnownPlate { path, text, .. } = &self.plate;
        let raw: RawPlate = from_table(table, &self.plate_table, &PLATE_SCHEMA, &Source::file(path, text))?;
        let plate = check_plate(path, text, raw)?;
        Ok(KnownPlate { path: path.clone(), plate, text: String::new() })
    }

    pub fn inputs(&self) -> &[InputFile] {
        &self.scenario.inputs
    }
}

/// Checks keys, types and bounds. The bounds of `checked` are checked. The errors point into `source`.
fn from_table<T: DeserializeOwned>(
    table: &Table,
    checked: &Table,
    schema: &Schema,
    source: &Source<'_>,
) -> Result<T, Vec<Diagnostic>> {
    let raw =
        T::deserialize(table.clone()).map_err(|error| vec![Diagnostic::from_toml(source.path, source.text, &error)])?;
    let problems = range_errors(schema, table, Some(checked), source);
    if problems.is_empty() { Ok(raw) } else { Err(problems) }
}

/// Replaces the value at a dotted key. A number in the key selects an element of a list. Creates
/// missing tables.
fn set(table: &mut Table, key: &str, value: Value) -> Result<(), String> {
    let Some((name, rest)) = key.split_once('.') else {
        table.insert(key.to_owned(), value);
        return Ok(());
    };
    let next = table.entry(name).or_insert_with(|| Value::Table(Table::new()));
    set_below(next, name, rest, value)
}

fn set_below(parent: &mut Value, name: &str, key: &str, value: Value) -> Result<(), String> {
    match parent {
        Value::Table(table) => set(table, key, value),
        Value::Array(elements) => {
            let (index, rest) = key.split_once('.').map_or((key, None), |(index, rest)| (index, Some(rest)));
            let count = elements.len();
            let element = index.parse().ok().and_then(|index: usize| elements.get_mut(index));
            let missing = || format!("`{name}` has no element {index}, expected 0 to {}", count.saturating_sub(1));
            let element = element.ok_or_else(missing)?;
            if let Some(rest) = rest {
                return set_below(element, index, rest, value);
            }
            *element = value;
            Ok(())
        }
        other => Err(format!("`{name}` is a {} and has no key `{key}`", other.type_str())),
    }
}

pub const REQUIREMENTS_FILE: &str = "requirements.toml";

#[derive(Debug, Clone, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Requirement {
    /// Identifier, as in the expectations of scenarios.
    #[schemars(regex(pattern = "^[A-Za-z0-9-]+$"))]
    pub id: String,
    /// Text of the requirement.
    #[schemars(length(min = 1))]
    pub text: String,
}

#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct RawRequirements {
    #[serde(default)]
    requirement: Vec<Requirement>,
}

/// Fails if an identifier is empty or occurs twice, or if a text is empty.
pub fn read_requirements(path: &Path) -> Result<Vec<Requirement>, Vec<Diagnostic>> {
    let (mut checker, raw) = FileChecker::read::<RawRequirements>(path)?;
    let mut known = BTreeSet::new();
    for (number, requirement) in raw.requirement.iter().enumerate() {
        let key = |name: &str| format!("requirement.{number}.{name}");
        checker.require(!requirement.text.trim().is_empty(), &key("text"), || "empty, expected a text".to_owned());
        let is_new = !requirement.id.trim().is_empty() && known.insert(&requirement.id);
        checker.require(is_new, &key("id"), || {
            format!("`{}`, expected each identifier once and none empty", requirement.id)
        });
    }
    checker.finish().map(|_| raw.requirement)
}

/// Returns the texts of the identifiers in `used`. Empty if no folder above `scenario` contains
/// `requirements.toml`.
pub(crate) fn requirement_texts<'a>(
    scenario: &Path,
    used: impl Iterator<Item = &'a str>,
) -> Result<BTreeMap<String, String>, Vec<Diagnostic>> {
    let used: BTreeSet<&str> = used.collect();
    let Some(path) = (!used.is_empty()).then(|| file_above(scenario)).flatten() else { return Ok(BTreeMap::new()) };
    let known = read_requirements(&path)?.into_iter();
    let found = known.filter(|requirement| used.contains(requirement.id.as_str()));
    Ok(found.map(|requirement| (requirement.id, requirement.text.trim().to_owned())).collect())
}

fn file_above(scenario: &Path) -> Option<PathBuf> {
    let scenario = std::path::absolute(scenario).ok()?;
    scenario.ancestors().skip(1).map(|folder| folder.join(REQUIREMENTS_FILE)).find(|path| path.is_file())
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod template_tests;

#[cfg(test)]
mod requirements_tests {
    use super::*;
    use rstest::rstest;
    use std::fs;

    #[test]
    fn the_nearest_file_above_gives_the_texts() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("a/b");
        fs::create_dir_all(&folder).unwrap();
        let scenario = folder.join("s.toml");
        let texts = || requirement_texts(&scenario, ["R-1", "R-3"].into_iter()).unwrap();
        let outer =
            "[[requirement]]\nid = \"R-1\"\ntext = \" It settles. \"\n[[requirement]]\nid = \"R-2\"\ntext = \"x\"\n";
        fs::write(root.path().join(REQUIREMENTS_FILE), outer).unwrap();
        assert_eq!(texts(), BTreeMap::from([("R-1".to_owned(), "It settles.".to_owned())]));
        fs::write(folder.join(REQUIREMENTS_FILE), "").unwrap();
        assert_eq!(texts(), BTreeMap::new());
    }

    #[rstest]
    #[case("[[requirement]]\nid = \"R-1\"\ntext = \"\"", "empty, expected a text")]
    #[case("[[requirement]]\nid = \"\"\ntext = \"x\"", "expected each identifier once")]
    #[case(
        "[[requirement]]\nid = \"A\"\ntext = \"x\"\n[[requirement]]\nid = \"A\"\ntext = \"y\"",
        "`A`, expected each"
    )]
    #[case("[[requirement]]\nid = \"A\"\nwords = \"x\"", "unknown key")]
    #[case("title = \"A\"", "unknown key")]
    fn rejects_a_faulty_file(#[case] text: &str, #[case] expected: &str) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(REQUIREMENTS_FILE);
        fs::write(&path, text).unwrap();
        let problems = read_requirements(&path).unwrap_err();
        assert!(problems[0].message.contains(expected), "{}", problems[0].message);
    }
}
