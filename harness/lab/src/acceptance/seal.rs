//! Seals a record: the manifest lists the SHA-256 of every file except itself and its signature, in
//! the format of `sha256sum -c`. The signature of the manifest (ed25519, 64 raw bytes) is in
//! `manifest.sha256.sig`.
//!
//! Keys have the PEM formats of OpenSSL: PKCS #8 and SPKI. `openssl pkeyutl -verify -rawin` also
//! checks a signature.

use crate::acceptance::session_record::{AcceptError, write_file};
use ed25519_dalek::pkcs8::spki::der::pem::{LineEnding, decode_label};
use ed25519_dalek::pkcs8::{DecodePrivateKey, DecodePublicKey, EncodePublicKey};
use ed25519_dalek::{Signature, Signer as _, SigningKey, VerifyingKey};
use platebench_model::record::{sha256, sha256_of_file};
use platebench_model::trace::{AtPath, FileError, read_text_file};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;
use std::{fs, io};

pub const MANIFEST_FILE: &str = "manifest.sha256";
const MAX_DEPTH: usize = 32;
/// Largest manifest, about half a million files.
pub(crate) const MAX_MANIFEST_BYTES: u64 = 64 << 20;

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FileDifference {
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
        "{MANIFEST_FILE}:{0}: not a line of a manifest, expected 64 hexadecimal digits, two spaces and a file below the record, \
         each once and in order"
    )]
    Line(usize),
}

pub(crate) fn write_manifest(folder: &Path) -> Result<(), AcceptError> {
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
    Ok(write_file(folder, MANIFEST_FILE, text.as_bytes())?)
}

pub(crate) fn check_manifest(folder: &Path, text: &str) -> Vec<FileDifference> {
    let mut differences = Vec::new();
    let mut listed: BTreeMap<&str, &str> = BTreeMap::new();
    let mut last = None;
    for (number, line) in text.split_inclusive('\n').enumerate() {
        match parse_line(line).filter(|(_, name)| last.is_none_or(|last| last < *name)) {
            Some((hash, name)) => {
                listed.insert(name, hash);
                last = Some(name);
            }
            None => differences.push(FileDifference::Line(number + 1)),
        }
    }
    let mut found = FolderContents::default();
    found.collect_below(folder, "", 0);
    differences.extend(found.not_files.into_values());
    for name in &found.files {
        match (listed.get(name.as_str()), sha256_of_file(&folder.join(name))) {
            (None, _) => differences.push(FileDifference::Added(name.clone())),
            (Some(_), Err(error)) => differences.push(FileDifference::Unreadable(name.clone(), error.to_string())),
            (Some(hash), Ok(found)) if found != *hash => differences.push(FileDifference::Changed(name.clone())),
            (Some(_), Ok(_)) => {}
        }
    }
    let missing = listed.keys().filter(|name| !found.files.contains(**name));
    differences.extend(missing.map(|name| FileDifference::Missing((*name).to_owned())));
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
    not_files: BTreeMap<String, FileDifference>,
}

impl FolderContents {
    fn collect_below(&mut self, folder: &Path, prefix: &str, depth: usize) {
        let entries = match fs::read_dir(folder).and_then(Iterator::collect::<io::Result<Vec<_>>>) {
            Ok(entries) => entries,
            Err(error) => {
                let name = if prefix.is_empty() { "." } else { prefix.trim_end_matches('/') };
                self.not_files.insert(name.to_owned(), FileDifference::Unreadable(name.to_owned(), error.to_string()));
                return;
            }
        };
        for entry in entries {
            let Some(last) = entry.file_name().to_str().map(str::to_owned) else {
                let name = format!("{prefix}{}", entry.file_name().to_string_lossy());
                self.not_files.insert(name.clone(), FileDifference::UnsupportedEntry(name));
                continue;
            };
            let name = format!("{prefix}{last}");
            // `file_type` does not follow symbolic links, so a link is an unsupported entry.
            match entry.file_type() {
                Ok(kind) if kind.is_dir() && depth < MAX_DEPTH => {
                    self.collect_below(&entry.path(), &format!("{name}/"), depth + 1);
                }
                Ok(kind) if kind.is_file() => {
                    if name != MANIFEST_FILE && name != SIGNATURE_FILE {
                        self.files.insert(name);
                    }
                }
                _ => {
                    self.not_files.insert(name.clone(), FileDifference::UnsupportedEntry(name));
                }
            }
        }
    }
}

pub const SIGNATURE_FILE: &str = "manifest.sha256.sig";
/// Largest file of a key. A PEM of ed25519 has about 120 bytes.
const MAX_KEY_BYTES: u64 = 64 << 10;

#[derive(Clone)]
pub struct SecretKey(SigningKey);

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PublicKey(VerifyingKey);

impl SecretKey {
    pub fn read(path: &Path) -> Result<Self, AcceptError> {
        let text = read_text_file(path, MAX_KEY_BYTES).at(path)?;
        SigningKey::from_pkcs8_pem(&text).map(Self).map_err(|error| key_error(path, &text, &error.to_string()))
    }

    pub fn public_key(&self) -> PublicKey {
        PublicKey(self.0.verifying_key())
    }

    pub(crate) fn sign(&self, content: &[u8]) -> [u8; Signature::BYTE_SIZE] {
        self.0.sign(content).to_bytes()
    }
}

impl std::fmt::Debug for SecretKey {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_tuple("SecretKey").field(&self.public_key().fingerprint()).finish()
    }
}

impl PublicKey {
    pub fn read(path: &Path) -> Result<Self, AcceptError> {
        let text = read_text_file(path, MAX_KEY_BYTES).at(path)?;
        VerifyingKey::from_public_key_pem(&text).map(Self).map_err(|error| key_error(path, &text, &error.to_string()))
    }

    pub(crate) fn from_pem(text: &str) -> Option<Self> {
        VerifyingKey::from_public_key_pem(text).ok().map(Self)
    }

    pub(crate) fn to_pem(&self) -> String {
        self.0.to_public_key_pem(LineEnding::LF).unwrap_or_default()
    }

    /// Returns the SHA-256 of the 32 bytes of the key, hexadecimal.
    pub fn fingerprint(&self) -> String {
        sha256(self.0.as_bytes())
    }

    /// Rejects weak keys, because one signature of a weak key is valid for many messages.
    pub(crate) fn verifies(&self, content: &[u8], signature: &[u8]) -> bool {
        Signature::from_slice(signature).is_ok_and(|signature| self.0.verify_strict(content, &signature).is_ok())
    }
}

fn key_error(path: &Path, text: &str, error: &str) -> AcceptError {
    let path_text = path.display();
    let message = match decode_label(text.as_bytes()) {
        Ok("PRIVATE KEY") if SigningKey::from_pkcs8_pem(text).is_ok() => {
            format!(
                "this is the secret key, expected the public key, as `openssl pkey -in {path_text} -pubout` writes it"
            )
        }
        Ok("PUBLIC KEY") if PublicKey::from_pem(text).is_some() => {
            "this is the public key, expected the secret key".to_owned()
        }
        Ok("ENCRYPTED PRIVATE KEY") => {
            format!("this secret key has a passphrase, expected one without; `openssl pkey -in {path_text}` removes it")
        }
        _ => error.to_owned(),
    };
    AcceptError::Key { path: path.to_owned(), message }
}

#[cfg(test)]
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
        write_manifest(folder.path()).unwrap();
        let text = fs::read_to_string(folder.path().join(MANIFEST_FILE)).unwrap();
        (folder, text)
    }

    #[test]
    fn an_unchanged_record_matches_its_manifest() {
        let (folder, text) = sealed_record();
        assert_eq!(text.lines().count(), 3);
        assert_eq!(check_manifest(folder.path(), &text), []);
        fs::write(folder.path().join(SIGNATURE_FILE), "not listed").unwrap();
        assert_eq!(check_manifest(folder.path(), &text), []);
    }

    #[test]
    fn names_every_changed_file() {
        let (folder, text) = sealed_record();
        fs::write(folder.path().join("a.txt"), "onf").unwrap();
        fs::remove_file(folder.path().join("b/c.csv")).unwrap();
        fs::write(folder.path().join("b/new"), "").unwrap();
        std::os::unix::fs::symlink("a.txt", folder.path().join("link")).unwrap();
        let expected = [
            FileDifference::UnsupportedEntry("link".to_owned()),
            FileDifference::Changed("a.txt".to_owned()),
            FileDifference::Added("b/new".to_owned()),
            FileDifference::Missing("b/c.csv".to_owned()),
        ];
        assert_eq!(check_manifest(folder.path(), &text), expected);
    }

    #[test]
    fn reports_a_file_without_a_line_as_added() {
        let (folder, text) = sealed_record();
        let fewer: String = text.split_inclusive('\n').filter(|line| !line.ends_with("b-d\n")).collect();
        assert_eq!(check_manifest(folder.path(), &fewer), [FileDifference::Added("b-d".to_owned())]);
        let twice = text.clone() + text.lines().next().unwrap() + "\n";
        assert_eq!(check_manifest(folder.path(), &twice), [FileDifference::Line(4)]);
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
