//! Provides the envelope of the repository and explorations of it.

use platebench_experiments::explore::{Envelope, ExplorationBudget, ExploreConfig, ExploredLaw};
use platebench_wire::LawId;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

pub(crate) fn envelope_path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/envelope.toml")
}

pub(crate) fn configuration(law: impl Into<ExploredLaw>, scenes: u64) -> ExploreConfig {
    ExploreConfig {
        envelope: Envelope::load(&envelope_path()).unwrap(),
        seed: 1,
        law: law.into(),
        laws: vec![LawId::DqPi, LawId::Deadbeat, LawId::DqPiFixed],
        budget: ExplorationBudget::Scenes(scenes),
        max_failed: 10,
        jobs: 2,
        own_clock: false,
        compares_reference: false,
        regressions: Vec::new(),
        sequences: None,
        has_endurance: true,
        is_guided: false,
        branch_outcomes: BTreeSet::new(),
    }
}
