//! Defines the content of `run.json`.

use crate::record::cost::CostTrend;
use crate::record::exclusion::Exclusion;
use crate::record::expectation_record::ExpectationRecord;
use crate::record::merge_record::MergeRecord;
use crate::record::overrides::Overrides;
use crate::record::provenance::{Host, Tool};
use crate::record::reason::Reason;
use crate::record::rig_record::RigRecord;
use crate::record::trial_record::TrialRecord;
use crate::record::verdict::{Cause, Verdict};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Version of `run.json`. Readers reject other versions.
pub const FORMAT: u32 = 1;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunRecord {
    pub format: u32,
    pub verdict: Verdict,
    /// False during the run, and if the run was killed.
    pub complete: bool,
    pub tool: Tool,
    /// Start of the run, UTC, RFC 3339.
    pub started: String,
    pub rig: RigRecord,
    pub clock: ClockKind,
    pub overrides: Overrides,
    pub host: Host,
    /// True if every controller confirmed 0 V at the end; absent during the run or if it was
    /// killed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub safe_confirmed: Option<bool>,
    /// True if a controller commanded a drive after it had confirmed 0 V, outside all trials. The
    /// run then fails.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub drive_after_safe: bool,
    /// Wall-clock time of the run, ms; absent during the run or if it was killed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wall_ms: Option<f64>,
    pub scenarios: Vec<ScenarioRecord>,
    /// Scenarios that need a law or a capability that the controller does not announce. They change
    /// no verdict.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub not_applicable: Vec<NotApplicable>,
    /// Instructions per control step by law, if the rig counts them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cost: Vec<CostTrend>,
    /// The runs that `platebench report --merge` joined.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub merge: Option<MergeRecord>,
}

#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema, strum::IntoStaticStr, strum::Display,
)]
#[strum(const_into_str, serialize_all = "kebab-case")]
#[serde(rename_all = "kebab-case")]
pub enum ClockKind {
    /// The plate waited for the controller.
    Lockstep,
    /// The plate did not wait for the controller.
    RealTime,
    /// The controller drove a plate of its own.
    RealPlate,
}

impl ClockKind {
    pub const fn name(self) -> &'static str {
        self.into_str()
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct NotApplicable {
    pub file: String,
    pub title: String,
    pub reason: String,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ScenarioRecord {
    /// Path below the scenario folder.
    pub file: String,
    pub title: String,
    pub source: Option<String>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub tags: Vec<String>,
    pub verdict: Verdict,
    pub law: String,
    pub model: String,
    /// Control period; `null` in records of earlier versions.
    #[serde(default)]
    pub period_ms: Option<f64>,
    /// Every input file; the first is the scenario.
    pub inputs: Vec<InputRecord>,
    pub expectations: Vec<ExpectationRecord>,
    /// Texts by identifier, from `requirements.toml`.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub requirement_texts: BTreeMap<String, String>,
    pub trials: Vec<TrialRecord>,
}

impl ScenarioRecord {
    /// Key of an expectation in the metrics of a trial. The first expectation of a metric has its
    /// name, the second has the suffix `[2]`. Empty if there is no expectation `index`.
    pub fn metric_key(&self, index: usize) -> String {
        let Some(expectation) = self.expectations.get(index) else { return String::new() };
        let before = self.expectations.iter().take(index);
        match before.filter(|earlier| earlier.metric == expectation.metric).count() {
            0 => expectation.metric.to_string(),
            earlier => format!("{}[{}]", expectation.metric, earlier + 1),
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct InputRecord {
    /// Path of the copy, relative to the run folder.
    pub file: String,
    pub sha256: String,
}

impl RunRecord {
    /// Combines the verdicts of all scenarios. A pass also needs a complete run, all shards and
    /// confirmed 0 V. A drive after confirmed 0 V fails the run.
    pub fn update_verdict(&mut self) {
        let combined = Verdict::combine(self.scenarios.iter().map(|scenario| scenario.verdict));
        let misses_shards = self.merge.as_ref().is_some_and(|merge| !merge.missing_shards.is_empty());
        let is_inconclusive = !self.complete || misses_shards || self.safe_confirmed == Some(false);
        let misses_required = self.overrides.require_all && !self.not_applicable.is_empty();
        self.verdict = if misses_required || self.drive_after_safe {
            Verdict::Fail
        } else if combined == Verdict::Pass && is_inconclusive {
            Verdict::Inconclusive
        } else {
            combined
        };
    }

    /// Turns passes of a scenario into inconclusive verdicts if one of its traces is missing.
    /// Returns whether a trace is missing.
    pub fn discount_missing_traces(&mut self, folder: &Path) -> bool {
        let mut misses_traces = false;
        for scenario in &mut self.scenarios {
            let is_missing = |trial: &&TrialRecord| trial.sha256.is_some() && !folder.join(&trial.trace).is_file();
            let Some(trial) = scenario.trials.iter().find(is_missing).map(|trial| trial.index) else { continue };
            misses_traces = true;
            for expectation in &mut scenario.expectations {
                if expectation.verdict == Verdict::Pass {
                    let exclusion = Exclusion::MissingTrace;
                    expectation.verdict = Verdict::Inconclusive;
                    expectation.cause = Some(exclusion.cause());
                    expectation.reason = Some(Reason::Excluded { trial, exclusion });
                }
            }
            scenario.verdict = Verdict::combine(scenario.expectations.iter().map(|expectation| expectation.verdict));
        }
        self.update_verdict();
        misses_traces
    }

    /// Fault of the end at 0 V. `None` if 0 V was confirmed and kept, or if this is unknown.
    pub fn unsafe_end(&self) -> Option<&'static str> {
        if self.drive_after_safe {
            return Some("the controller commanded a drive after it had confirmed 0 V");
        }
        (self.safe_confirmed == Some(false)).then_some("the controller did not confirm 0 V")
    }

    /// True if a controller was lost and the rig caused it.
    pub fn has_lost_controller(&self) -> bool {
        let mut trials = self.scenarios.iter().flat_map(|scenario| &scenario.trials);
        trials.any(|trial| trial.cause == Some(Cause::Rig) && trial.telemetry.ended.is_some())
    }
}

#[cfg(test)]
mod tests;
