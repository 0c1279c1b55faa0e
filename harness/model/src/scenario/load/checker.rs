//! Checks values and points at the wrong ones. Checks plate files.

use crate::input;
use crate::scenario::definition::InputFile;
use crate::scenario::diagnostic::{Diagnostic, MAX_DIAGNOSTICS, suggestion};
use crate::scenario::fault::Fault;
use crate::scenario::file_checker::not_one_line;
use crate::scenario::matrix::Source;
use crate::scenario::parse::{decode_text, parse, read_text};
use crate::scenario::window::ProfileChanges;
use platebench_plate::{Plate, Profile, RawPlate, Time};
use std::path::{Path, PathBuf};

pub(super) const MAX_DELAY_PERIODS: u64 = 100;
/// A higher quality factor is a mistyped unit. Far above this one, rounding removes the damping.
pub(super) const MAX_QUALITY: f64 = 1e9;

/// A plate that was already checked, so that its file is not read again.
#[derive(Debug, Clone)]
pub(super) struct KnownPlate {
    pub(super) path: PathBuf,
    pub(super) plate: Plate,
    /// Text of the plate file; empty if no file contains the plate.
    pub(super) text: String,
}

pub(crate) struct Checker<'a> {
    pub(super) source: Source<'a>,
    /// Path of the checked table, for example `between.0.`; empty for the whole file.
    pub(super) prefix: String,
    pub(super) plates: &'a [KnownPlate],
}

pub(super) struct TrialContext<'a> {
    pub(super) duration: Time,
    /// Longest time from a setpoint change to actuation.
    pub(super) response_delay: Time,
    pub(super) setpoint: &'a Profile,
    pub(super) changes: ProfileChanges,
    pub(super) faults: &'a [Fault],
}

#[derive(Debug, Default)]
pub(super) struct Diagnostics(pub(super) Vec<Diagnostic>);

impl Diagnostics {
    pub(super) fn record_error<T>(&mut self, result: Result<T, Diagnostic>) -> Option<T> {
        result.map_err(|error| self.0.push(error)).ok()
    }

    pub(super) fn record_errors<T>(&mut self, results: &mut dyn Iterator<Item = Result<T, Diagnostic>>) -> Vec<T> {
        let mut kept = Vec::new();
        while self.0.len() < MAX_DIAGNOSTICS
            && let Some(result) = results.next()
        {
            kept.extend(self.record_error(result));
        }
        kept
    }
}

impl<'a> Checker<'a> {
    pub(super) fn table(&self, name: &str) -> Checker<'a> {
        Checker { prefix: format!("{}{name}.", self.prefix), ..*self }
    }

    pub(super) fn diagnostic(&self, key: &str, message: impl Into<String>) -> Diagnostic {
        self.source.diagnostic(&format!("{}{key}", self.prefix), message)
    }

    pub(super) fn error<T>(&self, key: &str, message: impl Into<String>) -> Result<T, Diagnostic> {
        Err(self.diagnostic(key, message))
    }

    pub(crate) fn require<M: Into<String>>(
        &self,
        holds: bool,
        key: &str,
        message: impl FnOnce() -> M,
    ) -> Result<(), Diagnostic> {
        if holds { Ok(()) } else { self.error(key, message()) }
    }

    pub(super) fn one_line(&self, key: &str, text: &str) -> Result<(), Diagnostic> {
        not_one_line(text).map_or(Ok(()), |message| self.error(key, message))
    }

    pub(super) fn f32_range(&self, key: &str, value: f64) -> Result<f64, Diagnostic> {
        self.require((value as f32).is_finite(), key, || {
            format!("{value:e}, expected -3.4e38 to 3.4e38: the wire carries single precision")
        })?;
        Ok(value)
    }

    pub(super) fn time_from_ms(&self, key: &str, ms: f64) -> Result<Time, Diagnostic> {
        match Time::from_ms(ms) {
            Some(time) => Ok(time),
            None => self.error(key, format!("{ms} ms, expected a time from 0 to 9.0e9 ms")),
        }
    }

    pub(super) fn find_by_name<T: Copy, const N: usize>(
        &self,
        key: &str,
        what: &str,
        name: &str,
        all: [(&str, T); N],
    ) -> Result<T, Diagnostic> {
        if let Some((_, value)) = all.iter().find(|(known, _)| *known == name) {
            return Ok(*value);
        }
        self.unknown_name(key, what, name, &all.map(|(known, _)| known))
    }

    pub(super) fn unknown_name<T>(&self, key: &str, what: &str, name: &str, known: &[&str]) -> Result<T, Diagnostic> {
        let quoted: Vec<_> = known.iter().map(|name| format!("`{name}`")).collect();
        let hint = suggestion(name, known.iter().copied());
        self.error(key, format!("{what}`{name}`, expected one of {}{hint}", quoted.join(", ")))
    }
}

/// Fails with all wrong keys or, if there are none, with the first wrong value.
pub fn load_plate(path: &Path) -> Result<Plate, Vec<Diagnostic>> {
    parse_plate(path, &read_text(path).map_err(|problem| vec![problem])?)
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
        problems: &mut Diagnostics,
    ) -> Option<Plate> {
        if let Some(known) = self.plates.iter().find(|known| known.path == path) {
            if !known.text.is_empty() {
                inputs.push(InputFile { path: path.to_owned(), bytes: known.text.clone().into_bytes() });
            }
            return Some(known.plate.clone());
        }
        let text = match input::read(path) {
            Ok(bytes) => problems.record_error(decode_text(path, bytes))?,
            Err(error) => {
                let message = format!("plate file {} cannot be read: {error}", path.display());
                return problems.record_error(self.error(key, message));
            }
        };
        let plate = parse_plate(path, &text).map_err(|found| problems.0.extend(found)).ok()?;
        inputs.push(InputFile { path: path.to_owned(), bytes: text.into_bytes() });
        Some(plate)
    }
}

/// Like [`load_plate`], for a file that is not written yet.
pub fn parse_plate(path: &Path, text: &str) -> Result<Plate, Vec<Diagnostic>> {
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
