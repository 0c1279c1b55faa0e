//! The repository's scenarios.

use platebench_scenario::{Scenario, load};
use std::path::{Path, PathBuf};

pub(crate) fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

pub(crate) fn scenario(name: &str) -> Scenario {
    load(&root().join("scenarios").join(name), name).unwrap_or_else(|fault| panic!("{fault}"))
}
