//! Checks raw scenario files, converts them to [`Scenario`] and points at every wrong value.

mod checker;
mod controller;
mod expectation;
mod expectation_window;
mod fault;
mod plate;
mod profile;
mod scenario;
mod scene;
mod template;

pub use plate::{implausible_values, load_plate, require_no_effects};
pub use template::{PLATE_PREFIX, ScenarioTables, ScenarioTemplate};

use crate::scenario::definition::Scenario;
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::parse::{parse, with_truncation_note};
use crate::scenario::raw::RawScenario;
use crate::scenario::requirements::requirement_texts;
use crate::scenario::schema::{PLATE_SCHEMA, SCENARIO_SCHEMA};
use crate::scenario::value_range::range_errors;
use checker::{Checker, KnownPlate};
use plate::check_plate;
use platebench_plate::RawPlate;
use schemars::Schema;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use toml::Table;

/// `file` is the name of the scenario in records. Returns only the first error.
pub fn load(path: &Path, file: &str) -> Result<Scenario, Diagnostic> {
    load_with_all_errors(path, file).map_err(|faults| first_diagnostic(path, faults))
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
    load_from(path, file, named).map_err(|faults| first_diagnostic(path, faults))
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
        Checker { path, text: "", prefix: String::new(), plates: &plates }.check(raw, file)
    };
    checked().map_err(|faults| first_diagnostic(path, faults))
}

fn check_ranges(schema: &Schema, raw: &impl Serialize, path: &Path) -> Result<(), Vec<Diagnostic>> {
    let table = Table::try_from(raw).map_err(|error| vec![Diagnostic::for_file(path, error.to_string())])?;
    let faults = range_errors(schema, &table, path, "");
    if faults.is_empty() { Ok(()) } else { Err(faults) }
}

fn first_diagnostic(path: &Path, faults: Vec<Diagnostic>) -> Diagnostic {
    faults.into_iter().next().unwrap_or_else(|| Diagnostic::for_file(path, "rejected without a reason"))
}

fn load_from(path: &Path, file: &str, copies: &[PathBuf]) -> Result<Scenario, Vec<Diagnostic>> {
    let text = crate::scenario::text::read_text(path).map_err(|fault| vec![fault])?;
    let mut raw: RawScenario = parse(path, &text)?;
    for (named, copy) in raw.files().zip(copies) {
        // A relative path would be resolved from the scenario's folder.
        *named = std::path::absolute(copy).unwrap_or_else(|_| copy.clone());
    }
    let checker = Checker { path, text: &text, prefix: String::new(), plates: &[] };
    let mut scenario = checker.check(raw, file).map_err(|faults| with_truncation_note(path, faults))?;
    // The run record contains the texts. There is no `requirements.toml` above the copies.
    if copies.is_empty() {
        let used = scenario.expectations.iter().filter_map(|expectation| expectation.requirement.as_deref());
        scenario.requirement_texts = requirement_texts(path, used)?;
    }
    Ok(scenario)
}

#[cfg(test)]
mod tests;
