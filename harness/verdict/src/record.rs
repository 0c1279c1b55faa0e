//! What a run leaves behind: `run.json`.

mod cost;
mod outcome;
mod real_plate;
mod store;
mod timing;

pub use cost::{Cost, CostChange, CostTrend, EarlierCost};
pub use outcome::{Cause, Verdict};
pub use real_plate::{Asked, RealPlate};
pub use store::{FILE, RecordError};
pub use timing::{Quantiles, Timing};

use platebench_plate::Time;
use platebench_scenario::Expectation;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::collections::BTreeMap;

/// Version of the format; readers refuse others.
pub const FORMAT: u32 = 1;

/// A whole run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// Version of this format.
    pub format: u32,
    /// Over all scenarios.
    pub verdict: Verdict,
    /// False while the run goes on, and for ever after it was killed.
    pub complete: bool,
    /// The bench that made it.
    pub tool: Tool,
    /// When it started, UTC, RFC 3339.
    pub started: String,
    /// What the controller ran on.
    pub rig: RigRecord,
    /// `lockstep`, `real-time`, or `real-plate` where the controller drove a plate of its own.
    pub clock: String,
    /// Options of the command line that changed the scenarios.
    pub overrides: Overrides,
    /// The computer.
    pub host: Host,
    /// Whether every controller confirmed 0 V when its session ended; empty while the run goes on, and for ever after it was killed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub safe_confirmed: Option<bool>,
    /// What was played.
    pub scenarios: Vec<ScenarioRecord>,
    /// Instructions per control step by law, where the rig counts them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cost: Vec<CostTrend>,
}

/// The bench that made a record.
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
    /// The firmware as it introduced itself; empty where it never did.
    #[serde(default)]
    pub firmware: Option<Firmware>,
}

impl RigRecord {
    /// The kind of rig, without which one of its kind it was.
    pub fn kind(&self) -> &str {
        self.name.split(':').next().unwrap_or_default()
    }
}

/// The firmware as it introduced itself.
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
}

/// The computer that a run was made on.
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
    /// What is played.
    pub title: String,
    /// Where it comes from.
    pub source: Option<String>,
    /// Over all expectations.
    pub verdict: Verdict,
    /// The control law that was asked for.
    pub law: String,
    /// The tier of the plate.
    pub model: String,
    /// How that was chosen; not there in records of a bench that did not choose.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model_choice: Option<ModelChoice>,
    /// Every file that went into it; the first is the scenario.
    pub inputs: Vec<InputRecord>,
    /// What was expected and what came of it.
    pub expectations: Vec<ExpectationRecord>,
    /// What was played.
    pub trials: Vec<TrialRecord>,
}

/// How the tier of the plate was chosen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ModelChoice {
    /// `auto`, or the tier that was asked for by name.
    pub asked: String,
    /// Bound on |ΔW|/setpoint between the tier and the exact plate, known before the run; `null` where there is none.
    pub bound: Option<f64>,
    /// What it may be: a tenth of the tightest expectation's tolerance; 0 where no error of W is small enough.
    pub budget: f64,
}

/// A file that went into a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputRecord {
    /// Its copy, relative to the run folder.
    pub file: String,
    /// SHA-256 of its content, hexadecimal.
    pub sha256: String,
}

/// One expectation and what came of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExpectationRecord {
    /// Name of the metric.
    pub metric: String,
    /// How it ended.
    pub verdict: Verdict,
    /// What decided: see `statistic`. `null` where the trial that decided has no number, because it never settled for instance.
    pub value: Option<f64>,
    /// `worst` trial, or `mean`, `quantile` or `deviation` over trials.
    pub statistic: String,
    /// What it was held against, as in the scenario: `at_most`, `at_least`, `within` or `about`.
    pub limit: Map<String, Value>,
    /// `worst`: smallest and largest over trials; otherwise bounds at `confidence`.
    pub interval: Option<[f64; 2]>,
    /// Of the interval's bounds, or of the failure rate's where every trial counts by itself; `null` where nothing was left to chance.
    pub confidence: Option<f64>,
    /// Whose doing an inconclusive verdict is.
    pub cause: Option<Cause>,
    /// Why it did not pass, in a sentence.
    pub reason: Option<String>,
    /// The paper's value.
    pub paper: Option<f64>,
    /// Identifier of a requirement.
    pub requirement: Option<String>,
    /// What the metric was measured by, as far as the metric has it; empty in records of a bench that did not say.
    #[serde(flatten)]
    pub definition: Definition,
    /// What else the trials show.
    #[serde(default, skip_serializing_if = "Evidence::is_empty")]
    pub evidence: Evidence,
}

/// The choices of the scenario that are part of a metric's definition. Only what applies is there.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Definition {
    /// Instant from which on was looked, ms; not there where the scenario names none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from_ms: Option<f64>,
    /// Half width of the band around the setpoint, percent of the setpoint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub band_percent: Option<f64>,
    /// Column of the trace that was looked at.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub signal: Option<String>,
}

impl Definition {
    /// What of `expectation` belongs to its metric's definition.
    pub fn of(expectation: &Expectation) -> Self {
        let metric = expectation.metric;
        Self {
            from_ms: expectation.from.filter(|_| metric.has_from()).map(Time::ms),
            band_percent: metric.has_band().then_some(expectation.band_percent),
            signal: metric.has_signal().then(|| expectation.signal.to_owned()),
        }
    }
}

/// What trials show beside the verdict, and how it was found. Only what applies is there.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Evidence {
    /// How the bounds were found: `t`, `chi-square`, `bootstrap`, `order statistics` or `clopper-pearson`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub method: Option<String>,
    /// Bounds of the share of trials that break the limit, at the expectation's confidence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub failure_rate: Option<[f64; 2]>,
    /// Which quantile was judged.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quantile: Option<f64>,
    /// How likely it was, for normal data, to notice that the truth is half or double of what it should agree with; the smaller of the two.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub power: Option<f64>,
    /// Number of the planned look at which it was judged, and how many are planned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub look: Option<[u32; 2]>,
    /// All that in a sentence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub says: Option<String>,
    /// Whose observation the number is, where it is not the plate's true motion.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub observed: Option<String>,
}

impl Evidence {
    /// True where there is nothing to say.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// One trial.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrialRecord {
    /// Counted from 0.
    pub index: u32,
    /// What its plate, sensor and noise were drawn from.
    pub seed: u64,
    /// Its trace, relative to the run folder.
    pub trace: String,
    /// SHA-256 of the trace, hexadecimal; `null` where the trial was cut off before it was recorded.
    #[serde(default)]
    pub sha256: Option<String>,
    /// By name of the metric, `[n]` behind the name of the n-th further expectation of it; `null` where there is no number.
    pub metrics: Map<String, Value>,
    /// What the rig told beside the trace.
    #[serde(default)]
    pub telemetry: Telemetry,
    /// Whose doing it is that the trial does not count.
    pub cause: Option<Cause>,
    /// What happened, in a sentence.
    pub reason: Option<String>,
    /// From when on the trial diverged, s; not there where it did not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub diverged_at_s: Option<f64>,
    /// Wall-clock time of the trial, ms; `null` where the trial was judged again.
    pub wall_ms: Option<f64>,
}

/// What the rig told of a trial, beside its trace.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Telemetry {
    /// The longest time from sampling to actuation as it acted on the plate, µs.
    pub loop_delay_us: Option<f64>,
    /// The longest time that line and controller took on the target's own clock, whether it acted on the plate or not, µs.
    pub rig_delay_us: Option<f64>,
    /// Instructions per control step, mean.
    pub instructions_mean: Option<f64>,
    /// Instructions per control step, worst.
    pub instructions_worst: Option<f64>,
    /// Why the controller was no longer there, where it was not.
    #[serde(default)]
    pub ended: Option<String>,
    /// How punctual everything was, in real time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timing: Option<Timing>,
    /// What was heard and done, where the controller drove a plate of its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub real_plate: Option<RealPlate>,
    /// Why the controller stopped, in its own words, where it said that it did; the first time counts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopped: Option<String>,
    /// Messages that planned faults struck, by the kind of fault.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub faults: BTreeMap<String, u64>,
    /// Commands whose drive was no number, where there were any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub not_finite: Option<NotFinite>,
    /// How long the controller was told to wait for a sample by a clock of its own that goes on while the plate waits, ms; not there where its clock is the plate's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub patience_ms: Option<u16>,
    /// Commands that wanted something else than the one before them, in answer to the same sample.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub contradictions: u64,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
fn is_zero(count: &u64) -> bool {
    *count == 0
}

/// Commands whose drive was NaN or infinite: the amplifier gave 0 V instead, so the trace does not show them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NotFinite {
    /// When the first of them acted, s.
    pub at_s: f64,
    /// How many there were.
    pub count: u64,
}

impl RunRecord {
    /// The verdict over all scenarios. A run that did not come to its end, or a drive that nobody confirmed to be at 0 V, leaves a pass in doubt.
    pub fn decide(&mut self) {
        let over = Verdict::over(self.scenarios.iter().map(|scenario| scenario.verdict));
        let is_doubtful = !self.complete || self.safe_confirmed == Some(false);
        self.verdict = if over == Verdict::Pass && is_doubtful { Verdict::Inconclusive } else { over };
    }

    /// True where a controller was lost for good and that is not its own doing.
    pub fn lost_a_controller(&self) -> bool {
        let mut trials = self.scenarios.iter().flat_map(|scenario| &scenario.trials);
        trials.any(|trial| trial.cause == Some(Cause::Rig) && trial.telemetry.ended.is_some())
    }
}

#[cfg(test)]
mod tests;
