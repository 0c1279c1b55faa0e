//! Lists the SHA-256 of every file of a record except the manifest and its signature, in the format
//! of `sha256sum -c`.

use crate::acceptance::error::AcceptError;
use crate::acceptance::session_record::write_file;
use crate::acceptance::signature;
use platebench_model::record::sha256_of_file;
use platebench_model::trace::{AtPath, FileError};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;
use std::{fs, io};

pub const FILE: &str = "manifest.sha256";
const MAX_DEPTH: usize = 32;
/// Largest manifest, about half a million files.
pub(crate) const MAX_BYTES: u64 = 64 << 20;

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Difference {
    #[error("{0}: changed, its SHA-256 is not the one in the manifest")]
    Changed(String),
    #[error("{0}: missing, the manifest names it")]
    Missing(String),
    #[error("{0}: added, or its line was removed from the manifest")]
    Added(String),
    #[error("{0} cannot be sealed: expected a file or a folder, with a UTF-8 name and at most 32 folders deep")]
    UnsupportedEntry(String),
    #[error("{0}: cannot be read: {1}")]
    Unreadable(String, String),
    #[error(
        "{FILE}:{0}: not a line of a manifest, expected 64 hexadecimal digits, two spaces and a file below the record, \
         each once and in order"
    )]
    Line(usize),
}

pub(crate) fn write(folder: &Path) -> Result<(), AcceptError> {
    let mut found = FolderContents::default();
    found.collect_below(folder, "", 0);
    if let Some((name, what)) = found.not_files.first_key_value() {
        return Err(FileError { path: folder.join(name), source: io::Error::other(what.to_string()) }.into());
    }
    let mut text = String::new();
    for name in &found.files {
        if name.contains(['\\', '\n', '\r']) {
            let message = "sha256sum escapes this name, expected a name without \\ and line breaks";
            return Err(FileError { path: folder.join(name), source: io::Error::other(message) }.into());
        }
        let path = folder.join(name);
        let _ = writeln!(text, "{}  {name}", sha256_of_file(&path).at(&path)?);
    }
    Ok(write_file(folder, FILE, text.as_bytes())?)
}

pub(crate) fn check(folder: &Path, text: &str) -> Vec<Difference> {
    let mut differences = Vec::new();
    let mut listed: BTreeMap<&str, &str> = BTreeMap::new();
    let mut last = None;
    for (number, line) in text.split_inclusive('\n').enumerate() {
        match parse_line(line).filter(|(_, name)| last.is_none_or(|last| last < *name)) {
            Some((hash, name)) => {
                listed.insert(name, hash);
                last = Some(name);
            }
            None => differences.push(Difference::Line(number + 1)),
        }
    }
    let mut found = FolderContents::default();
    found.collect_below(folder, "", 0);
    differences.extend(found.not_files.into_values());
    for name in &found.files {
        match (listed.get(name.as_str()), sha256_of_file(&folder.join(name))) {
            (None, _) => differences.push(Difference::Added(name.clone())),
            (Some(_), Err(error)) => differences.push(Difference::Unreadable(name.clone(), error.to_string())),
            (Some(hash), Ok(found)) if found != *hash => differences.push(Difference::Changed(name.clone())),
            (Some(_), Ok(_)) => {}
        }
    }
    let missing = listed.keys().filter(|name| !found.files.contains(**name));
    differences.extend(missing.map(|name| Difference::Missing((*name).to_owned())));
    differences
}

/// Returns hash and file name. `None` if the line is invalid or the name leads out of the record.
fn parse_line(line: &str) -> Option<(&str, &str)> {
    let (hash, name) = line.strip_suffix('\n')?.split_once("  ")?;
    let is_hash = hash.len() == 64 && hash.bytes().all(|digit| matches!(digit, b'0'..=b'9' | b'a'..=b'f'));
    let is_inside = name.split('/').all(|part| !matches!(part, "" | "." | ".."));
    (is_hash && is_inside).then_some((hash, name))
}

#[derive(Default)]
struct FolderContents {
    files: BTreeSet<String>,
    not_files: BTreeMap<String, Difference>,
}

impl FolderContents {
    fn collect_below(&mut self, folder: &Path, prefix: &str, depth: usize) {
        let entries = match fs::read_dir(folder).and_then(Iterator::collect::<io::Result<Vec<_>>>) {
            Ok(entries) => entries,
            Err(error) => {
                let name = if prefix.is_empty() { "." } else { prefix.trim_end_matches('/') };
                self.not_files.insert(name.to_owned(), Difference::Unreadable(name.to_owned(), error.to_string()));
                return;
            }
        };
        for entry in entries {
            let Some(last) = entry.file_name().to_str().map(str::to_owned) else {
                let name = format!("{prefix}{}", entry.file_name().to_string_lossy());
                self.not_files.insert(name.clone(), Difference::UnsupportedEntry(name));
                continue;
            };
            let name = format!("{prefix}{last}");
            // `file_type` does not follow symbolic links, so a link is an unsupported entry.
            match entry.file_type() {
                Ok(kind) if kind.is_dir() && depth < MAX_DEPTH => {
                    self.collect_below(&entry.path(), &format!("{name}/"), depth + 1);
                }
                Ok(kind) if kind.is_file() => {
                    if name != FILE && name != signature::FILE {
                        self.files.insert(name);
                    }
                }
                _ => {
                    self.not_files.insert(name.clone(), Difference::UnsupportedEntry(name));
                }
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test that cannot go on ends by panicking")]
mod tests {
    use super::*;
    use platebench_model::record::sha256;
    use rstest::rstest;

    fn sealed_record() -> (tempfile::TempDir, String) {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("b")).unwrap();
        for (name, content) in [("a.txt", "one"), ("b/c.csv", "two"), ("b-d", "three")] {
            fs::write(folder.path().join(name), content).unwrap();
        }
        write(folder.path()).unwrap();
        let text = fs::read_to_string(folder.path().join(FILE)).unwrap();
        (folder, text)
    }

    #[test]
    fn an_unchanged_record_matches_its_manifest() {
        let (folder, text) = sealed_record();
        assert_eq!(text.lines().count(), 3);
        assert_eq!(check(folder.path(), &text), []);
        fs::write(folder.path().join(signature::FILE), "not listed").unwrap();
        assert_eq!(check(folder.path(), &text), []);
    }

    #[test]
    fn names_every_changed_file() {
        let (folder, text) = sealed_record();
        fs::write(folder.path().join("a.txt"), "onf").unwrap();
        fs::remove_file(folder.path().join("b/c.csv")).unwrap();
        fs::write(folder.path().join("b/new"), "").unwrap();
        std::os::unix::fs::symlink("a.txt", folder.path().join("link")).unwrap();
        let expected = [
            Difference::UnsupportedEntry("link".to_owned()),
            Difference::Changed("a.txt".to_owned()),
            Difference::Added("b/new".to_owned()),
            Difference::Missing("b/c.csv".to_owned()),
        ];
        assert_eq!(check(folder.path(), &text), expected);
    }

    #[test]
    fn reports_a_file_without_a_line_as_added() {
        let (folder, text) = sealed_record();
        let fewer: String = text.split_inclusive('\n').filter(|line| !line.ends_with("b-d\n")).collect();
        assert_eq!(check(folder.path(), &fewer), [Difference::Added("b-d".to_owned())]);
        let twice = text.clone() + text.lines().next().unwrap() + "\n";
        assert_eq!(check(folder.path(), &twice), [Difference::Line(4)]);
    }

    #[rstest]
    #[case::outside("../a")]
    #[case::root("/a")]
    #[case::nothing("")]
    #[case::here("./a")]
    fn rejects_a_line_with_a_path_outside_the_record(#[case] name: &str) {
        let hash = sha256(b"");
        assert_eq!(parse_line(&format!("{hash}  {name}\n")), None);
        assert_eq!(parse_line(&format!("{hash}  a/b c\n")), Some((hash.as_str(), "a/b c")));
        assert_eq!(parse_line(&format!("{hash}  a")), None, "an incomplete line");
        assert_eq!(parse_line(&format!("{}  a\n", hash.to_uppercase())), None);
    }
}
