//! Defines the record of a run (`run.json`).

use crate::record::reason::ExpectationRecord;
use crate::record::trial_record::CostTrend;
use crate::record::trial_record::TrialRecord;
use crate::record::verdict::{Cause, Verdict, VerdictCounts};
use crate::scenario::NotApplicableExpectation;
use platebench_plate::{Model, is_default};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::OnceLock;

/// Version of `run.json`. Readers reject other versions.
pub const FORMAT: u32 = 1;
const DIGEST_START: usize = 12;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunRecord {
    pub format: u32,
    /// One more than the largest number of the neighbouring runs at the start. Orders runs whatever
    /// the clock does; absent in records of 0.3.
    #[serde(default, skip_serializing_if = "is_default")]
    pub sequence: u64,
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
    #[serde(default, skip_serializing_if = "is_default")]
    pub drive_after_safe: bool,
    /// Wall-clock time of the run, ms; absent during the run or if it was killed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wall_ms: Option<f64>,
    pub scenarios: Vec<ScenarioRecord>,
    /// Scenarios that need a law or a capability that the controller does not announce, or do not
    /// apply to its own law. They change no verdict.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub not_applicable: Vec<NotApplicable>,
    /// Instructions per control step by law, if the rig counts them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cost: Vec<CostTrend>,
    /// The runs that `platebench report --merge` joined.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub merge: Option<MergeRecord>,
    /// The sealed trials; absent in records of 0.3, whose trials have no other place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub journal: Option<JournalRecord>,
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
    /// Number of its expectations, if the reason is that none of them applies to an own law.
    #[serde(default, skip_serializing_if = "is_default")]
    pub expectations: usize,
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
    /// Every input file; the first is the scenario, the second its plate.
    pub inputs: Vec<InputRecord>,
    pub expectations: Vec<ExpectationRecord>,
    /// Expectations that do not apply to the controller's own law. They change no verdict.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub not_applicable: Vec<NotApplicableExpectation>,
    /// Texts by identifier, from `requirements.toml`.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub requirement_texts: BTreeMap<String, String>,
    /// Time limit that ended the scenario before all trials were played, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_limit_s: Option<f64>,
    /// Smallest number of trials that the scenario needs; `null` in records of 0.3.
    #[serde(default)]
    pub planned_trials: Option<u32>,
    pub trials: Vec<TrialRecord>,
}

impl ScenarioRecord {
    /// Name of the plate file without folder and extension. `None` if the record lists no plate.
    pub fn plate(&self) -> Option<&str> {
        Path::new(&self.inputs.get(1)?.file).file_stem()?.to_str()
    }

    /// What the plate model contains, and why the scene was played with it.
    pub fn model_description(&self) -> Option<&'static str> {
        Model::from_name(&self.model).map(|model| match model {
            Model::Linear => "two decoupled first-order systems, because the scenario requests it",
            Model::Envelope => "first order with the slow pole only, because the scenario requests it",
            Model::Modal => "the smallest that is exact for a plate file without a lock-in",
            Model::Carrier => "with carrier, converter and demodulator, for the lock-in of the plate file",
        })
    }

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

/// The journal `trials.jsonl` of a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct JournalRecord {
    /// Number of the run, hexadecimal. The seal of the first line includes it.
    pub run: String,
    /// Seal of the last line; absent during the run, and if it was killed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seal: Option<String>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct InputRecord {
    /// Path of the copy, relative to the run folder.
    pub file: String,
    pub sha256: String,
}

impl RunRecord {
    /// The rig that played a scenario. The runs of a joined run may have different ones.
    pub fn rig_of(&self, file: &str) -> &RigRecord {
        self.merge.as_ref().and_then(|merge| merge.run_of(file)).map_or(&self.rig, |run| &run.rig)
    }

    /// Name of a scenario in the run that played it. A joined run adds the board.
    pub fn original_file<'a>(&'a self, file: &'a str) -> &'a str {
        let mut merged = self.merge.iter().flat_map(|merge| merge.runs.iter().flat_map(|run| &run.scenarios));
        merged.find(|scenario| scenario.file == file).map_or(file, |scenario| &scenario.original)
    }

    pub fn scenario_counts(&self) -> VerdictCounts {
        self.scenarios.iter().map(|scenario| scenario.verdict).collect()
    }

    pub fn expectation_counts(&self) -> VerdictCounts {
        let expectations = self.scenarios.iter().flat_map(|scenario| &scenario.expectations);
        expectations.map(|expectation| expectation.verdict).collect()
    }

    /// A copy whose traces have paths that are valid in the working directory of `folder`.
    #[must_use]
    pub fn with_traces_below(&self, folder: &Path) -> Self {
        let mut record = self.clone();
        for trial in record.scenarios.iter_mut().flat_map(|scenario| &mut scenario.trials) {
            trial.trace = folder.join(&trial.trace).display().to_string();
        }
        record
    }

    /// True if the controller may have an amplifier: not if it is a program or simulated.
    pub fn may_have_amplifier(&self) -> bool {
        self.clock == ClockKind::RealPlate || !matches!(self.rig.kind(), "hosted" | "emulated" | "exec")
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

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct RigRecord {
    /// Name of the rig, as on the command line.
    pub name: String,
    /// `null` if the firmware never identified itself.
    #[serde(default)]
    pub firmware: Option<Firmware>,
    /// SHA-256 of the program that the bench starts or of the image that it loads; absent on other
    /// rigs and in records of 0.3.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub program_sha256: Option<String>,
    /// True if the controller is the bench's own firmware, so that the run tests no other code.
    #[serde(default, skip_serializing_if = "is_default")]
    pub bench_firmware: bool,
}

impl RigRecord {
    /// True if the same controller answered: the same identity and the same program or image, and
    /// the same arguments of a program, because they may select its law. If the bench knows no
    /// program, also the kinds of the rigs must be equal.
    pub fn has_same_controller(&self, other: &Self) -> bool {
        let has_program = self.program_sha256.is_some();
        self.firmware == other.firmware
            && self.program_sha256 == other.program_sha256
            && self.arguments() == other.arguments()
            && (has_program || self.kind() == other.kind())
    }

    /// What follows the program of `exec:`.
    fn arguments(&self) -> Option<&str> {
        self.name.strip_prefix("exec:").and_then(|command| command.trim().split_once(' ')).map(|(_, rest)| rest.trim())
    }

    /// Rig, identity and start of the digest of the controller, for messages.
    pub fn describe_controller(&self) -> String {
        let identity = self.firmware.as_ref().map(|firmware| {
            let Firmware { name, version, build, .. } = firmware;
            format!("{name:?} {version}, build {build}")
        });
        let digest = self.program_sha256.as_deref().and_then(|digest| digest.get(..DIGEST_START));
        let parts = identity.into_iter().chain(digest.map(|start| format!("SHA-256 {start}…")));
        format!("{} ({})", self.name, parts.collect::<Vec<_>>().join(", "))
    }

    /// Kind of the rig without port or file, for example `emulated`.
    pub fn kind(&self) -> &str {
        self.name.split(':').next().unwrap_or_default()
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Firmware {
    pub name: String,
    pub version: String,
    /// Build identity, hexadecimal.
    pub build: String,
    /// Chip identity code, hexadecimal; zero for a program on a computer.
    pub chip: String,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Overrides {
    pub law: Option<String>,
    pub trials: Option<u32>,
    pub seed: Option<u64>,
    /// `--model`: name of a model, or `auto`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<String>,
    /// `--require-all`: a scenario that is not applicable fails the run.
    #[serde(default, skip_serializing_if = "is_default")]
    pub require_all: bool,
    /// `--fail-fast`: no trial starts after a scenario failed.
    #[serde(default, skip_serializing_if = "is_default")]
    pub fail_fast: bool,
    /// `--long-scripts`: the protocol check plays its long scripts on every rig.
    #[serde(default, skip_serializing_if = "is_default")]
    pub long_scripts: bool,
    /// `--timeout`: wall time after which the trials of a scenario end, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timeout_s: Option<f64>,
    /// `--wire-time`: emulated line and computing time act as loop delay.
    #[serde(default, skip_serializing_if = "is_default")]
    pub wire_time: bool,
    #[serde(default, skip_serializing_if = "is_default")]
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

/// The program's crate sets this value, because a new commit recompiles only that crate.
static RUNNING: OnceLock<Tool> = OnceLock::new();

#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Tool {
    pub name: String,
    pub version: String,
    /// Commit of the built checkout. Changes that were not committed do not show.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub commit: Option<String>,
    /// Cargo profile.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub profile: Option<String>,
    /// Cargo features of the build.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub features: Vec<String>,
}

impl Tool {
    pub fn set_running(self) {
        RUNNING.get_or_init(|| self);
    }

    /// Contains only name and version if [`Tool::set_running`] was not called.
    pub fn running() -> Self {
        let unnamed =
            || Self { name: "platebench".to_owned(), version: env!("CARGO_PKG_VERSION").to_owned(), ..Self::default() };
        RUNNING.get().cloned().unwrap_or_else(unnamed)
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Host {
    pub os: String,
    pub arch: String,
    /// Model name of the first processor, if the kernel reports it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cpu: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kernel: Option<String>,
    /// Frequency governor of the first processor; absent in most virtual machines.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub governor: Option<String>,
}

impl Host {
    pub fn current() -> Self {
        let line = |path: &str| fs::read_to_string(path).ok().map(|text| text.trim().to_owned());
        let processors = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        Self {
            os: std::env::consts::OS.to_owned(),
            arch: std::env::consts::ARCH.to_owned(),
            cpu: model_name(&processors),
            kernel: line("/proc/sys/kernel/osrelease"),
            governor: line("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"),
        }
    }
}

fn model_name(processors: &str) -> Option<String> {
    let (_, name) =
        processors.lines().filter_map(|line| line.split_once(':')).find(|(key, _)| key.trim() == "model name")?;
    Some(name.trim().to_owned()).filter(|name| !name.is_empty())
}

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
    pub fn run_of(&self, file: &str) -> Option<&MergedRun> {
        self.runs.iter().find(|run| run.scenarios.iter().any(|scenario| scenario.file == file))
    }
}

#[cfg(test)]
pub(crate) mod tests;

#[cfg(test)]
mod provenance_tests {
    use super::*;

    #[test]
    fn reads_the_model_name_of_the_first_processor() {
        let text = "processor\t: 0\nmodel\t\t: 25\nmodel name\t: A CPU @ 2.0 GHz: fast\n\nmodel name\t: B\n";
        assert_eq!(model_name(text).as_deref(), Some("A CPU @ 2.0 GHz: fast"));
        assert_eq!(model_name("Hardware : board\nmodel name : \n"), None);
        assert!(Host::current().kernel.is_some_and(|release| !release.contains('\n')));
    }
}
