//! A plate file that is named on the command line.

use platebench_plate::Plate;
use platebench_plate::file::RawPlate;
use platebench_scenario::Diagnostic;
use std::fs;
use std::path::Path;

/// Reads and checks it; a [`Diagnostic`] with line and column where it cannot be meant.
pub(crate) fn read(path: &Path) -> Result<Plate, Diagnostic> {
    let text =
        fs::read_to_string(path).map_err(|error| Diagnostic::of_file(path, format!("cannot be read: {error}")))?;
    let raw: RawPlate = toml::from_str(&text)
        .map_err(|error| Diagnostic::at_span(path, &text, error.span().unwrap_or_default(), error.message()))?;
    raw.check().map_err(|error| Diagnostic::at_key(path, &text, error.key, error.to_string()))
}

/// What is wrong at `key` of a file that was read.
pub(crate) fn fault(path: &Path, key: &str, message: String) -> Diagnostic {
    let text = fs::read_to_string(path).unwrap_or_default();
    Diagnostic::at_key(path, &text, key, message)
}
