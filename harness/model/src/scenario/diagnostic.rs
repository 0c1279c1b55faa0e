//! Reports an error of an input file with its position.

use annotate_snippets::{AnnotationKind, Level, Renderer, Snippet};
use std::fmt;
use std::ops::Range;
use std::path::{Path, PathBuf};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

const SERDE_WORDS: [(&str, &str); 12] = [
    ("unknown field", "unknown key"),
    ("unknown variant", "unknown name"),
    ("wanted exactly 1 element, found 0 elements", "no key, expected one"),
    ("wanted exactly 1 element, more than 1 element", "several keys, expected one"),
    ("wanted string or table", "expected a table"),
    ("an array of length 2", "2 numbers"),
    ("path string", "a path"),
    ("missing field", "missing key"),
    ("expected f64", "expected a number"),
    ("expected i64", "expected a whole number"),
    ("floating point", "the number"),
    ("a sequence", "a list"),
];

/// Largest number of reported errors of a file. It limits the time, because each error of a key
/// requires another pass over the whole file.
pub(crate) const MAX_DIAGNOSTICS: usize = 50;

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Diagnostic {
    pub path: PathBuf,
    /// Text of the file. It is empty if the file was not read.
    source: String,
    span: Range<usize>,
    pub message: String,
}

impl Diagnostic {
    pub fn for_file(path: &Path, message: impl Into<String>) -> Self {
        Self { path: path.to_owned(), source: String::new(), span: 0..0, message: message.into() }
    }

    pub fn at_span(path: &Path, source: &str, span: Range<usize>, message: impl Into<String>) -> Self {
        Self { path: path.to_owned(), source: source.to_owned(), span, message: message.into() }
    }

    /// `key` is a dotted path such as `expect.0.metric`. If the file does not contain the key, the
    /// diagnostic points at its nearest parent. The message starts with the name of the key, unless
    /// it contains that name.
    pub fn at_key(path: &Path, source: &str, key: &str, message: impl Into<String>) -> Self {
        let span = DeTable::parse(source).map_or(0..0, |document| span_of_key(document.get_ref(), key));
        Self::with_key(path, source, span, key, message)
    }

    /// Like [`Self::at_key`], with the key in `document`, whose spans are those of `source`.
    pub(crate) fn in_document(
        path: &Path,
        source: &str,
        document: &DeTable<'_>,
        key: &str,
        message: impl Into<String>,
    ) -> Self {
        Self::with_key(path, source, span_of_key(document, key), key, message)
    }

    fn with_key(path: &Path, source: &str, span: Range<usize>, key: &str, message: impl Into<String>) -> Self {
        let message = message.into();
        let name = name_of_key(key);
        let mut words = message.split(|letter: char| !letter.is_alphanumeric() && letter != '_');
        let message = if words.any(|word| word == name) { message } else { format!("`{name}`: {message}") };
        Self::at_span(path, source, span, message)
    }

    pub fn from_toml(path: &Path, source: &str, error: &toml::de::Error) -> Self {
        let span = error.span().unwrap_or(0..0);
        let mut message = error.message().trim().to_owned();
        for (serde, ours) in SERDE_WORDS {
            message = message.replace(serde, ours);
        }
        // serde names the type of the reader.
        if let Some((found, _)) = message.split_once("expected struct ") {
            message = format!("{found}expected a table");
        }
        // serde quotes the unknown key and all known ones in backticks.
        let mut quoted = message.split('`').skip(1).step_by(2);
        let hint = match quoted.next() {
            Some(name) if message.starts_with("unknown ") => suggestion(name, quoted),
            _ => String::new(),
        };
        Self::at_span(path, source, span, format!("{message}{hint}"))
    }

    /// Line and column, counted from 1. Columns count characters.
    pub fn position(&self) -> (usize, usize) {
        let before = self.source.get(..self.span.start).unwrap_or_default();
        let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
        let column = before.get(line_start..).unwrap_or_default().chars().count() + 1;
        (before.matches('\n').count() + 1, column)
    }

    pub fn location(&self) -> Option<(usize, usize)> {
        (!self.source.is_empty()).then(|| self.position())
    }

    pub fn render(&self, colour: bool) -> String {
        let path = self.path.display().to_string();
        if self.source.is_empty() {
            return format!("error: {path}: {}", self.message);
        }
        let renderer = if colour { Renderer::styled() } else { Renderer::plain() };
        // The renderer cannot draw an empty span or a span that ends within a character.
        let boundary = |from: usize| (from..=self.source.len()).find(|at| self.source.is_char_boundary(*at));
        let end = self.span.end.max(self.span.start + 1);
        let span = self.span.start..boundary(end).unwrap_or(self.source.len());
        let annotation = AnnotationKind::Primary.span(span);
        let snippet = Snippet::source(&self.source).path(path).annotation(annotation);
        renderer.render(&[Level::ERROR.primary_title(&self.message).element(snippet)])
    }
}

impl fmt::Display for Diagnostic {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.source.is_empty() {
            return write!(formatter, "{}: {}", self.path.display(), self.message);
        }
        let (line, column) = self.position();
        write!(formatter, "{}:{line}:{column}: {}", self.path.display(), self.message)
    }
}

impl std::error::Error for Diagnostic {}

/// Returns `; did you mean …?` if a known name is similar or names the same quantity in another
/// unit, otherwise an empty text.
pub fn suggestion<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> String {
    let known: Vec<_> = known.into_iter().collect();
    let quantity = |name: &'a str| name.rsplit_once('_').filter(|(_, unit)| UNITS.contains(unit));
    let same = known.iter().filter_map(|known| Some((known, quantity(known)?)));
    let mut same = same.filter(|(known, (quantity, _))| {
        let unit = name.strip_prefix(quantity).map(|rest| rest.strip_prefix('_').unwrap_or(rest));
        unit.is_some_and(|unit| unit.is_empty() || FOREIGN_UNITS.contains(&unit) || UNITS.contains(&unit))
            && name != **known
    });
    if let (Some((known, (_, unit))), None) = (same.next(), same.next()) {
        return format!("; did you mean `{known}`, in {}?", unit_symbol(unit));
    }
    let rated = known.into_iter().map(|known| (closeness(name, known), known));
    match rated.filter(|(closeness, _)| *closeness >= CLOSE).max_by(|a, b| a.0.total_cmp(&b.0)) {
        Some((_, known)) => format!("; did you mean `{known}`?"),
        None => String::new(),
    }
}

/// Least closeness of a name that a message suggests.
pub(crate) const CLOSE: f64 = 0.85;

/// Returns a value from 0 to 1. Equal names have 1.
pub(crate) fn closeness(name: &str, known: &str) -> f64 {
    strsim::jaro_winkler(name, known)
}

const UNITS: [&str; 9] = ["ms", "us", "um", "hz", "k", "c", "n", "vpp", "percent"];
const FOREIGN_UNITS: [&str; 24] = [
    "s", "sec", "seconds", "min", "ns", "m", "mm", "nm", "micron", "khz", "mhz", "rad", "mn", "newton", "v", "mv",
    "volt", "volts", "kelvin", "celsius", "degc", "pct", "ratio", "rms",
];

/// Symbol of the unit in the last name of a dotted key. `None` for a quotient of units, or without
/// a unit.
pub(crate) fn unit_of_key(key: &str) -> Option<&str> {
    let (quantity, unit) = name_of_key(key).rsplit_once('_')?;
    (UNITS.contains(&unit) && !quantity.contains("_per")).then(|| unit_symbol(unit))
}

fn name_of_key(key: &str) -> &str {
    key.rsplit('.').find(|part| part.parse::<usize>().is_err()).unwrap_or(key)
}

fn unit_symbol(unit: &str) -> &str {
    match unit {
        "us" => "µs",
        "um" => "µm",
        "hz" => "Hz",
        "k" => "K",
        "c" => "°C",
        "n" => "N",
        "vpp" => "Vpp",
        "percent" => "%",
        other => other,
    }
}

fn span_of_key(document: &DeTable<'_>, key: &str) -> Range<usize> {
    let (mut span, mut found) = (0..0, find_entry(document, key));
    while let Some((value, rest)) = found {
        span = value.span();
        found = match value.get_ref() {
            DeValue::Table(table) => find_entry(table, rest),
            DeValue::Array(array) => {
                let (index, rest) = rest.split_once('.').unwrap_or((rest, ""));
                index.parse().ok().and_then(|index: usize| Some((array.get(index)?, rest)))
            }
            _ => None,
        };
    }
    span
}

/// The value of the first names of `key`, and the other names. A name in the file may contain dots,
/// as below `[vary]`.
fn find_entry<'a, 'i, 'k>(table: &'a DeTable<'i>, key: &'k str) -> Option<(&'a Spanned<DeValue<'i>>, &'k str)> {
    let mut ends = key.match_indices('.').map(|(end, _)| end).chain([key.len()]);
    ends.find_map(|end| Some((table.get(key.get(..end)?)?, key.get(end + 1..).unwrap_or(""))))
}
