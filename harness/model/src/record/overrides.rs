//! Records what the command line overrides.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Overrides {
    pub law: Option<String>,
    pub trials: Option<u32>,
    pub seed: Option<u64>,
    /// `--model`: name of a tier, or `auto`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<String>,
    /// `--require-all`: a scenario that is not applicable fails the run.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub require_all: bool,
    /// `--fail-fast`: no trial starts after a scenario failed.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub fail_fast: bool,
    #[serde(default, skip_serializing_if = "KeepTraces::keeps_all")]
    pub keep_traces: KeepTraces,
    /// `--board`: name of the board in boards.toml.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub board: Option<String>,
    /// `--shard`: number of the shard, counted from 1, and number of shards.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shard: Option<[usize; 2]>,
    /// SHA-256 over all selected scenarios, before the shard was taken of them: their names, their
    /// inputs and the filters. Shards of different selections are not joined.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub selection: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum KeepTraces {
    #[default]
    All,
    /// Keeps no trace. Trials are judged in memory.
    None,
    /// Trials that miss a limit of one trial, lack a value, break the protocol, diverge, lose the
    /// link or are excluded.
    Failing,
    /// This many trials of each scenario, those with the smallest margins.
    Worst(u32),
}

impl KeepTraces {
    #[expect(clippy::trivially_copy_pass_by_ref, reason = "the signature that serde calls")]
    fn keeps_all(&self) -> bool {
        *self == Self::All
    }
}
