//! Records which runs were joined, and how their boards differ.

use crate::record::overrides::Overrides;
use crate::record::provenance::{Host, Tool};
use crate::record::rig_record::RigRecord;
use crate::record::verdict::Verdict;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct MergeRecord {
    pub runs: Vec<MergedRun>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub missing_shards: Vec<MissingShard>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub differences: Vec<BoardDifference>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MergedRun {
    /// Name of the board; kind of the rig if the run names no board.
    pub board: String,
    pub folder: String,
    pub started: String,
    pub verdict: Verdict,
    pub complete: bool,
    pub rig: RigRecord,
    pub overrides: Overrides,
    pub tool: Tool,
    pub host: Host,
    pub scenarios: Vec<MergedScenario>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct MergedScenario {
    /// Name of the scenario in the joined run.
    pub file: String,
    /// Name of the scenario in its own run.
    pub original: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct MissingShard {
    pub board: String,
    /// Counted from 1.
    pub shard: usize,
    pub shards: usize,
}

/// Mean over the trials of a board minus the mean of the reference board.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct BoardDifference {
    pub scenario: String,
    pub metric: String,
    pub board: String,
    pub reference: String,
    pub difference: f64,
    /// Two-sided; `null` if one of the boards has only one trial.
    pub interval: Option<[f64; 2]>,
    pub confidence: f64,
}

impl MergeRecord {
    pub fn overrides_of(&self, file: &str) -> Option<&Overrides> {
        let run = self.runs.iter().find(|run| run.scenarios.iter().any(|scenario| scenario.file == file))?;
        Some(&run.overrides)
    }
}
