//! Defines `session.json`, the state of a session, and the errors of a session.

use platebench_engine::{RejudgeError, RunError};
use platebench_experiments::trust::TrustError;
use platebench_model::record::{Firmware, Host, InputRecord, Quantiles, Tool, Verdict};
use platebench_model::scenario::Diagnostic;
use platebench_model::trace::{AtPath, FileError, read_regular_file, write_atomically};
use platebench_rig::{Capability, RigSpec};
use platebench_verdict::uncertainty::{CombinedUncertainty, Conformity, DecisionRule};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::io;
use std::path::{Path, PathBuf};

/// Largest record of a session.
const MAX_RECORD_BYTES: u64 = 1 << 30;
pub const FILE: &str = "session.json";
pub(crate) const PLAN: &str = "plan.toml";
pub(crate) const BUDGET: &str = "budget.toml";
pub(crate) const STEPS: &str = "steps";
pub const FORMAT: u32 = 1;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SessionRecord {
    pub format: u32,
    /// Combined verdict of requirements, scenarios, self-test and confirmations; `inconclusive`
    /// until all are judged.
    pub verdict: Verdict,
    /// True if every step has ended and the session is judged.
    pub complete: bool,
    pub title: String,
    #[serde(flatten)]
    pub details: SessionDetails,
    /// Time in UTC, format RFC 3339. All times of a record have this format.
    pub started: String,
    pub finished: Option<String>,
    pub resumed: Vec<String>,
    pub bench: BenchRecord,
    pub rig: String,
    pub clock: ClockRecord,
    /// `null` until the first step has identified the controller.
    pub firmware: Option<FirmwareRecord>,
    pub plan: InputRecord,
    /// `None` if the plan has no decision rule. Verdicts then ignore measurement uncertainty.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub decision: Option<DecisionRecord>,
    /// Scenarios in the order of the plan. The plate and profiles of a scenario follow it.
    pub inputs: Vec<InputRecord>,
    pub steps: Vec<StepRecord>,
    /// Empty until the session is judged.
    pub requirements: Vec<RequirementRecord>,
    /// True if the session was started or resumed with a key, so that its record must be signed.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub must_be_signed: bool,
    pub signature: Option<SignatureRecord>,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct SessionDetails {
    pub operator: Option<String>,
    pub place: Option<String>,
    pub notes: Option<String>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct BenchRecord {
    pub tool: Tool,
    /// SHA-256 of the program, hexadecimal.
    pub sha256: String,
    pub host: Host,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ClockRecord {
    /// `lockstep` or `real-time`.
    pub name: String,
    /// Plate seconds per wall second; 1 in lockstep.
    pub time_scale: f64,
    /// Timer that makes the control instants: `bench` or `target`.
    pub pacing: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct FirmwareRecord {
    #[serde(flatten)]
    pub firmware: Firmware,
    /// Serial number of the chip, hexadecimal. Zero if the controller is a program.
    pub unique: String,
    /// SHA-256 of the firmware image, hexadecimal. `null` if the bench does not load the image.
    pub image_sha256: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum StepKind {
    Identity,
    Ask,
    SelfTest,
    Trust,
    Scenario,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct StepRecord {
    /// Number and name, such as `03-self-test`; also the name of the step's folder below `steps`.
    pub id: String,
    pub title: String,
    pub kind: StepKind,
    /// True if the step has ended. A resumed session does not repeat it.
    pub done: bool,
    pub verdict: Option<Verdict>,
    /// Reason if the step did not pass, else a short summary of its result.
    pub reason: Option<String>,
    pub attempts: Vec<Attempt>,
    /// True if the controller was lost, or did not confirm 0 V and no failure explains it.
    pub lost: bool,
    /// SHA-256 of the step's `run.json`, hexadecimal.
    pub run_sha256: Option<String>,
    pub answer: Option<AnswerRecord>,
    pub self_test: Option<SelfTestRecord>,
    pub trust: Option<TrustRecord>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Attempt {
    pub started: String,
    /// `null` if the bench stopped during the attempt.
    pub ended: Option<String>,
    /// Error that ended the attempt. An attempt with an error does not count.
    pub broken_off: Option<String>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct AnswerRecord {
    /// `yes`, `no` or the text; `null` without an answer.
    pub text: Option<String>,
    /// `terminal`, `command-line`, or `not-asked` without an operator.
    pub from: String,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SelfTestRecord {
    pub scenario: String,
    /// True if two lockstep runs of the hosted controller gave equal traces.
    pub repeats: bool,
    pub periods: u64,
    pub overruns: u64,
    /// Lateness of samples, µs. Each quantile is the largest of all trials.
    pub lateness_us: Quantiles,
    pub scheduling: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct TrustRecord {
    pub faults: u32,
    /// Number of faults that were caught for a right reason.
    pub caught: u32,
    pub survived: Vec<String>,
    pub clean_runs: u32,
    /// Failures of correct controllers in the clean runs and in the unmodified scenarios.
    pub false_alarms: u32,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct DecisionRecord {
    pub rule: DecisionRule,
    pub title: String,
    pub coverage: f64,
    pub instruments: Vec<InstrumentRecord>,
    pub budget: InputRecord,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct InstrumentRecord {
    pub name: String,
    pub serial: String,
    pub certificate: Option<String>,
    pub calibrated: String,
    pub due: String,
    /// True if the calibration was not valid at the start and the operator waived it.
    pub waived: bool,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct EvidenceUncertainty {
    pub value: f64,
    /// Value ± expanded uncertainty.
    pub interval: [f64; 2],
    /// Probability that the true value is outside the limits, given only the uncertainty.
    pub outside_probability: f64,
    pub conformity: Conformity,
    pub combined: CombinedUncertainty,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RequirementRecord {
    pub id: String,
    pub text: String,
    /// Combined verdict of the evidence; `inconclusive` without evidence.
    pub verdict: Verdict,
    pub evidence: Vec<EvidenceRecord>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct EvidenceRecord {
    pub step: String,
    pub scenario: String,
    pub metric: String,
    pub demanded: String,
    /// Measured value with its unit; `null` if there is no value.
    pub found: Option<String>,
    pub verdict: Verdict,
    pub reason: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uncertainty: Option<EvidenceUncertainty>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct SignatureRecord {
    pub algorithm: String,
    /// In PEM, as `openssl pkey -pubout` writes it.
    pub public_key: String,
}

impl StepRecord {
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
    pub(crate) fn write(&self, folder: &Path) -> Result<(), AcceptError> {
        let mut text = serde_json::to_vec_pretty(self).map_err(io::Error::from).at(&folder.join(FILE))?;
        text.push(b'\n');
        Ok(write_file(folder, FILE, &text)?)
    }

    pub fn read(folder: &Path) -> Result<Self, AcceptError> {
        #[derive(Deserialize)]
        struct FormatVersion {
            format: u32,
        }
        let path = folder.join(FILE);
        let bytes = match read_regular_file(&path, MAX_RECORD_BYTES) {
            Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
                return Err(AcceptError::NoSession(folder.to_owned()));
            }
            read => read.at(&path)?,
        };
        let content = |message: String| AcceptError::InvalidRecord { path: path.clone(), message };
        let head: FormatVersion = serde_json::from_slice(&bytes).map_err(|error| content(error.to_string()))?;
        if head.format != FORMAT {
            return Err(content(format!("the record has format {}, expected {FORMAT}", head.format)));
        }
        serde_json::from_slice(&bytes).map_err(|error| content(error.to_string()))
    }

    /// Returns the notice of a record without a board. `None` if a board may have been attached.
    pub fn no_board_notice(&self) -> Option<&'static str> {
        let rig = self.rig.parse().ok().filter(RigSpec::is_simulated)?;
        Some(if rig.has(Capability::EmulatedChip) {
            "no board was attached: this record covers the firmware's control law on an emulated processor, not a board"
        } else {
            "no board was attached: this record covers the control law on the bench's computer, not a board"
        })
    }

    pub fn lost_a_controller(&self) -> bool {
        self.steps.iter().any(|step| step.lost)
    }
}

pub(crate) fn write_file(folder: &Path, name: &str, content: &[u8]) -> Result<(), FileError> {
    let path = folder.join(name);
    write_atomically(&path, content).at(&path)
}

#[derive(Debug, thiserror::Error)]
pub enum AcceptError {
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Plan(Vec<Diagnostic>),
    #[error(transparent)]
    File(#[from] FileError),
    #[error(
        "{what} is {now}, but the session was started with {then}; restore it, or start a new session with another \
         --out FOLDER"
    )]
    Changed { what: String, then: String, now: String },
    #[error("the session was started with --sign, so its record must be signed; resume it with --sign KEYFILE")]
    NotSigned,
    #[error("{} contains a finished session, which cannot be changed; name a new folder", .0.display())]
    Finished(PathBuf),
    #[error("{} contains files that belong to no acceptance session; name a new folder", .0.display())]
    FolderNotEmpty(PathBuf),
    #[error("another session is writing {}; wait until it ends, or name another folder", .0.display())]
    InUse(PathBuf),
    #[error("{}: contains no session, expected a folder that `platebench acceptance run` wrote", .0.display())]
    NoSession(PathBuf),
    #[error("{}: {message}", path.display())]
    InvalidRecord { path: PathBuf, message: String },
    #[error("{}: not the expected ed25519 key in PEM: {message}", path.display())]
    Key { path: PathBuf, message: String },
    #[error(
        "{instrument}: its calibration is valid from {calibrated} to {due}, but not today; calibrate the instrument, \
         or waive this with --waive-calibration NAME, which the record states"
    )]
    InvalidCalibration { instrument: String, calibrated: String, due: String },
    #[error(
        "--waive-calibration {0}: the budget has no instrument with this name, expected the name of an [[instrument]]"
    )]
    UnknownInstrument(String),
    #[error(transparent)]
    Run(#[from] RunError),
    #[error(transparent)]
    Rejudge(#[from] RejudgeError),
    #[error(transparent)]
    Trust(#[from] TrustError),
    #[error("stopped at \"{0}\": the answer was no; resume the session when the answer is yes")]
    AnsweredNo(String),
    #[error(
        "stopped at \"{question}\": no answer, and {rig} may drive a plate; answer at a terminal, or \
         confirm beforehand with --yes"
    )]
    Unanswered { question: String, rig: String },
    #[error("the session was cancelled")]
    Cancelled,
}
