//! Recognises the kind of a TOML file.

use crate::requirements::REQUIREMENTS_FILE;
use platebench_plate::input;
use std::path::Path;
use toml::de::DeTable;

pub const SETTINGS_FILE: &str = "platebench.toml";

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, strum::IntoStaticStr)]
#[strum(const_into_str, serialize_all = "lowercase")]
pub enum FileKind {
    Scenario,
    Plate,
    Plan,
    Envelope,
    Campaign,
    #[strum(serialize = "settings file")]
    Config,
    #[strum(serialize = "board inventory")]
    Boards,
    #[strum(serialize = "list of requirements")]
    Requirements,
}

/// The first entry with a top-level key of the file determines the kind of the file.
const KEYS: [(FileKind, &[&str]); 6] = [
    (FileKind::Scenario, &["profile", "expect", "controller"]),
    (FileKind::Plan, &["requirement", "ask", "bench"]),
    (FileKind::Boards, &["board"]),
    (FileKind::Envelope, &["range"]),
    (FileKind::Campaign, &["vary", "scenario", "plan"]),
    (FileKind::Plate, &["mode", "drive", "sensor"]),
];

impl FileKind {
    /// A file that cannot be read counts as a scenario, whose reader reports the error.
    pub fn detect(path: &Path) -> Self {
        if path.file_name().is_some_and(|name| name == SETTINGS_FILE) {
            return Self::Config;
        }
        if path.file_name().is_some_and(|name| name == REQUIREMENTS_FILE) {
            return Self::Requirements;
        }
        let text = input::read(path).map(|content| String::from_utf8_lossy(&content).into_owned()).unwrap_or_default();
        let (document, _) = DeTable::parse_recoverable(&text);
        let has = |key: &&str| document.get_ref().contains_key(*key);
        let kind = KEYS.iter().find(|(_, keys)| keys.iter().any(has));
        kind.map_or(Self::Scenario, |(kind, _)| *kind)
    }

    pub const fn name(self) -> &'static str {
        self.into_str()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_keys_of_a_file_decide_its_kind() {
        let folder = tempfile::tempdir().unwrap();
        for (text, kind) in [
            ("title = \"a\"", FileKind::Scenario),
            ("[profile]", FileKind::Scenario),
            ("scenario = \"a.toml\"", FileKind::Campaign),
            ("[vary]", FileKind::Campaign),
            ("[plan]", FileKind::Campaign),
            ("[range]", FileKind::Envelope),
            ("[bench]", FileKind::Plan),
            ("[[board]]", FileKind::Boards),
            ("[mode]", FileKind::Plate),
        ] {
            let path = folder.path().join("file.toml");
            std::fs::write(&path, text).unwrap();
            assert_eq!(FileKind::detect(&path), kind, "{text}");
        }
    }
}
