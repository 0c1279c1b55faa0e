//! Recognises the kind of a TOML file.

use crate::requirements::REQUIREMENTS_FILE;
use platebench_plate::input;
use std::path::Path;
use toml::de::DeTable;

pub const SETTINGS_FILE: &str = "platebench.toml";

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum FileKind {
    Scenario,
    Plate,
    Plan,
    Envelope,
    Campaign,
    Config,
    Boards,
    Requirements,
}

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
        let has = |keys: &[&str]| keys.iter().any(|key| document.get_ref().contains_key(*key));
        if has(&["profile", "expect", "controller"]) {
            Self::Scenario
        } else if has(&["requirement", "ask", "bench"]) {
            Self::Plan
        } else if has(&["board"]) {
            Self::Boards
        } else if has(&["range"]) {
            Self::Envelope
        } else if has(&["vary", "scenario", "plan"]) {
            Self::Campaign
        } else if has(&["mode", "drive", "sensor"]) {
            Self::Plate
        } else {
            Self::Scenario
        }
    }

    pub const fn name(self) -> &'static str {
        match self {
            Self::Scenario => "scenario",
            Self::Plate => "plate",
            Self::Plan => "plan",
            Self::Envelope => "envelope",
            Self::Campaign => "campaign",
            Self::Config => "settings file",
            Self::Boards => "board inventory",
            Self::Requirements => "list of requirements",
        }
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
