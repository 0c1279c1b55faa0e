//! Reads the plate file of the command line.

use platebench_plate::Plate;
use platebench_plate::RawPlate;
use platebench_scenario::load::require_no_effects;
use platebench_scenario::{Diagnostic, input};
use std::io;
use std::path::Path;

/// For `user`, a command that calculates with one mode, an ideal amplifier and an ideal sensor.
pub(crate) fn read_without_effects(path: &Path, user: &str) -> Result<Plate, Diagnostic> {
    let (plate, _) = read_with_text(path)?;
    require_no_effects(path, &plate, user).map(|()| plate)
}

pub(crate) fn read_with_text(path: &Path) -> Result<(Plate, String), Diagnostic> {
    let refused = |error: io::Error| Diagnostic::for_file(path, format!("cannot be read: {error}"));
    let text = String::from_utf8(input::read(path).map_err(refused)?)
        .map_err(|_| Diagnostic::for_file(path, "not UTF-8, expected a text file in UTF-8"))?;
    let raw: RawPlate = toml::from_str(&text)
        .map_err(|error| Diagnostic::at_span(path, &text, error.span().unwrap_or_default(), error.message()))?;
    match raw.check() {
        Ok(plate) => Ok((plate, text)),
        Err(error) => Err(Diagnostic::at_key(path, &text, error.key, error.to_string())),
    }
}

pub(crate) fn diagnostic_at(path: &Path, key: &str, message: String) -> Diagnostic {
    let text = input::read(path).ok().and_then(|bytes| String::from_utf8(bytes).ok()).unwrap_or_default();
    Diagnostic::at_key(path, &text, key, message)
}
