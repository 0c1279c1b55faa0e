//! Reads TOML files: parses them to a raw type, reports every wrong key, and checks every number
//! against the bounds of the JSON Schema.
//!
//! A raw type states the bounds of each number once, in its schema attributes. Texts, lists and
//! relations between keys have their own checks, with messages that name the reason.

use crate::input;
use crate::scenario::diagnostic::{Diagnostic, MAX_DIAGNOSTICS, unit_of_key};
use crate::scenario::matrix::Source;
use crate::scenario::schema::schema_of;
use schemars::{JsonSchema, Schema};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value as Json;
use std::ops::Range;
use std::path::Path;
use toml::de::{DeArray, DeTable, DeValue, Deserializer};
use toml::{Spanned, Table, Value};

/// Also returns the text of the file. Fails as [`parse`] does, or if the file cannot be read.
pub(crate) fn parse_file<T: DeserializeOwned + JsonSchema>(path: &Path) -> Result<(String, T), Vec<Diagnostic>> {
    let text = read_text(path).map_err(|problem| vec![problem])?;
    let raw = parse(path, &text)?;
    Ok((text, raw))
}

pub fn parse_bytes<T: DeserializeOwned + JsonSchema>(
    path: &Path,
    bytes: Vec<u8>,
) -> Result<(String, T), Vec<Diagnostic>> {
    let text = decode_text(path, bytes).map_err(|problem| vec![problem])?;
    let raw = parse(path, &text)?;
    Ok((text, raw))
}

/// Start of toml's message for an enum in a table without a key.
const NO_VARIANT: &str = "wanted exactly 1 element, found 0";

/// Fails with all syntax errors. If there are none, fails with all unknown keys and wrong types in
/// their order, then with all missing keys. If there are none, fails with all numbers outside the
/// bounds in the schema of `T`.
pub fn parse<T: DeserializeOwned + JsonSchema>(path: &Path, text: &str) -> Result<T, Vec<Diagnostic>> {
    parse_source(&Source::file(path, text))
}

/// Like [`parse`], for a file or a case of its matrix.
pub(crate) fn parse_source<T: DeserializeOwned + JsonSchema>(source: &Source<'_>) -> Result<T, Vec<Diagnostic>> {
    let Source { path, text, .. } = *source;
    // serde stops at the first error, so the wrong element is removed and the rest is read again.
    let mut rest = source.document().map_err(|problems| with_truncation_note(path, problems))?;
    let mut problems = Vec::new();
    let mut holes: Vec<Range<usize>> = Vec::new();
    loop {
        let error = match T::deserialize(Deserializer::from(rest.clone())) {
            Ok(raw) if problems.is_empty() => {
                let table = Table::deserialize(Deserializer::from(rest)).unwrap_or_default();
                let problems = range_errors(&schema_of::<T>(""), &table, None, source);
                return if problems.is_empty() { Ok(raw) } else { Err(with_truncation_note(path, problems)) };
            }
            Ok(_) => break,
            Err(error) => error,
        };
        let span = error.span().unwrap_or(0..0);
        // This loop removed the key, so the key is not missing in the file.
        let is_missing = ["missing field", NO_VARIANT].iter().any(|start| error.message().starts_with(start));
        let is_hole = is_missing && holes.contains(&span);
        if !is_hole {
            problems.push(Diagnostic::from_toml(path, text, &error));
        }
        let own = rest.span();
        if problems.len() >= MAX_DIAGNOSTICS || !remove_span(rest.get_mut(), &own, &span, &mut holes) {
            break;
        }
    }
    // Missing keys come last, because a misspelt key may explain them.
    problems.sort_by_key(|problem| (problem.message.starts_with("missing key"), problem.position()));
    Err(with_truncation_note(path, problems))
}

/// Fails with all syntax errors.
pub(crate) fn parse_syntax<'a>(path: &Path, text: &'a str) -> Result<Spanned<DeTable<'a>>, Vec<Diagnostic>> {
    let (document, errors) = DeTable::parse_recoverable(text);
    let problems: Vec<_> =
        errors.iter().take(MAX_DIAGNOSTICS).map(|error| Diagnostic::from_toml(path, text, error)).collect();
    if problems.is_empty() { Ok(document) } else { Err(with_truncation_note(path, problems)) }
}

pub(crate) fn with_truncation_note(path: &Path, mut problems: Vec<Diagnostic>) -> Vec<Diagnostic> {
    if problems.len() >= MAX_DIAGNOSTICS {
        problems.push(Diagnostic::for_file(path, format!("only the first {MAX_DIAGNOSTICS} errors are listed")));
    }
    problems
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

/// Returns an error for each number outside its bounds, and for each NaN or infinity, in the order
/// of the file. `source` is the file, or the file that `table` is derived from. Values that are equal
/// in `checked` have no error.
pub(crate) fn range_errors(
    schema: &Schema,
    table: &Table,
    checked: Option<&Table>,
    source: &Source<'_>,
) -> Vec<Diagnostic> {
    let root = schema.as_value();
    let mut search = Search { root, errors: Vec::new() };
    search.table(root, table, checked, "");
    let errors = search.errors.into_iter().take(MAX_DIAGNOSTICS);
    let mut errors: Vec<_> = errors.map(|(key, message)| source.diagnostic(&key, message)).collect();
    errors.sort_by_key(Diagnostic::position);
    errors
}

struct Search<'a> {
    root: &'a Json,
    /// Dotted key and message.
    errors: Vec<(String, String)>,
}

impl<'a> Search<'a> {
    fn table(&mut self, schema: &'a Json, table: &Table, checked: Option<&Table>, prefix: &str) {
        for (name, value) in table {
            let checked = checked.and_then(|checked| checked.get(name));
            if checked == Some(value) {
                continue;
            }
            if let Some(schema) = schema["properties"].get(name).or_else(|| schema.get("additionalProperties")) {
                self.value(schema, value, checked, &format!("{prefix}{name}"));
            }
        }
    }

    fn value(&mut self, schema: &'a Json, value: &Value, checked: Option<&Value>, key: &str) {
        // A reference may have bounds beside it.
        if let Some(definition) = self.definition(schema) {
            self.value(definition, value, checked, key);
        }
        for alternative in ["anyOf", "oneOf"].iter().filter_map(|word| schema[word].as_array()).flatten() {
            if self.fits(alternative, value) {
                self.value(alternative, value, checked, key);
            }
        }
        match value {
            Value::Table(table) => {
                self.table(schema, table, checked.and_then(Value::as_table), &format!("{key}."));
            }
            Value::Array(elements) => {
                let tuple = schema["prefixItems"].as_array();
                for (index, element) in elements.iter().enumerate() {
                    if let Some(schema) = tuple.and_then(|items| items.get(index)).or_else(|| schema.get("items")) {
                        self.value(schema, element, None, &format!("{key}.{index}"));
                    }
                }
            }
            Value::Integer(number) if is_number(schema) => {
                self.number(schema, *number as f64, &number.to_string(), key);
            }
            Value::Float(number) if is_number(schema) => self.number(schema, *number, &number.to_string(), key),
            _ => {}
        }
    }

    fn number(&mut self, schema: &Json, number: f64, written: &str, key: &str) {
        let bounds = Bounds::of(schema);
        if !bounds.contain(number) {
            let unit = unit_of_key(key).map_or_else(String::new, |unit| format!(" {unit}"));
            self.errors.push((key.to_owned(), format!("{written}{unit}, expected {}", bounds.describe(number))));
        }
    }

    fn definition(&self, schema: &Json) -> Option<&'a Json> {
        self.root.pointer(schema["$ref"].as_str()?.strip_prefix('#')?)
    }

    /// True if `value` can be of this alternative by its type and its keys.
    fn fits(&self, schema: &'a Json, value: &Value) -> bool {
        if let Some(definition) = self.definition(schema) {
            return self.fits(definition, value);
        }
        if let Some(alternatives) = schema["oneOf"].as_array() {
            return alternatives.iter().any(|alternative| self.fits(alternative, value));
        }
        match (schema["type"].as_str(), value) {
            (Some("object"), Value::Table(table)) => table.keys().all(|name| schema["properties"].get(name).is_some()),
            (Some("array"), Value::Array(_)) => true,
            _ => is_number(schema) && matches!(value, Value::Integer(_) | Value::Float(_)),
        }
    }
}

fn is_number(schema: &Json) -> bool {
    matches!(schema["type"].as_str(), Some("number" | "integer"))
}

/// A bound and whether the bound itself is allowed.
type Bound<'a> = Option<(&'a Json, bool)>;

struct Bounds<'a> {
    low: Bound<'a>,
    high: Bound<'a>,
}

impl<'a> Bounds<'a> {
    fn of(schema: &'a Json) -> Self {
        let bound = |word: &str, closed: bool| schema.get(word).map(|bound| (bound, closed));
        Self {
            low: bound("exclusiveMinimum", false).or_else(|| bound("minimum", true)),
            high: bound("exclusiveMaximum", false).or_else(|| bound("maximum", true)),
        }
    }

    fn contain(&self, number: f64) -> bool {
        let is_inside = |bound: Bound<'_>, sign: f64| {
            let Some((bound, closed)) = bound else { return true };
            let distance = bound.as_f64().map_or(0.0, |bound| (number - bound) * sign);
            distance > 0.0 || (closed && distance == 0.0)
        };
        number.is_finite() && is_inside(self.low, 1.0) && is_inside(self.high, -1.0)
    }

    fn describe(&self, wrong: f64) -> String {
        let [low, high] = [self.low, self.high].map(|bound| bound.map(|(bound, closed)| (text_of(bound), closed)));
        match (low, high) {
            (Some((low, true)), Some((high, true))) => format!("{low} to {high}"),
            (Some((low, true)), Some((high, false))) => format!("{low} or more and below {high}"),
            (Some((low, false)), Some((high, true))) => format!("above {low} and at most {high}"),
            (Some((low, false)), Some((high, false))) => format!("above {low} and below {high}"),
            (Some((low, true)), None) if wrong.is_finite() => format!("{low} or more"),
            (Some((low, true)), None) => format!("a finite number, {low} or more"),
            (Some((low, false)), None) => format!("a finite number above {low}"),
            (None, Some((high, true))) => format!("a finite number up to {high}"),
            (None, Some((high, false))) => format!("a finite number below {high}"),
            (None, None) => "a finite number".to_owned(),
        }
    }
}

fn text_of(bound: &Json) -> String {
    match bound.as_f64().filter(|_| bound.is_f64()) {
        Some(number) if number.abs() >= 1e6 => format!("{number:e}"),
        Some(number) => number.to_string(),
        None => bound.to_string(),
    }
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod value_range_tests {
    use super::*;
    use crate::scenario::schema::schema_of;
    use rstest::rstest;
    use schemars::JsonSchema;

    /// Only its schema is used.
    #[derive(JsonSchema)]
    #[expect(dead_code, reason = "only the schema is used")]
    struct Raw {
        #[schemars(extend("exclusiveMinimum" = 0), range(max = 10.0))]
        period_ms: Option<f64>,
        #[schemars(range(min = 0.5), extend("exclusiveMaximum" = 1))]
        confidence: Option<f64>,
        #[schemars(range(min = 1, max = 3))]
        count: Option<i64>,
        #[schemars(inner(range(min = 0.0, max = 2.0)))]
        force_n: Option<[f64; 2]>,
        gain: Option<f64>,
        shape: Option<Shape>,
        list: Option<Vec<Inner>>,
    }

    #[derive(JsonSchema)]
    #[expect(dead_code, reason = "only the schema is used")]
    #[serde(untagged)]
    enum Shape {
        Number(f64),
        Last(#[schemars(extend("exclusiveMinimum" = 0))] [f64; 2]),
        Inner(Inner),
    }

    #[derive(JsonSchema)]
    #[expect(dead_code, reason = "only the schema is used")]
    struct Inner {
        #[schemars(extend("exclusiveMinimum" = 0))]
        width_um: f64,
    }

    #[rstest]
    #[case("period_ms = 0", "1:13: `period_ms`: 0 ms, expected above 0 and at most 10")]
    #[case("period_ms = 10.5", "1:13: `period_ms`: 10.5 ms, expected above 0 and at most 10")]
    #[case("confidence = 1.0", "1:14: `confidence`: 1, expected 0.5 or more and below 1")]
    #[case("count = 4", "1:9: `count`: 4, expected 1 to 3")]
    #[case("force_n = [0.0, 2.5]", "1:17: `force_n`: 2.5 N, expected 0 to 2")]
    #[case("gain = nan", "1:8: `gain`: NaN, expected a finite number")]
    #[case("shape = -inf", "1:9: `shape`: -inf, expected a finite number")]
    #[case("shape = { width_um = 0 }", "1:22: `width_um`: 0 µm, expected a finite number above 0")]
    #[case("count = 3\n[[list]]\nwidth_um = -1", "3:12: `width_um`: -1 µm, expected a finite number above 0")]
    fn reports_a_number_outside_its_bounds(#[case] text: &str, #[case] expected: &str) {
        let errors =
            range_errors(&schema_of::<Raw>("raw"), &text.parse().unwrap(), None, &Source::file(Path::new("a"), text));
        let errors: Vec<_> = errors.iter().map(|error| error.to_string().replacen("a:", "", 1)).collect();
        assert_eq!(errors, [expected]);
    }

    #[test]
    fn accepts_the_bounds_themselves() {
        let text = "period_ms = 10\nconfidence = 0.5\ncount = 3\nforce_n = [0.0, 2.0]\nshape = [-1.0, 1.0]";
        assert_eq!(
            range_errors(&schema_of::<Raw>("raw"), &text.parse().unwrap(), None, &Source::file(Path::new("a"), text)),
            []
        );
    }
}
