//! Parses TOML to a raw type and reports every wrong key.

use crate::scenario::diagnostic::{Diagnostic, MAX_DIAGNOSTICS};
use crate::scenario::schema::schema_of;
use crate::scenario::text::{decode_text, read_text};
use crate::scenario::value_range::range_errors;
use schemars::JsonSchema;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::ops::Range;
use std::path::Path;
use toml::de::{DeArray, DeTable, DeValue, Deserializer};
use toml::{Spanned, Table};

/// Also returns the text of the file. Fails as [`parse`] does, or if the file cannot be read.
pub fn parse_file<T: DeserializeOwned + JsonSchema>(path: &Path) -> Result<(String, T), Vec<Diagnostic>> {
    let text = read_text(path).map_err(|fault| vec![fault])?;
    let raw = parse(path, &text)?;
    Ok((text, raw))
}

pub fn parse_bytes<T: DeserializeOwned + JsonSchema>(
    path: &Path,
    bytes: Vec<u8>,
) -> Result<(String, T), Vec<Diagnostic>> {
    let text = decode_text(path, bytes).map_err(|fault| vec![fault])?;
    let raw = parse(path, &text)?;
    Ok((text, raw))
}

/// Fails with all syntax errors. If there are none, fails with all unknown keys and wrong types in
/// their order, then with all missing keys. If there are none, fails with all numbers outside the
/// bounds in the schema of `T`.
pub fn parse<T: DeserializeOwned + JsonSchema>(path: &Path, text: &str) -> Result<T, Vec<Diagnostic>> {
    // serde stops at the first error, so the wrong element is removed and the rest is read again.
    let mut rest = parse_syntax(path, text)?;
    let mut faults = Vec::new();
    let mut holes: Vec<Range<usize>> = Vec::new();
    loop {
        let error = match T::deserialize(Deserializer::from(rest.clone())) {
            Ok(raw) if faults.is_empty() => {
                let table = Table::deserialize(Deserializer::from(rest)).unwrap_or_default();
                let faults = range_errors(&schema_of::<T>(""), &table, path, text);
                return if faults.is_empty() { Ok(raw) } else { Err(with_truncation_note(path, faults)) };
            }
            Ok(_) => break,
            Err(error) => error,
        };
        let span = error.span().unwrap_or(0..0);
        // This loop removed the key, so the key is not missing in the file.
        let is_hole = error.message().starts_with("missing field") && holes.contains(&span);
        if !is_hole {
            faults.push(Diagnostic::from_toml(path, text, &error));
        }
        let own = rest.span();
        if faults.len() >= MAX_DIAGNOSTICS || !remove_span(rest.get_mut(), &own, &span, &mut holes) {
            break;
        }
    }
    // Missing keys come last, because a misspelt key may explain them.
    faults.sort_by_key(|fault| (fault.message.starts_with("missing key"), fault.position()));
    Err(with_truncation_note(path, faults))
}

/// Fails with all syntax errors.
pub(crate) fn parse_syntax<'a>(path: &Path, text: &'a str) -> Result<Spanned<DeTable<'a>>, Vec<Diagnostic>> {
    let (document, errors) = DeTable::parse_recoverable(text);
    let faults: Vec<_> =
        errors.iter().take(MAX_DIAGNOSTICS).map(|error| Diagnostic::from_toml(path, text, error)).collect();
    if faults.is_empty() { Ok(document) } else { Err(with_truncation_note(path, faults)) }
}

pub(crate) fn with_truncation_note(path: &Path, mut faults: Vec<Diagnostic>) -> Vec<Diagnostic> {
    if faults.len() >= MAX_DIAGNOSTICS {
        faults.push(Diagnostic::for_file(path, format!("only the first {MAX_DIAGNOSTICS} errors are listed")));
    }
    faults
}

/// Removes the element at `span`; false if no element has it. `own` is the span of `table`.
fn remove_span(
    table: &mut DeTable<'_>,
    own: &Range<usize>,
    span: &Range<usize>,
    holes: &mut Vec<Range<usize>>,
) -> bool {
    let found = table.iter().find(|(key, value)| key.span() == *span || matches_span(value, span));
    if let Some(key) = found.map(|(key, _)| key.get_ref().clone()) {
        holes.push(own.clone());
        return table.remove(&*key).is_some();
    }
    table.iter_mut().any(|(_, value)| remove_span_in_value(value, span, holes))
}

fn remove_span_in_value(value: &mut Spanned<DeValue<'_>>, span: &Range<usize>, holes: &mut Vec<Range<usize>>) -> bool {
    let own = value.span();
    match value.get_mut() {
        DeValue::Table(table) => remove_span(table, &own, span, holes),
        DeValue::Array(elements) if elements.iter().any(|element| element.span() == *span) => {
            let all = std::mem::replace(elements, DeArray::new());
            *elements = all.into_iter().filter(|element| element.span() != *span).collect();
            true
        }
        DeValue::Array(elements) => elements.iter_mut().any(|element| remove_span_in_value(element, span, holes)),
        _ => false,
    }
}

/// A list of numbers matches as a whole. A list of tables has the span of its first table, so only
/// its tables can match.
fn matches_span(value: &Spanned<DeValue<'_>>, span: &Range<usize>) -> bool {
    let own = value.span();
    match value.get_ref() {
        DeValue::Array(elements) if elements.iter().any(|element| element.get_ref().is_table()) => false,
        DeValue::Array(_) => own.start <= span.start && span.end <= own.end,
        _ => own == *span,
    }
}

#[cfg(test)]
mod tests;
