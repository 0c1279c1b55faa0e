//! Checks plate files.

use super::checker::{Checker, Diagnostics};
use crate::scenario::bounds::MAX_QUALITY;
use crate::scenario::definition::InputFile;
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::parse::parse;
use crate::scenario::text::{decode_text, read_text};
use platebench_plate::{Plate, RawPlate, input};
use std::path::Path;

/// Fails with all wrong keys or, if there are none, with the first wrong value.
pub fn load_plate(path: &Path) -> Result<Plate, Vec<Diagnostic>> {
    parse_plate(path, &read_text(path).map_err(|fault| vec![fault])?)
}

/// Values of the plate file that no ultrasonic tactile plate has, at their keys.
pub fn implausible_values(path: &Path, plate: &Plate) -> Result<Vec<Diagnostic>, Diagnostic> {
    let found = plate.implausible_values();
    if found.is_empty() {
        return Ok(Vec::new());
    }
    let text = read_text(path)?;
    Ok(found.iter().map(|value| Diagnostic::at_key(path, &text, value.range.key, value.to_string())).collect())
}

/// Rejects a plate with an optional effect, such as a second mode. `user` names the calculation,
/// which assumes one mode and ideal electronics.
pub fn require_no_effects(path: &Path, plate: &Plate, user: &str) -> Result<(), Diagnostic> {
    let Some(effect) = plate.first_effect() else { return Ok(()) };
    let text = read_text(path)?;
    let message =
        format!("{user} assumes one mode with an ideal amplifier and sensor, expected a plate file without `{effect}`");
    Err(Diagnostic::at_key(path, &text, effect, message))
}

impl Checker<'_> {
    pub(super) fn plate(
        &self,
        key: &str,
        path: &Path,
        inputs: &mut Vec<InputFile>,
        faults: &mut Diagnostics,
    ) -> Option<Plate> {
        if let Some(known) = self.plates.iter().find(|known| known.path == path) {
            if !known.text.is_empty() {
                inputs.push(InputFile { path: path.to_owned(), bytes: known.text.clone().into_bytes() });
            }
            return Some(known.plate.clone());
        }
        let text = match input::read(path) {
            Ok(bytes) => faults.record_error(decode_text(path, bytes))?,
            Err(error) => {
                let message = format!("plate file {} cannot be read: {error}", path.display());
                return faults.record_error(self.error(key, message));
            }
        };
        let plate = parse_plate(path, &text).map_err(|found| faults.0.extend(found)).ok()?;
        inputs.push(InputFile { path: path.to_owned(), bytes: text.into_bytes() });
        Some(plate)
    }
}

fn parse_plate(path: &Path, text: &str) -> Result<Plate, Vec<Diagnostic>> {
    check_plate(path, text, parse(path, text)?)
}

pub(super) fn check_plate(path: &Path, text: &str, raw: RawPlate) -> Result<Plate, Vec<Diagnostic>> {
    let error_at = |key: &str, message: String| vec![Diagnostic::at_key(path, text, key, message)];
    let plate = raw.check().map_err(|error| error_at(error.key, error.to_string()))?;
    let second = plate.effects.second_mode.map(|second| ("second_mode.time_constant_ms", second.omega0, second.sigma0));
    let first = Some(("mode.time_constant_ms", plate.omega0, plate.sigma0));
    for (key, omega0, sigma0) in [first, second].into_iter().flatten() {
        let quality = omega0 / (2.0 * sigma0);
        if quality > MAX_QUALITY {
            let message = format!("a quality factor of {quality:.3e}, expected at most {MAX_QUALITY:e}");
            return Err(error_at(key, message));
        }
    }
    for (key, value) in [("mode.gain_um_per_vpp", plate.gain), ("drive.limit_vpp", plate.drive_limit_vpp)] {
        if !(value as f32).is_normal() {
            let message = format!("{value:e}, expected 1.2e-38 to 3.4e38: the wire carries single precision");
            return Err(error_at(key, message));
        }
    }
    Ok(plate)
}
