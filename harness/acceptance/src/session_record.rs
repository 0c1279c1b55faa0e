//! `session.json`: what is known of a session at any time.

use crate::error::AcceptError;
use jiff::Timestamp;
use platebench_record::Verdict;
use platebench_record::{Firmware, Host, InputRecord, Quantiles, Tool};
use platebench_rig::RigSpec;
use platebench_trace::write_atomically;
use serde::{Deserialize, Serialize};
use std::fs;
use std::path::Path;

/// The record's name in its folder.
pub const FILE: &str = "session.json";
/// The plan's copy in the record's folder.
pub(crate) const PLAN: &str = "plan.toml";
/// The folder that holds the steps' folders.
pub(crate) const STEPS: &str = "steps";
/// Version of the format; readers refuse others.
pub const FORMAT: u32 = 1;

/// A whole session.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SessionRecord {
    /// Version of this format.
    pub format: u32,
    /// Over requirements, scenarios, the bench's self-test and what was confirmed; `inconclusive` until the session is complete.
    pub verdict: Verdict,
    /// True once every step has ended and all is judged.
    pub complete: bool,
    /// What is accepted, from the plan.
    pub title: String,
    /// Who did it; `null` where nobody said.
    pub operator: Option<String>,
    /// Where; `null` where nobody said.
    pub place: Option<String>,
    /// What else there is to say; `null` where nobody said anything.
    pub notes: Option<String>,
    /// When it was begun, UTC, RFC 3339.
    pub started: String,
    /// When it ended; `null` until then.
    pub finished: Option<String>,
    /// When it was taken up again after it had been cut off.
    pub resumed: Vec<String>,
    /// The bench.
    pub bench: BenchRecord,
    /// The rig as named on the command line.
    pub rig: String,
    /// How time passed for the plate.
    pub clock: ClockRecord,
    /// The controller as it introduced itself; `null` until it did.
    pub firmware: Option<FirmwareRecord>,
    /// The copy of the plan.
    pub plan: InputRecord,
    /// Every file that goes into the scenarios, by scenario: the scenario, then its plate and whatever else it names.
    pub inputs: Vec<InputRecord>,
    /// What was to be done and what came of it, in order.
    pub steps: Vec<StepRecord>,
    /// What had to hold and whether it does; empty until all is judged.
    pub requirements: Vec<RequirementRecord>,
    /// The key that the manifest was signed with; `null` where it was not.
    pub signature: Option<SignatureRecord>,
}

/// The bench that a session was made with.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BenchRecord {
    /// Name and version.
    pub tool: Tool,
    /// SHA-256 of the program, hexadecimal.
    pub sha256: String,
    /// The computer.
    pub host: Host,
}

/// How time passed for the plate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClockRecord {
    /// `lockstep` or `real-time`.
    pub name: String,
    /// Plate seconds per wall second; 1 in lockstep.
    pub time_scale: f64,
    /// Whose timer makes the control instants.
    pub pacing: String,
}

/// The controller as it introduced itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FirmwareRecord {
    /// Name, version, build, chip.
    #[serde(flatten)]
    pub firmware: Firmware,
    /// The chip's own number, hexadecimal; zero for a program on a computer.
    pub unique: String,
    /// SHA-256 of the image that the bench loaded, hexadecimal; `null` where the rig brings its own.
    pub image_sha256: Option<String>,
}

/// What kind of step it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StepKind {
    /// Who is on the rig.
    Identity,
    /// A question to the person.
    Ask,
    /// The bench's own timing and repeatability.
    SelfTest,
    /// How well the plan's scenarios catch faulty controllers.
    Trust,
    /// A scenario.
    Scenario,
}

/// One step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StepRecord {
    /// Number and name, which is also its folder below `steps`.
    pub id: String,
    /// What it does.
    pub title: String,
    /// What kind of step it is.
    pub kind: StepKind,
    /// True once it has ended. It is then never done again.
    pub done: bool,
    /// What it says of the session; `null` where it decides nothing or has not ended.
    pub verdict: Option<Verdict>,
    /// Why it does not pass, or what it found, in a sentence.
    pub reason: Option<String>,
    /// Each time that it was begun.
    pub attempts: Vec<Attempt>,
    /// True where the controller was lost, or did not confirm 0 V.
    pub lost: bool,
    /// SHA-256 of the `run.json` that it left, hexadecimal, where it played a scenario.
    pub run_sha256: Option<String>,
    /// What was answered, where something was asked.
    pub answer: Option<AnswerRecord>,
    /// What the bench found of itself.
    pub self_test: Option<SelfTestRecord>,
    /// How often the plan's scenarios are wrong.
    pub trust: Option<TrustRecord>,
}

/// One time that a step was begun.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Attempt {
    /// When, UTC, RFC 3339.
    pub started: String,
    /// When it ended; `null` where it was cut off.
    pub ended: Option<String>,
    /// Why it did not count, where that is known.
    pub broken_off: Option<String>,
}

/// What was answered.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AnswerRecord {
    /// `yes`, `no` or the text; `null` where there is none.
    pub text: Option<String>,
    /// How it came: `terminal`, `command-line`, or `not-asked` where nobody was there.
    pub from: String,
}

/// What the bench found of itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SelfTestRecord {
    /// What it was played with.
    pub scenario: String,
    /// Whether two runs in lockstep with the bench's own controller left the same bytes.
    pub repeats: bool,
    /// Control instants in real time.
    pub periods: u64,
    /// Of these, those for which the bench was too late.
    pub overruns: u64,
    /// How late samples left the bench, µs: of each quantile the worst trial's.
    pub lateness_us: Quantiles,
    /// How the loop's thread was scheduled.
    pub scheduling: String,
}

/// How often the plan's scenarios are wrong.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TrustRecord {
    /// Faulty controllers that were played.
    pub faults: u32,
    /// Of these, caught for a right reason.
    pub caught: u32,
    /// Names of the others.
    pub survived: Vec<String>,
    /// Clean runs that were played.
    pub clean_runs: u32,
    /// Of these, called faulty, and expectations of the plan's scenarios as they stand that the bench's own controller fails.
    pub false_alarms: u32,
}

/// What had to hold and whether it does.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RequirementRecord {
    /// Its identifier.
    pub id: String,
    /// What it says.
    pub text: String,
    /// Over its evidence; `inconclusive` without any.
    pub verdict: Verdict,
    /// Expectations that hold it.
    pub evidence: Vec<EvidenceRecord>,
}

/// One expectation that holds a requirement.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EvidenceRecord {
    /// The step.
    pub step: String,
    /// The scenario's file.
    pub scenario: String,
    /// The metric.
    pub metric: String,
    /// What was demanded.
    pub demanded: String,
    /// What was found; `null` where there is no number.
    pub found: Option<String>,
    /// How it ended, with its cause.
    pub verdict: Verdict,
    /// Why it did not pass.
    pub reason: Option<String>,
}

/// The key that a manifest was signed with.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SignatureRecord {
    /// `ed25519`
    pub algorithm: String,
    /// In PEM, as `openssl pkey -pubout` writes it.
    pub public_key: String,
}

impl StepRecord {
    /// A step that has not been begun.
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
    /// Writes the record into `folder`, as a whole and for good.
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
    /// [`AcceptError`] where there is none of this format.
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

    /// What the record is about where no board was attached; `None` where one may have been.
    pub fn no_board_notice(&self) -> Option<&'static str> {
        match self.rig.parse().ok().filter(|rig| !may_have_board(rig))? {
            RigSpec::Hosted => Some(
                "no board was attached: this record is about the control law on the bench's own computer and says nothing of a board",
            ),
            _ => Some(
                "no board was attached: this record is about the firmware's control law on an emulated processor, on the bench's own computer, and says nothing of a board",
            ),
        }
    }

    /// True where a controller was lost, or did not confirm 0 V.
    pub fn lost_a_controller(&self) -> bool {
        self.steps.iter().any(|step| step.lost)
    }
}

/// The present time, UTC, RFC 3339 to the second.
pub(crate) fn utc_timestamp() -> String {
    Timestamp::now().strftime("%Y-%m-%dT%H:%M:%SZ").to_string()
}

/// True if a board, and on it a plate, may be connected to the rig. A foreign program may drive one too.
pub(crate) const fn may_have_board(rig: &RigSpec) -> bool {
    match rig {
        RigSpec::Hosted | RigSpec::Emulated(_) => false,
        RigSpec::Exec(_) | RigSpec::Serial { .. } | RigSpec::Probe { .. } => true,
    }
}
