//! Reads a text file with a bounded size.

use crate::scenario::diagnostic::Diagnostic;
use platebench_plate::input;
use std::path::Path;

/// A parsed TOML document takes about fifty times its size in memory.
const MAX_TOML_BYTES: usize = 4 << 20;

pub fn read_text(path: &Path) -> Result<String, Diagnostic> {
    let bytes = input::read(path).map_err(|error| Diagnostic::for_file(path, format!("cannot be read: {error}")))?;
    if bytes.len() > MAX_TOML_BYTES {
        let message =
            format!("is larger than {} MiB; write the points of a profile to a CSV file", MAX_TOML_BYTES >> 20);
        return Err(Diagnostic::for_file(path, message));
    }
    decode_text(path, bytes)
}

pub(crate) fn decode_text(path: &Path, bytes: Vec<u8>) -> Result<String, Diagnostic> {
    String::from_utf8(bytes).map_err(|error| {
        // Both texts are equal up to the first invalid byte, so `start` is valid in both.
        let start = error.utf8_error().valid_up_to();
        let replaced = String::from_utf8_lossy(error.as_bytes());
        let span = start..start + char::REPLACEMENT_CHARACTER.len_utf8();
        Diagnostic::at_span(path, &replaced, span, "not UTF-8, expected a text file in UTF-8")
    })
}
