//! Collects the problems of an input file. Scenarios have further places: a matrix and tables.

use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::parse::parse_file;
use schemars::JsonSchema;
use serde::de::DeserializeOwned;
use std::path::{Path, PathBuf};

#[derive(Debug)]
pub struct FileChecker {
    path: PathBuf,
    text: String,
    problems: Vec<Diagnostic>,
}

impl FileChecker {
    /// Also returns the content. Fails with all syntax errors, all wrong keys or all numbers outside
    /// their bounds, or if the file cannot be read.
    pub fn read<T: DeserializeOwned + JsonSchema>(path: &Path) -> Result<(Self, T), Vec<Diagnostic>> {
        let (text, raw) = parse_file(path)?;
        Ok((Self { path: path.to_owned(), text, problems: Vec::new() }, raw))
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn text(&self) -> &str {
        &self.text
    }

    /// `file` as the checked file names it, relative to its own folder.
    pub fn neighbour(&self, file: &Path) -> PathBuf {
        self.path.parent().unwrap_or(Path::new("")).join(file)
    }

    /// `key` is a dotted path such as `board.0.name`.
    pub fn problem(&self, key: &str, message: impl Into<String>) -> Diagnostic {
        Diagnostic::at_key(&self.path, &self.text, key, message)
    }

    pub fn report(&mut self, key: &str, message: impl Into<String>) {
        self.problems.push(self.problem(key, message));
    }

    pub fn require(&mut self, holds: bool, key: &str, message: impl FnOnce() -> String) {
        if !holds {
            self.report(key, message());
        }
    }

    pub fn require_one_line(&mut self, key: &str, text: &str) {
        self.problems.extend(not_one_line(text).map(|message| self.problem(key, message)));
    }

    /// Returns the value, or adds the problem.
    pub fn accept_one<T>(&mut self, result: Result<T, Diagnostic>) -> Option<T> {
        self.accept(result.map_err(|problem| [problem]))
    }

    /// Returns the value, or adds the problems.
    pub fn accept<T>(&mut self, result: Result<T, impl IntoIterator<Item = Diagnostic>>) -> Option<T> {
        result.map_err(|problems| self.problems.extend(problems)).ok()
    }

    pub fn extend(&mut self, problems: impl IntoIterator<Item = Diagnostic>) {
        self.problems.extend(problems);
    }

    pub fn has_problems(&self) -> bool {
        !self.problems.is_empty()
    }

    pub fn into_problems(self) -> Vec<Diagnostic> {
        self.problems
    }

    /// Returns the text of the file, or all problems.
    pub fn finish(self) -> Result<String, Vec<Diagnostic>> {
        if self.problems.is_empty() { Ok(self.text) } else { Err(self.problems) }
    }
}

/// Returns a message if `text` is not one line.
pub(super) fn not_one_line(text: &str) -> Option<String> {
    let is_one_line = !text.trim().is_empty() && !text.contains(char::is_control);
    (!is_one_line).then(|| format!("{text:?}, expected one line of text"))
}
