//! Checks scenario files: raw to [`Scenario`], with a pointer to every wrong value.

mod checker;
mod controller;
mod expectation;
mod expectation_window;
mod fault;
mod plate;
mod profile;
mod scenario;
mod scene;
mod text;

pub use plate::load_plate;

use crate::diagnostic::Diagnostic;
use crate::parse::{parse, with_truncation_note};
use crate::raw::RawScenario;
use crate::scenario::Scenario;
use checker::{Checker, Diagnostics};
use std::path::{Path, PathBuf};
use text::read_text;

/// Records call the scenario at `path` `file`. Returns the first error of its files.
pub fn load(path: &Path, file: &str) -> Result<Scenario, Diagnostic> {
    load_with_all_errors(path, file).map_err(|faults| first_diagnostic(path, faults))
}

/// Like [`load()`], with every error that does not depend on another one, and the first of each
/// `[[fault]]` and `[[expect]]`.
pub fn load_with_all_errors(path: &Path, file: &str) -> Result<Scenario, Vec<Diagnostic>> {
    load_from(path, file, &[])
}

/// Loads a scenario from copies of its inputs, in the order of [`Scenario::inputs`].
pub fn load_copies(copies: &[PathBuf], file: &str) -> Result<Scenario, Diagnostic> {
    let [path, named @ ..] = copies else { return Err(Diagnostic::for_file(Path::new(file), "has no copy")) };
    load_from(path, file, named).map_err(|faults| first_diagnostic(path, faults))
}

fn first_diagnostic(path: &Path, faults: Vec<Diagnostic>) -> Diagnostic {
    faults.into_iter().next().unwrap_or_else(|| Diagnostic::for_file(path, "rejected without a reason"))
}

fn load_from(path: &Path, file: &str, copies: &[PathBuf]) -> Result<Scenario, Vec<Diagnostic>> {
    let text = read_text(path).map_err(|fault| vec![fault])?;
    let mut raw: RawScenario = parse(path, &text)?;
    for (named, copy) in raw.files().zip(copies) {
        // Relative names start at the scenario.
        *named = std::path::absolute(copy).unwrap_or_else(|_| copy.clone());
    }
    let mut faults = Diagnostics::default();
    match (Checker { path, text: &text, prefix: String::new() }.scenario(raw, file, &mut faults), faults.0) {
        (Some(scenario), faults) if faults.is_empty() => Ok(scenario),
        (_, faults) => Err(with_truncation_note(path, faults)),
    }
}

#[cfg(test)]
mod tests;
