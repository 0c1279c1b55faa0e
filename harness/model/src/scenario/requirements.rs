//! Reads the texts of requirements from the `requirements.toml` nearest above a scenario.

use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::parse::parse_file;
use schemars::JsonSchema;
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

pub const REQUIREMENTS_FILE: &str = "requirements.toml";

#[derive(Debug, Clone, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Requirement {
    /// Identifier, as in the expectations of scenarios.
    #[schemars(regex(pattern = "^[A-Za-z0-9-]+$"))]
    pub id: String,
    /// Text of the requirement.
    #[schemars(length(min = 1))]
    pub text: String,
}

#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct RawRequirements {
    #[serde(default)]
    requirement: Vec<Requirement>,
}

/// Fails if an identifier is empty or occurs twice, or if a text is empty.
pub fn read_requirements(path: &Path) -> Result<Vec<Requirement>, Vec<Diagnostic>> {
    let (text, raw) = parse_file::<RawRequirements>(path)?;
    let mut known = BTreeSet::new();
    let mut faults = Vec::new();
    for (number, requirement) in raw.requirement.iter().enumerate() {
        let mut report = |key: &str, message: String| {
            faults.push(Diagnostic::at_key(path, &text, &format!("requirement.{number}.{key}"), message));
        };
        if requirement.text.trim().is_empty() {
            report("text", "empty, expected a text".to_owned());
        }
        if requirement.id.trim().is_empty() || !known.insert(&requirement.id) {
            report("id", format!("`{}`, expected each identifier once and none empty", requirement.id));
        }
    }
    if faults.is_empty() { Ok(raw.requirement) } else { Err(faults) }
}

/// Returns the texts of the identifiers in `used`. Empty if no folder above `scenario` contains
/// `requirements.toml`.
pub(crate) fn requirement_texts<'a>(
    scenario: &Path,
    used: impl Iterator<Item = &'a str>,
) -> Result<BTreeMap<String, String>, Vec<Diagnostic>> {
    let used: BTreeSet<&str> = used.collect();
    let Some(path) = (!used.is_empty()).then(|| file_above(scenario)).flatten() else { return Ok(BTreeMap::new()) };
    let known = read_requirements(&path)?.into_iter();
    let found = known.filter(|requirement| used.contains(requirement.id.as_str()));
    Ok(found.map(|requirement| (requirement.id, requirement.text.trim().to_owned())).collect())
}

fn file_above(scenario: &Path) -> Option<PathBuf> {
    let scenario = std::path::absolute(scenario).ok()?;
    scenario.ancestors().skip(1).map(|folder| folder.join(REQUIREMENTS_FILE)).find(|path| path.is_file())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;
    use std::fs;

    #[test]
    fn the_nearest_file_above_gives_the_texts() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("a/b");
        fs::create_dir_all(&folder).unwrap();
        let scenario = folder.join("s.toml");
        let texts = || requirement_texts(&scenario, ["R-1", "R-3"].into_iter()).unwrap();
        let outer =
            "[[requirement]]\nid = \"R-1\"\ntext = \" It settles. \"\n[[requirement]]\nid = \"R-2\"\ntext = \"x\"\n";
        fs::write(root.path().join(REQUIREMENTS_FILE), outer).unwrap();
        assert_eq!(texts(), BTreeMap::from([("R-1".to_owned(), "It settles.".to_owned())]));
        fs::write(folder.join(REQUIREMENTS_FILE), "").unwrap();
        assert_eq!(texts(), BTreeMap::new());
    }

    #[rstest]
    #[case("[[requirement]]\nid = \"R-1\"\ntext = \"\"", "empty, expected a text")]
    #[case("[[requirement]]\nid = \"\"\ntext = \"x\"", "expected each identifier once")]
    #[case(
        "[[requirement]]\nid = \"A\"\ntext = \"x\"\n[[requirement]]\nid = \"A\"\ntext = \"y\"",
        "`A`, expected each"
    )]
    #[case("[[requirement]]\nid = \"A\"\nwords = \"x\"", "unknown key")]
    #[case("title = \"A\"", "unknown key")]
    fn rejects_a_faulty_file(#[case] text: &str, #[case] expected: &str) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(REQUIREMENTS_FILE);
        fs::write(&path, text).unwrap();
        let faults = read_requirements(&path).unwrap_err();
        assert!(faults[0].message.contains(expected), "{}", faults[0].message);
    }
}
