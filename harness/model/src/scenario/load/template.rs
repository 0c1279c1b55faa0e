//! Loads a scenario with changed values without a file for each change.

use super::checker::{Checker, KnownPlate};
use super::plate::{check_plate, load_plate};
use crate::scenario::definition::{InputFile, Scenario};
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::raw::RawScenario;
use crate::scenario::schema::{PLATE_SCHEMA, SCENARIO_SCHEMA};
use crate::scenario::text::read_text;
use crate::scenario::value_range::range_errors;
use platebench_plate::RawPlate;
use schemars::Schema;
use serde::de::DeserializeOwned;
use std::path::{Path, PathBuf};
use toml::{Table, Value};

pub const PLATE_PREFIX: &str = "plate.";
/// Name of a changed plate in the scenario's folder. No file has this name.
const CHANGED_PLATE: &str = "changed-plate.toml";

#[derive(Debug, Clone)]
pub struct ScenarioTemplate {
    path: PathBuf,
    text: String,
    file: String,
    table: Table,
    plate_name: String,
    plate: KnownPlate,
    plate_table: Table,
    pub scenario: Scenario,
}

#[derive(Debug, Clone)]
pub struct ScenarioTables {
    pub scenario: Table,
    /// `None` if the plate is unchanged.
    pub plate: Option<Table>,
}

impl ScenarioTemplate {
    /// `scenario` must be loaded from `path`. `edit` changes the table of the scenario file first.
    pub(super) fn new(path: &Path, scenario: Scenario, edit: impl FnOnce(&mut Table)) -> Result<Self, Vec<Diagnostic>> {
        let read = |path: &Path| read_text(path).map_err(|fault| vec![fault]);
        let parse = |path: &Path, text: &str| {
            text.parse::<Table>().map_err(|error| vec![Diagnostic::from_toml(path, text, &error)])
        };
        let text = read(path)?;
        let mut table = parse(path, &text)?;
        edit(&mut table);
        let plate_name = table.get("plate").and_then(Value::as_str).unwrap_or_default().to_owned();
        let plate_path = path.parent().unwrap_or_else(|| Path::new(".")).join(&plate_name);
        let plate_text = read(&plate_path)?;
        let plate_table = parse(&plate_path, &plate_text)?;
        let plate = load_plate(&plate_path)?;
        let plate = KnownPlate { path: plate_path, plate, text: plate_text };
        let (path, file) = (path.to_owned(), scenario.file.clone());
        Ok(Self { path, text, file, table, plate_name, plate, plate_table, scenario })
    }

    /// Replaces the values at dotted keys. Fails if a key leads through a number, a text or a
    /// missing element of a list.
    pub fn tables<'a>(&self, changes: impl IntoIterator<Item = (&'a str, Value)>) -> Result<ScenarioTables, String> {
        let mut tables = ScenarioTables { scenario: self.table.clone(), plate: None };
        for (key, value) in changes {
            match key.strip_prefix(PLATE_PREFIX) {
                Some(key) => set(tables.plate.get_or_insert_with(|| self.plate_table.clone()), key, value)?,
                None => set(&mut tables.scenario, key, value)?,
            }
        }
        if tables.plate.is_some() {
            // Keeps the controller configured for the unchanged plate.
            let controller = tables.scenario.entry("controller").or_insert_with(|| Value::Table(Table::new()));
            if let Value::Table(controller) = controller {
                controller.entry("design_plate").or_insert_with(|| Value::String(self.plate_name.clone()));
            }
            tables.scenario.insert("plate".to_owned(), Value::String(CHANGED_PLATE.to_owned()));
        }
        Ok(tables)
    }

    /// Checks the tables like [`super::load`]. Diagnostics point into the unchanged files.
    pub fn check(&self, tables: &ScenarioTables) -> Result<Scenario, Vec<Diagnostic>> {
        let folder = self.path.parent().unwrap_or_else(|| Path::new("."));
        let mut known = vec![self.plate.clone()];
        if let Some(table) = &tables.plate {
            known.push(KnownPlate { path: folder.join(CHANGED_PLATE), ..self.changed_plate(table)? });
        }
        let raw: RawScenario = from_table(&tables.scenario, &SCENARIO_SCHEMA, &self.path, &self.text)?;
        Checker { path: &self.path, text: &self.text, prefix: String::new(), plates: &known }.check(raw, &self.file)
    }

    fn changed_plate(&self, table: &Table) -> Result<KnownPlate, Vec<Diagnostic>> {
        let KnownPlate { path, text, .. } = &self.plate;
        let raw: RawPlate = from_table(table, &PLATE_SCHEMA, path, text)?;
        let plate = check_plate(path, text, raw)?;
        Ok(KnownPlate { path: path.clone(), plate, text: String::new() })
    }

    pub fn inputs(&self) -> &[InputFile] {
        &self.scenario.inputs
    }
}

/// Checks keys, types and bounds. The errors point into `text`.
fn from_table<T: DeserializeOwned>(
    table: &Table,
    schema: &Schema,
    path: &Path,
    text: &str,
) -> Result<T, Vec<Diagnostic>> {
    let raw = T::deserialize(table.clone()).map_err(|error| vec![Diagnostic::from_toml(path, text, &error)])?;
    let faults = range_errors(schema, table, path, text);
    if faults.is_empty() { Ok(raw) } else { Err(faults) }
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

#[cfg(test)]
mod tests;
