//! Records a run: the types of `run.json`.

use crate::cost::CostTrend;
use crate::exclusion::Exclusion;
use crate::expectation_record::ExpectationRecord;
use crate::reason::Reason;
use crate::trial_record::TrialRecord;
use crate::verdict::{Cause, Verdict};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::path::Path;

/// Version of the format; readers reject others.
pub const FORMAT: u32 = 1;

/// A run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// Version of this format.
    pub format: u32,
    /// Over all scenarios.
    pub verdict: Verdict,
    /// False during the run, and if it was killed.
    pub complete: bool,
    /// The program that made it.
    pub tool: Tool,
    /// When it started, UTC, RFC 3339.
    pub started: String,
    /// What the controller ran on.
    pub rig: RigRecord,
    /// How time passed.
    pub clock: ClockKind,
    /// Options of the command line that changed the scenarios.
    pub overrides: Overrides,
    /// The computer.
    pub host: Host,
    /// Whether every controller confirmed 0 V at the end of its session; `None` during the run, and
    /// if it was killed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub safe_confirmed: Option<bool>,
    /// What was played.
    pub scenarios: Vec<ScenarioRecord>,
    /// Scenarios that need what the controller does not announce; they change no verdict.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub not_applicable: Vec<NotApplicable>,
    /// Instructions per control step by law, if the rig counts them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cost: Vec<CostTrend>,
}

/// How time passed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ClockKind {
    /// The plate waited for the controller.
    Lockstep,
    /// The plate did not wait.
    RealTime,
    /// The controller drove a plate of its own.
    RealPlate,
}

impl ClockKind {
    /// Its name in records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Lockstep => "lockstep",
            Self::RealTime => "real-time",
            Self::RealPlate => "real-plate",
        }
    }
}

impl fmt::Display for ClockKind {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

/// A scenario that the controller cannot play.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct NotApplicable {
    /// The scenario's file.
    pub file: String,
    /// Its title.
    pub title: String,
    /// What the controller does not announce.
    pub reason: String,
}

/// The program that made a record.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tool {
    /// Its name.
    pub name: String,
    /// Its version.
    pub version: String,
}

/// What the controller ran on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RigRecord {
    /// As named on the command line.
    pub name: String,
    /// The firmware's own identification; `None` if it never answered.
    #[serde(default)]
    pub firmware: Option<Firmware>,
}

impl RigRecord {
    /// The kind of rig, without port or file.
    pub fn kind(&self) -> &str {
        self.name.split(':').next().unwrap_or_default()
    }
}

/// The firmware's own identification.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Firmware {
    /// Its name.
    pub name: String,
    /// `major.minor.patch`
    pub version: String,
    /// Build identity, hexadecimal.
    pub build: String,
    /// Chip identity code, hexadecimal; zero for a program on a computer.
    pub chip: String,
}

/// Options of the command line that changed the scenarios.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Overrides {
    /// `--law`
    pub law: Option<String>,
    /// `--trials`
    pub trials: Option<u32>,
    /// `--seed`
    pub seed: Option<u64>,
    /// `--model`: the name of a tier or `auto`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<String>,
    /// `--require-all`: a scenario that is not applicable fails the run.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub require_all: bool,
}

/// The computer on which a run was made.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Host {
    /// Operating system.
    pub os: String,
    /// Instruction set.
    pub arch: String,
}

/// One scenario of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ScenarioRecord {
    /// Its file below the scenario folder.
    pub file: String,
    /// Its title.
    pub title: String,
    /// Its source.
    pub source: Option<String>,
    /// Over all expectations.
    pub verdict: Verdict,
    /// The control law.
    pub law: String,
    /// Model of the plate.
    pub model: String,
    /// Every input file; the first is the scenario.
    pub inputs: Vec<InputRecord>,
    /// Its expectations and their verdicts.
    pub expectations: Vec<ExpectationRecord>,
    /// Its trials.
    pub trials: Vec<TrialRecord>,
}

/// An input file of a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputRecord {
    /// Its copy, relative to the run folder.
    pub file: String,
    /// SHA-256 of its content, hexadecimal.
    pub sha256: String,
}

impl RunRecord {
    /// Combines the verdicts of all scenarios. A pass becomes inconclusive if the run is not
    /// complete or 0 V is not confirmed.
    pub fn update_verdict(&mut self) {
        let combined = Verdict::combine(self.scenarios.iter().map(|scenario| scenario.verdict));
        let is_doubtful = !self.complete || self.safe_confirmed == Some(false);
        self.verdict = if self.overrides.require_all && !self.not_applicable.is_empty() {
            Verdict::Fail
        } else if combined == Verdict::Pass && is_doubtful {
            Verdict::Inconclusive
        } else {
            combined
        };
    }

    /// Turns passed expectations into inconclusive ones if a trace of their scenario is missing in
    /// `folder`.
    pub fn discount_missing_traces(&mut self, folder: &Path) {
        for scenario in &mut self.scenarios {
            let is_missing = |trial: &&TrialRecord| trial.sha256.is_some() && !folder.join(&trial.trace).is_file();
            let Some(trial) = scenario.trials.iter().find(is_missing).map(|trial| trial.index) else { continue };
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
    }

    /// True if a controller was lost and the rig caused it.
    pub fn has_lost_controller(&self) -> bool {
        let mut trials = self.scenarios.iter().flat_map(|scenario| &scenario.trials);
        trials.any(|trial| trial.cause == Some(Cause::Rig) && trial.telemetry.ended.is_some())
    }
}

#[cfg(test)]
mod tests;
