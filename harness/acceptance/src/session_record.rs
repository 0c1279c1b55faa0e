//! Defines `session.json`, the state of a session.

use crate::error::AcceptError;
use jiff::Timestamp;
use platebench_record::Verdict;
use platebench_record::{Firmware, Host, InputRecord, Quantiles, Tool};
use platebench_rig::RigSpec;
use platebench_trace::write_atomically;
use serde::{Deserialize, Serialize};
use std::fs;
use std::path::Path;

/// File name.
pub const FILE: &str = "session.json";
/// Copy of the plan.
pub(crate) const PLAN: &str = "plan.toml";
/// Folder of the steps.
pub(crate) const STEPS: &str = "steps";
/// Version of the format; readers reject others.
pub const FORMAT: u32 = 1;

/// A session.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SessionRecord {
    /// Version of this format.
    pub format: u32,
    /// Over requirements, scenarios, self-test and confirmations; `inconclusive` until the session
    /// is complete.
    pub verdict: Verdict,
    /// True if every step has ended and is judged.
    pub complete: bool,
    /// Title of the plan.
    pub title: String,
    /// Operator; `null` if not stated.
    pub operator: Option<String>,
    /// Place; `null` if not stated.
    pub place: Option<String>,
    /// Notes; `null` if there are none.
    pub notes: Option<String>,
    /// Start, UTC, RFC 3339.
    pub started: String,
    /// End; `null` until then.
    pub finished: Option<String>,
    /// Times at which it was resumed.
    pub resumed: Vec<String>,
    /// The bench.
    pub bench: BenchRecord,
    /// The rig as named on the command line.
    pub rig: String,
    /// The clock.
    pub clock: ClockRecord,
    /// The controller; `null` until it was identified.
    pub firmware: Option<FirmwareRecord>,
    /// The copy of the plan.
    pub plan: InputRecord,
    /// Every input file, by scenario: the scenario, its plate, its profiles.
    pub inputs: Vec<InputRecord>,
    /// Steps in order.
    pub steps: Vec<StepRecord>,
    /// Requirements; empty until all is judged.
    pub requirements: Vec<RequirementRecord>,
    /// Key of the signature; `null` without one.
    pub signature: Option<SignatureRecord>,
}

/// The bench of a session.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BenchRecord {
    /// Name and version.
    pub tool: Tool,
    /// SHA-256 of the program, hexadecimal.
    pub sha256: String,
    /// The computer.
    pub host: Host,
}

/// The clock of a session.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClockRecord {
    /// `lockstep` or `real-time`.
    pub name: String,
    /// Plate seconds per wall second; 1 in lockstep.
    pub time_scale: f64,
    /// Which timer makes the control instants: `bench` or `target`.
    pub pacing: String,
}

/// The controller of a session.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FirmwareRecord {
    /// Name, version, build, chip.
    #[serde(flatten)]
    pub firmware: Firmware,
    /// Unique number of the chip, hexadecimal; zero for a program.
    pub unique: String,
    /// SHA-256 of the image that the bench loaded, hexadecimal; `null` if the rig has its own.
    pub image_sha256: Option<String>,
}

/// Kind of step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StepKind {
    /// Identity of the controller.
    Identity,
    /// A question to the operator.
    Ask,
    /// Timing and repeatability of the bench.
    SelfTest,
    /// Kill rate and false alarms of the scenarios.
    Trust,
    /// A scenario.
    Scenario,
}

/// A step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StepRecord {
    /// Number and name, and its folder below `steps`.
    pub id: String,
    /// One line.
    pub title: String,
    /// Kind of step.
    pub kind: StepKind,
    /// True if it has ended; it is not repeated then.
    pub done: bool,
    /// Its verdict; `null` if it has none or has not ended.
    pub verdict: Option<Verdict>,
    /// Why it does not pass, or its result.
    pub reason: Option<String>,
    /// Its attempts.
    pub attempts: Vec<Attempt>,
    /// True if the controller was lost or did not confirm 0 V.
    pub lost: bool,
    /// SHA-256 of its `run.json`, hexadecimal.
    pub run_sha256: Option<String>,
    /// Answer to a question.
    pub answer: Option<AnswerRecord>,
    /// Result of the self-test.
    pub self_test: Option<SelfTestRecord>,
    /// Result of the trust step.
    pub trust: Option<TrustRecord>,
}

/// An attempt of a step.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Attempt {
    /// Start, UTC, RFC 3339.
    pub started: String,
    /// End; `null` if it was cut off.
    pub ended: Option<String>,
    /// Why it did not count.
    pub broken_off: Option<String>,
}

/// An answer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AnswerRecord {
    /// `yes`, `no` or the text; `null` without an answer.
    pub text: Option<String>,
    /// `terminal`, `command-line`, or `not-asked` without an operator.
    pub from: String,
}

/// Result of the self-test.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SelfTestRecord {
    /// The scenario.
    pub scenario: String,
    /// True if two lockstep runs of the hosted controller gave the same bytes.
    pub repeats: bool,
    /// Control instants in real time.
    pub periods: u64,
    /// Control instants at which the bench was too late.
    pub overruns: u64,
    /// Lateness of samples, µs; each quantile of the worst trial.
    pub lateness_us: Quantiles,
    /// Scheduling of the loop's thread.
    pub scheduling: String,
}

/// Kill rate and false alarms of the scenarios.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TrustRecord {
    /// Number of mutants.
    pub faults: u32,
    /// Mutants caught for a right reason.
    pub caught: u32,
    /// Names of the other mutants.
    pub survived: Vec<String>,
    /// Number of clean runs.
    pub clean_runs: u32,
    /// False alarms in clean runs, and expectations that the hosted controller fails.
    pub false_alarms: u32,
}

/// A requirement and its verdict.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RequirementRecord {
    /// Its identifier.
    pub id: String,
    /// Its text.
    pub text: String,
    /// Over its evidence; `inconclusive` without any.
    pub verdict: Verdict,
    /// Expectations for it.
    pub evidence: Vec<EvidenceRecord>,
}

/// An expectation for a requirement.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EvidenceRecord {
    /// The step.
    pub step: String,
    /// The scenario's file.
    pub scenario: String,
    /// The metric.
    pub metric: String,
    /// The limit.
    pub demanded: String,
    /// The value; `null` without a number.
    pub found: Option<String>,
    /// Its verdict.
    pub verdict: Verdict,
    /// Why it did not pass.
    pub reason: Option<String>,
}

/// The key of a signature.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SignatureRecord {
    /// `ed25519`
    pub algorithm: String,
    /// In PEM, as `openssl pkey -pubout` writes it.
    pub public_key: String,
}

impl StepRecord {
    /// A step that has not started.
    pub(crate) fn new(id: String, title: &str, kind: StepKind) -> Self {
        Self {
            id,
            title: title.to_owned(),
            kind,
            done: false,
            verdict: None,
            reason: None,
            attempts: Vec::new(),
            lost: false,
            run_sha256: None,
            answer: None,
            self_test: None,
            trust: None,
        }
    }
}

impl SessionRecord {
    /// Writes the record to `folder` atomically.
    ///
    /// # Errors
    /// [`AcceptError::Io`].
    pub(crate) fn write(&self, folder: &Path) -> Result<(), AcceptError> {
        let path = folder.join(FILE);
        let mut text = serde_json::to_vec_pretty(self).map_err(|error| AcceptError::io(&path)(error.into()))?;
        text.push(b'\n');
        write_atomically(&path, &text).map_err(AcceptError::io(&path))
    }

    /// Reads the record in `folder`.
    ///
    /// # Errors
    /// [`AcceptError`].
    pub fn read(folder: &Path) -> Result<Self, AcceptError> {
        #[derive(Deserialize)]
        struct FormatVersion {
            format: u32,
        }
        let path = folder.join(FILE);
        let bytes = fs::read(&path).map_err(|_| AcceptError::NoSession(folder.to_owned()))?;
        let content = |message: String| AcceptError::InvalidRecord { path: path.clone(), message };
        let head: FormatVersion = serde_json::from_slice(&bytes).map_err(|error| content(error.to_string()))?;
        if head.format != FORMAT {
            return Err(content(format!("format {}, expected {FORMAT}", head.format)));
        }
        serde_json::from_slice(&bytes).map_err(|error| content(error.to_string()))
    }

    /// A notice for a session without a board; `None` if a board may have been attached.
    pub fn no_board_notice(&self) -> Option<&'static str> {
        match self.rig.parse().ok().filter(|rig| !may_have_board(rig))? {
            RigSpec::Hosted => {
                Some("no board was attached: this record covers the control law on the bench's computer, not a board")
            }
            _ => Some(
                "no board was attached: this record covers the firmware's control law on an emulated processor, not a \
                 board",
            ),
        }
    }

    /// True if a controller was lost or did not confirm 0 V.
    pub fn lost_a_controller(&self) -> bool {
        self.steps.iter().any(|step| step.lost)
    }
}

/// The present time, UTC, RFC 3339 to the second.
pub(crate) fn utc_timestamp() -> String {
    Timestamp::now().strftime("%Y-%m-%dT%H:%M:%SZ").to_string()
}

/// True if a board, and on it a plate, may be connected to the rig. A foreign program may drive one
/// too.
pub(crate) const fn may_have_board(rig: &RigSpec) -> bool {
    match rig {
        RigSpec::Hosted | RigSpec::Emulated(_) => false,
        RigSpec::Exec(_) | RigSpec::Serial { .. } | RigSpec::Probe { .. } => true,
    }
}
