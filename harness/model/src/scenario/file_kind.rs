//! Recognises the kind of a TOML file by its top-level keys.

use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::parse::parse_syntax;
use crate::scenario::requirements::REQUIREMENTS_FILE;
use crate::scenario::text::read_text;
use std::path::Path;

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
    Baseline,
    #[strum(serialize = "uncertainty budget")]
    Budget,
}

/// No other file has these keys, also not `platebench.toml`.
const SCENARIO_KEYS: [&str; 9] = [
    "profile",
    "expect",
    "controller",
    "duration_ms",
    "fault",
    "between",
    "trace_step_ms",
    "expected_exit",
    "only_if_named",
];

/// The first entry with a top-level key of the file determines the kind of the file.
const KEYS: [(FileKind, &[&str]); 9] = [
    (FileKind::Plan, &["ask", "bench", "repetitions", "decision"]),
    (FileKind::Boards, &["board"]),
    (FileKind::Envelope, &["range", "count"]),
    (FileKind::Baseline, &["curves_sha256", "features", "tolerance"]),
    (FileKind::Campaign, &["vary", "scenario", "plan", "judge"]),
    (FileKind::Budget, &["instrument", "budget", "coverage_percent"]),
    (FileKind::Plate, &["mode", "drive", "sensor", "finger", "second_mode", "heating"]),
    (FileKind::Config, &["rig", "jobs", "format", "baselines", "scenarios", "runs", "out", "run"]),
    (FileKind::Scenario, &["plate", "trials"]),
];

impl FileKind {
    /// Fails if the file cannot be read, is not TOML, or has no key of a known kind.
    pub fn detect(path: &Path) -> Result<Self, Vec<Diagnostic>> {
        let text = read_text(path).map_err(|fault| vec![fault])?;
        let document = parse_syntax(path, &text)?;
        let document = document.get_ref();
        let has = |key: &&str| document.contains_key(*key);
        if SCENARIO_KEYS.iter().any(has) {
            return Ok(Self::Scenario);
        }
        if path.file_name().is_some_and(|name| name == SETTINGS_FILE) {
            return Ok(Self::Config);
        }
        let requirements = document.contains_key("requirement");
        if path.file_name().is_some_and(|name| name == REQUIREMENTS_FILE) || (requirements && document.len() == 1) {
            return Ok(Self::Requirements);
        }
        if requirements {
            return Ok(Self::Plan);
        }
        let kind = KEYS.iter().find(|(_, keys)| keys.iter().any(has));
        kind.map(|(kind, _)| *kind).ok_or_else(|| {
            let message = "is a file of no known kind, expected a top-level key of a scenario (`profile`), a plate \
                           (`mode`), a plan (`requirement`), an envelope (`range`), a campaign (`vary`), a board \
                           inventory (`board`), a baseline (`tolerance`), a budget (`budget`) or settings (`run`)";
            vec![Diagnostic::for_file(path, message)]
        })
    }

    pub const fn name(self) -> &'static str {
        self.into_str()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn detect(name: &str, text: &str) -> Result<FileKind, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        FileKind::detect(&path).map_err(|faults| faults[0].to_string().replace(&path.display().to_string(), name))
    }

    #[test]
    fn the_keys_of_a_file_decide_its_kind() {
        for (text, kind) in [
            ("duration_ms = 1", FileKind::Scenario),
            ("[profile]", FileKind::Scenario),
            ("plate = \"a.toml\"", FileKind::Scenario),
            ("scenario = \"a.toml\"", FileKind::Campaign),
            ("[vary]", FileKind::Campaign),
            ("[plan]", FileKind::Campaign),
            ("plate = \"a.toml\"\n[range]", FileKind::Envelope),
            ("[bench]", FileKind::Plan),
            ("title = \"a\"\n[[requirement]]\n[[scenario]]", FileKind::Plan),
            ("[[requirement]]", FileKind::Requirements),
            ("[[board]]", FileKind::Boards),
            ("[mode]", FileKind::Plate),
            ("scenario = \"a.toml\"\ncurves_sha256 = \"\"", FileKind::Baseline),
            ("[[budget]]", FileKind::Budget),
            ("[run]", FileKind::Config),
        ] {
            assert_eq!(detect("file.toml", text), Ok(kind), "{text}");
        }
    }

    #[test]
    fn a_file_name_does_not_hide_a_scenario() {
        assert_eq!(detect(SETTINGS_FILE, "[profile]"), Ok(FileKind::Scenario));
        assert_eq!(detect(REQUIREMENTS_FILE, "[profile]"), Ok(FileKind::Scenario));
        assert_eq!(detect(SETTINGS_FILE, ""), Ok(FileKind::Config));
        assert_eq!(detect(REQUIREMENTS_FILE, ""), Ok(FileKind::Requirements));
    }

    #[test]
    fn rejects_a_file_of_no_known_kind() {
        let error = detect("Cargo.toml", "[package]").unwrap_err();
        assert!(error.starts_with("Cargo.toml: is a file of no known kind, expected "), "{error}");
        let error = detect("a.toml", "[mode]\n[profile\n").unwrap_err();
        assert!(error.starts_with("a.toml:2:9: "), "{error}");
    }
}
