//! Loads scenarios of the repository, and scenarios from text.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on ends by panicking")]

use platebench_model::scenario::{Scenario, load};
use platebench_plate::{Plate, RawPlate};
use std::fs;
use std::path::{Path, PathBuf};

pub const PLATE: &str = include_str!("../../../scenarios/plates/aluminium-198x138.toml");

/// # Panics
/// If the repository's plate file is invalid.
#[must_use]
pub fn paper_plate() -> Plate {
    toml::from_str::<RawPlate>(PLATE).unwrap().check().unwrap()
}

/// # Panics
/// If the sources have been moved since the build.
#[must_use]
pub fn workspace_root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap()
}

/// Returns the path of a scenario, for example of `paper/fig13-closed-loop.toml`.
#[must_use]
pub fn scenario_path(name: &str) -> PathBuf {
    workspace_root().join("scenarios").join(name)
}

/// # Panics
/// If the file is not a valid scenario.
#[must_use]
#[track_caller]
pub fn load_scenario(name: &str) -> Scenario {
    load(&scenario_path(name), name).unwrap_or_else(|fault| panic!("{}", fault.render(false)))
}

/// Loads a scenario from text. A run needs files: use [`write_scenario`].
///
/// # Panics
/// If the scenario or the plate is invalid.
#[must_use]
#[track_caller]
pub fn parse_scenario(text: &str, plate: &str) -> Scenario {
    write_scenario(tempfile::tempdir().unwrap().path(), text, plate)
}

/// Writes `s.toml` and `plate.toml` into `folder` and loads the scenario.
///
/// # Panics
/// If the scenario or the plate is invalid.
#[must_use]
#[track_caller]
pub fn write_scenario(folder: &Path, text: &str, plate: &str) -> Scenario {
    fs::write(folder.join("plate.toml"), plate).unwrap();
    let path = folder.join("s.toml");
    fs::write(&path, text).unwrap();
    load(&path, "s.toml").unwrap_or_else(|fault| panic!("{}", fault.render(false)))
}
