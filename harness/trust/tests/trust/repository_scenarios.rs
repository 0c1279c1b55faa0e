//! Loads the repository's scenarios.

use platebench_scenario::{Scenario, load};
use std::path::{Path, PathBuf};

pub(crate) fn workspace_root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

pub(crate) fn load_scenario(name: &str) -> Scenario {
    load(&workspace_root().join("scenarios").join(name), name).unwrap_or_else(|fault| panic!("{fault}"))
}
