//! Expands a scenario file with a `[matrix]` to its cases, and finds the file and the case that a
//! path or a name in records means.
//!
//! A case is the file without `[matrix]`, with values in place of the placeholders `{name}`. The
//! values keep their positions, so an error of a case points into the matrix.

use crate::input;
use crate::scenario::diagnostic::{Diagnostic, suggestion};
use crate::scenario::parse::{parse_syntax, read_text};
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use toml::Spanned;
use toml::de::{DeArray, DeTable, DeValue};

const MATRIX: &str = "matrix";
/// Table with the values of all cases that neither an axis nor a row sets.
const DEFAULT: &str = "default";
/// Table with one row per case.
const CASE: &str = "case";
/// Value that leaves out a key.
const LEFT_OUT: &str = "-";
/// Keys without which an element of `[[expect]]` or `[[fault]]` has no meaning. If a case leaves
/// one out, it leaves out the element.
const NEEDED_KEYS: [&str; 5] = ["at_most", "at_least", "within", "about", "kind"];
const MAX_CASES: usize = 1_000;

type Document<'a> = Spanned<DeTable<'a>>;
type Cell<'a> = Spanned<DeValue<'a>>;
/// Values of a case by the name of their placeholder.
type Cells<'a> = BTreeMap<String, Cell<'a>>;

/// Text of a scenario file and, if it has a `[matrix]`, the name of one case.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Source<'a> {
    pub(crate) path: &'a Path,
    pub(crate) text: &'a str,
    pub(crate) case: Option<&'a str>,
}

impl<'a> Source<'a> {
    pub(crate) const fn file(path: &'a Path, text: &'a str) -> Self {
        Self { path, text, case: None }
    }

    /// The parsed file, or the parsed case. Fails with all syntax errors or all errors of the
    /// matrix.
    pub(crate) fn document(&self) -> Result<Document<'a>, Vec<Diagnostic>> {
        let mut document = parse_syntax(self.path, self.text)?;
        if let Some(case) = self.case {
            let cells = Matrix::read(self, &document)?.into_iter().find(|(name, _)| name == case);
            document.get_mut().remove(MATRIX);
            let mut expansion = Expansion {
                source: *self,
                case,
                cells: cells.map_or_else(Cells::new, |(_, cells)| cells),
                problems: Vec::new(),
            };
            expansion.table(document.get_mut());
            if !expansion.problems.is_empty() {
                return Err(expansion.problems);
            }
        }
        Ok(document)
    }

    /// Points at a dotted key of the file or of the case, as [`Diagnostic::at_key`].
    pub(crate) fn diagnostic(&self, key: &str, message: impl Into<String>) -> Diagnostic {
        match self.case.and_then(|_| self.document().ok()) {
            Some(document) => Diagnostic::in_document(self.path, self.text, document.get_ref(), key, message),
            None => Diagnostic::at_key(self.path, self.text, key, message),
        }
    }

    fn at<T>(&self, span: &Spanned<T>, message: impl Into<String>) -> Diagnostic {
        Diagnostic::at_span(self.path, self.text, span.span(), message)
    }
}

/// A scenario file that was read, and its case.
#[derive(Debug, Clone)]
pub(crate) struct SourceFile {
    pub(crate) path: PathBuf,
    pub(crate) text: String,
    pub(crate) case: Option<String>,
}

impl SourceFile {
    /// `path` is a file, or the path of a case: `X-CASE.toml` for the file `X.toml`. `name` is the
    /// name in records. It selects the case if `path` is a file with a `[matrix]`.
    pub(crate) fn read(path: &Path, name: &str) -> Result<Self, Vec<Diagnostic>> {
        if let Some((path, case)) = find_case(path) {
            let text = read_text(&path).map_err(|problem| vec![problem])?;
            return Ok(Self { path, text, case: Some(case) });
        }
        let text = read_text(path).map_err(|problem| vec![problem])?;
        let Some(cases) = case_names(path, &text)? else {
            return Ok(Self { path: path.to_owned(), text, case: None });
        };
        if path == Path::new(input::STANDARD_STREAM) {
            let message = "a `[matrix]` on standard input, expected one scenario; name a file to play its cases";
            return Err(vec![Diagnostic::for_file(path, message)]);
        }
        let wanted = stem(Path::new(name)).strip_prefix(&format!("{}-", stem(path))).unwrap_or_default().to_owned();
        if !cases.contains(&wanted) {
            let message = format!("is a matrix, expected the name of a case: {}", cases.join(", "));
            return Err(vec![Diagnostic::for_file(path, message)]);
        }
        Ok(Self { path: path.to_owned(), text, case: Some(wanted) })
    }

    pub(crate) fn source(&self) -> Source<'_> {
        Source { path: &self.path, text: &self.text, case: self.case.as_deref() }
    }
}

/// Names of the cases of a file in their order; `None` without a `[matrix]`.
fn case_names(path: &Path, text: &str) -> Result<Option<Vec<String>>, Vec<Diagnostic>> {
    let document = parse_syntax(path, text)?;
    if !document.get_ref().contains_key(MATRIX) {
        return Ok(None);
    }
    let cases = Matrix::read(&Source::file(path, text), &document)?;
    Ok(Some(cases.into_iter().map(|(name, _)| name).collect()))
}

/// Names in records of the cases of the scenario file `path`, which has the name `name`. Only `name`
/// if the file has no matrix, or an error that loading it reports.
pub(crate) fn case_files(path: &Path, name: String) -> Vec<String> {
    let is_stream = path == Path::new(input::STANDARD_STREAM);
    let cases = (!is_stream).then(|| read_text(path).ok().and_then(|text| case_names(path, &text).ok().flatten()));
    match cases.flatten() {
        Some(cases) => cases.iter().map(|case| name_of_case(&name, case)).collect(),
        None => vec![name],
    }
}

pub(crate) fn name_of_case(name: &str, case: &str) -> String {
    format!("{}-{case}.toml", name.strip_suffix(".toml").unwrap_or(name))
}

/// Returns the file and the case of a path `X-CASE.toml` that does not exist.
pub(crate) fn find_case(path: &Path) -> Option<(PathBuf, String)> {
    let is_toml = path.extension().is_some_and(|extension| extension == "toml");
    if !is_toml || path.symlink_metadata().is_ok() {
        return None;
    }
    let stem = stem(path);
    let candidates = stem.rmatch_indices('-').filter_map(|(at, _)| Some((stem.get(..at)?, stem.get(at + 1..)?)));
    candidates.map(|(file, case)| (path.with_file_name(format!("{file}.toml")), case.to_owned())).find(
        |(file, case)| {
            // A case of a faulty matrix also counts, so that loading it reports the error.
            let cases = file.is_file().then(|| read_text(file).ok().map(|text| case_names(file, &text))).flatten();
            cases.is_some_and(|cases| cases.map_or(true, |cases| cases.is_some_and(|cases| cases.contains(case))))
        },
    )
}

/// True if `path` is a file or the path of a case.
pub fn is_scenario_path(path: &Path) -> bool {
    path.is_file() || find_case(path).is_some()
}

fn stem(path: &Path) -> Cow<'_, str> {
    path.file_stem().unwrap_or_default().to_string_lossy()
}

struct Axis<'a> {
    name: String,
    values: Vec<(String, Cells<'a>)>,
}

/// Reads the `[matrix]` of a document.
struct Matrix<'s, 'a> {
    source: &'s Source<'s>,
    problems: Vec<Diagnostic>,
    /// Names of all placeholders with a value, and where the first one is.
    known: BTreeMap<String, Spanned<()>>,
    axes: Vec<Axis<'a>>,
}

impl<'a> Matrix<'_, 'a> {
    /// Returns the cases with their values: all combinations of the axes, the last axis fastest, or
    /// the rows if there is no axis. Fails with all errors.
    fn read(source: &Source<'_>, document: &Document<'a>) -> Result<Vec<(String, Cells<'a>)>, Vec<Diagnostic>> {
        let mut matrix = Matrix { source, problems: Vec::new(), known: BTreeMap::new(), axes: Vec::new() };
        let cases = match document.get_ref().get_key_value(MATRIX) {
            Some((key, value)) => matrix.cases(key, value),
            None => Vec::new(),
        };
        matrix.check_names(document);
        matrix.problems.sort_by_key(Diagnostic::position);
        if matrix.problems.is_empty() { Ok(cases) } else { Err(matrix.problems) }
    }

    fn cases(&mut self, key: &Spanned<Cow<'_, str>>, value: &Cell<'a>) -> Vec<(String, Cells<'a>)> {
        let Some(table) = self.table(value, "axes and rows") else { return Vec::new() };
        let (mut defaults, mut rows) = (Cells::new(), Vec::new());
        for (name, value) in in_order(table) {
            match &**name.get_ref() {
                DEFAULT => defaults = self.cells(value),
                CASE => rows = self.rows(value),
                _ => {
                    let values = self.axis_values(name.get_ref(), value);
                    self.know(name.get_ref(), name.span());
                    self.axes.push(Axis { name: name.get_ref().to_string(), values });
                }
            }
        }
        let mut cases = self.combinations();
        if self.axes.is_empty() {
            cases = rows.iter().map(|(name, _)| (name.get_ref().clone(), Cells::new())).collect();
        } else if let Some((name, _)) =
            rows.iter().find(|(name, _)| !cases.iter().any(|(case, _)| case == name.get_ref()))
        {
            let hint = suggestion(name.get_ref(), cases.iter().map(|(case, _)| case.as_str()));
            let message = format!("unknown case `{}`, expected a combination of the axes{hint}", name.get_ref());
            self.problems.push(self.source.at(name, message));
        }
        for (name, cells) in &mut cases {
            let row = rows.iter().find(|(row, _)| row.get_ref() == name);
            cells.extend(row.map(|(_, row)| row.clone()).unwrap_or_default());
            let missing: Vec<_> = defaults.iter().filter(|(name, _)| !cells.contains_key(*name)).collect();
            cells.extend(missing.into_iter().map(|(name, cell)| (name.clone(), cell.clone())));
        }
        let mut known = BTreeSet::new();
        if cases.is_empty() || cases.len() > MAX_CASES {
            let message = format!("`{MATRIX}` has {} cases, expected 1 to {MAX_CASES}", cases.len());
            self.problems.push(self.source.at(key, message));
        } else if let Some((name, _)) = cases.iter().find(|(name, _)| !known.insert(name)) {
            let message = format!("`{MATRIX}` has several cases `{name}`, expected cases with different names");
            self.problems.push(self.source.at(key, message));
        }
        cases
    }

    fn combinations(&self) -> Vec<(String, Cells<'a>)> {
        let mut cases = vec![(String::new(), Cells::new())];
        for axis in &self.axes {
            if cases.len().saturating_mul(axis.values.len()) > MAX_CASES * MAX_CASES {
                break;
            }
            let with = |(name, cells): &(String, Cells<'a>), (value, more): &(String, Cells<'a>)| {
                let name = if name.is_empty() { value.clone() } else { format!("{name}-{value}") };
                (name, cells.clone().into_iter().chain(more.clone()).collect())
            };
            cases = cases.iter().flat_map(|case| axis.values.iter().map(|value| with(case, value))).collect();
        }
        cases
    }

    /// An axis is a list of values, or a table of names with values for other placeholders.
    fn axis_values(&mut self, axis: &str, value: &Cell<'a>) -> Vec<(String, Cells<'a>)> {
        let mut values = Vec::new();
        if let DeValue::Array(elements) = value.get_ref() {
            for element in elements {
                let name = self.text_of(element).unwrap_or_default();
                self.check_case_name(&name, element);
                values.push((name, Cells::from([(axis.to_owned(), element.clone())])));
            }
        } else if let Some(table) = self.table(value, "a list of values or a table of names") {
            for (name, value) in in_order(table) {
                self.check_case_name(name.get_ref(), name);
                let mut cells = self.cells(value);
                let own = DeValue::String(Cow::Owned(name.get_ref().to_string()));
                cells.insert(axis.to_owned(), Spanned::new(name.span(), own));
                values.push((name.get_ref().to_string(), cells));
            }
        }
        values
    }

    fn rows(&mut self, value: &Cell<'a>) -> Vec<(Spanned<String>, Cells<'a>)> {
        let Some(table) = self.table(value, "a row for each case") else { return Vec::new() };
        let mut rows = Vec::new();
        for (name, value) in in_order(table) {
            self.check_case_name(name.get_ref(), name);
            rows.push((Spanned::new(name.span(), name.get_ref().to_string()), self.cells(value)));
        }
        rows
    }

    fn cells(&mut self, value: &Cell<'a>) -> Cells<'a> {
        let Some(table) = self.table(value, "values by the name of their placeholder") else { return Cells::new() };
        for name in table.keys() {
            self.know(name.get_ref(), name.span());
        }
        table.iter().map(|(name, value)| (name.get_ref().to_string(), value.clone())).collect()
    }

    fn know(&mut self, name: &str, span: std::ops::Range<usize>) {
        self.known.entry(name.to_owned()).or_insert_with(|| Spanned::new(span, ()));
    }

    fn table<'v>(&mut self, value: &'v Cell<'a>, expected: &str) -> Option<&'v DeTable<'a>> {
        let table = value.get_ref().as_table();
        if table.is_none() {
            self.problems.push(self.source.at(value, format!("expected {expected}")));
        }
        table
    }

    /// Text of a name or a number as written.
    fn text_of(&self, value: &Cell<'_>) -> Option<String> {
        text_of_cell(self.source, value)
    }

    /// The name of a case is part of the names of files.
    fn check_case_name<T>(&mut self, name: &str, place: &Spanned<T>) {
        let is_allowed = |letter: char| letter.is_ascii_alphanumeric() || matches!(letter, '-' | '_' | '.');
        if name.is_empty() || !name.chars().all(is_allowed) {
            let message = format!("`{name}` is part of the name of a case, expected letters, digits, `-`, `_` and `.`");
            self.problems.push(self.source.at(place, message));
        }
    }

    /// Reports placeholders without a value in any case, and values without a placeholder.
    fn check_names(&mut self, document: &Document<'_>) {
        let mut used = BTreeSet::new();
        for (key, value) in document.get_ref() {
            if key.get_ref() != MATRIX {
                self.collect(value, &mut used);
            }
        }
        // The values of an axis may serve its other placeholders only.
        let unused = |name: &&String| !used.contains(*name) && !self.axes.iter().any(|axis| axis.name == **name);
        let unused: Vec<_> = self.known.keys().filter(unused).cloned().collect();
        for name in unused {
            if let Some(place) = self.known.get(&name) {
                let message = format!("unused value `{name}`, expected `{{{name}}}` in the scenario");
                self.problems.push(self.source.at(place, message));
            }
        }
    }

    fn collect(&mut self, value: &Cell<'_>, used: &mut BTreeSet<String>) {
        match value.get_ref() {
            DeValue::Table(table) => table.iter().for_each(|(_, value)| self.collect(value, used)),
            DeValue::Array(elements) => elements.iter().for_each(|value| self.collect(value, used)),
            DeValue::String(text) => {
                for (_, name) in placeholders(text) {
                    if !self.known.contains_key(name) {
                        let hint = suggestion(name, self.known.keys().map(String::as_str));
                        let message =
                            format!("unknown placeholder `{{{name}}}`, expected a name in `[{MATRIX}]`{hint}");
                        self.problems.push(self.source.at(value, message));
                    }
                    used.insert(name.to_owned());
                }
            }
            _ => {}
        }
    }
}

/// Replaces the placeholders of a document by the values of one case.
struct Expansion<'s, 'a> {
    source: Source<'s>,
    case: &'s str,
    cells: Cells<'a>,
    problems: Vec<Diagnostic>,
}

impl<'a> Expansion<'_, 'a> {
    /// Returns true if the case leaves out one of [`NEEDED_KEYS`].
    fn table(&mut self, table: &mut DeTable<'a>) -> bool {
        let left_out: Vec<String> = table
            .iter_mut()
            .filter_map(|(key, value)| (!self.value(value)).then(|| key.get_ref().to_string()))
            .collect();
        for key in &left_out {
            table.remove(&**key);
        }
        left_out.iter().any(|key| NEEDED_KEYS.contains(&&**key))
    }

    /// Returns false if the case leaves out the value.
    fn value(&mut self, value: &mut Cell<'a>) -> bool {
        match value.get_mut() {
            DeValue::Table(table) => {
                self.table(table);
                true
            }
            DeValue::Array(elements) => {
                let all = std::mem::replace(elements, DeArray::new());
                *elements = all.into_iter().filter_map(|element| self.element(element)).collect();
                true
            }
            DeValue::String(text) => {
                let text = text.clone();
                self.text(&text, value)
            }
            _ => true,
        }
    }

    fn element(&mut self, mut element: Cell<'a>) -> Option<Cell<'a>> {
        let stays = match element.get_mut() {
            DeValue::Table(table) => !self.table(table),
            _ => self.value(&mut element),
        };
        stays.then_some(element)
    }

    fn text(&mut self, text: &str, value: &mut Cell<'a>) -> bool {
        let mut filled = String::new();
        let mut end = 0;
        for (start, name) in placeholders(text) {
            let Some(cell) = self.cells.get(name) else {
                let message = format!(
                    "`{{{name}}}` has no value in the case `{}`, expected one in `[{MATRIX}.{CASE}]`, an axis or \
                     `[{MATRIX}.{DEFAULT}]`; \"{LEFT_OUT}\" leaves out the key",
                    self.case
                );
                self.problems.push(self.source.at(value, message));
                return true;
            };
            if matches!(cell.get_ref(), DeValue::String(text) if text == LEFT_OUT) {
                return false;
            }
            let after = start + name.len() + 2;
            if start == 0 && after == text.len() {
                *value = cell.clone();
                return true;
            }
            let Some(part) = text_of_cell(&self.source, cell) else {
                self.problems
                    .push(self.source.at(cell, format!("`{name}` is part of a text, expected a text or a number")));
                return true;
            };
            filled.push_str(text.get(end..start).unwrap_or_default());
            filled.push_str(&part);
            end = after;
        }
        if end > 0 {
            filled.push_str(text.get(end..).unwrap_or_default());
            *value.get_mut() = DeValue::String(Cow::Owned(filled));
        }
        true
    }
}

/// Positions and names of the placeholders `{name}` of a text.
fn placeholders(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.match_indices('{').filter_map(|(start, _)| {
        let (name, _) = text.get(start + 1..)?.split_once('}')?;
        let is_name = |letter: char| letter.is_ascii_alphanumeric() || matches!(letter, '-' | '_');
        (!name.is_empty() && name.chars().all(is_name)).then_some((start, name))
    })
}

fn text_of_cell(source: &Source<'_>, value: &Cell<'_>) -> Option<String> {
    match value.get_ref() {
        DeValue::String(text) => Some(text.to_string()),
        DeValue::Integer(_) | DeValue::Float(_) => source.text.get(value.span()).map(str::to_owned),
        _ => None,
    }
}

/// Entries in the order of the file.
fn in_order<'t, 'a>(table: &'t DeTable<'a>) -> Vec<(&'t Spanned<Cow<'a, str>>, &'t Cell<'a>)> {
    let mut entries: Vec<_> = table.iter().collect();
    entries.sort_by_key(|(name, _)| name.span().start);
    entries
}

#[cfg(test)]
mod tests;
