//! Checks values and points at the wrong ones.

use crate::scenario::diagnostic::{Diagnostic, MAX_DIAGNOSTICS, suggestion};
use crate::scenario::fault::Fault;
use crate::scenario::window::ProfileChanges;
use platebench_plate::{Plate, Profile, Time};
use std::path::{Path, PathBuf};

/// A plate that was already checked, so that its file is not read again.
#[derive(Debug, Clone)]
pub(super) struct KnownPlate {
    pub(super) path: PathBuf,
    pub(super) plate: Plate,
    /// Text of the plate file; empty if no file contains the plate.
    pub(super) text: String,
}

pub(super) struct Checker<'a> {
    pub(super) path: &'a Path,
    pub(super) text: &'a str,
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
        Diagnostic::at_key(self.path, self.text, &format!("{}{key}", self.prefix), message)
    }

    pub(super) fn error<T>(&self, key: &str, message: impl Into<String>) -> Result<T, Diagnostic> {
        Err(self.diagnostic(key, message))
    }

    pub(super) fn require<M: Into<String>>(
        &self,
        holds: bool,
        key: &str,
        message: impl FnOnce() -> M,
    ) -> Result<(), Diagnostic> {
        if holds { Ok(()) } else { self.error(key, message()) }
    }

    pub(super) fn one_line(&self, key: &str, text: &str) -> Result<(), Diagnostic> {
        let is_one_line = !text.trim().is_empty() && !text.contains(char::is_control);
        self.require(is_one_line, key, || format!("{text:?}, expected one line of text"))
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
