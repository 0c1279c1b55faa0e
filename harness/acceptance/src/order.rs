//! What is to be done in a session, and whom it talks to.

use crate::plan::{AnswerKind, Plan};
use crate::session::StepRecord;
use crate::signature::SecretKey;
use platebench_rig::RigSpec;
use platebench_runner::{Clock, Event, Watch};
use std::path::PathBuf;

/// What is to be done.
#[derive(Debug, Clone)]
pub struct Order {
    /// The plan.
    pub plan: Plan,
    /// What the controller runs on.
    pub rig: RigSpec,
    /// How time passes for the plate.
    pub clock: Clock,
    /// Trials at once.
    pub jobs: usize,
    /// The record's folder.
    pub out: PathBuf,
    /// True where there has to be a session to go on with.
    pub resume: bool,
    /// What was said of the session already.
    pub who: Who,
    /// What the record is signed with.
    pub key: Option<SecretKey>,
}

/// Who, where, and what else there is to say.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Who {
    /// Who does it.
    pub operator: Option<String>,
    /// Where.
    pub place: Option<String>,
    /// What else there is to say.
    pub notes: Option<String>,
}

/// A question to the person.
#[derive(Debug, Clone, Copy)]
pub struct Question<'a> {
    /// What is asked.
    pub text: &'a str,
    /// What kind of answer there is.
    pub kind: AnswerKind,
}

/// What became of a question.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// A person said so: `yes`, `no` or a text.
    Terminal(String),
    /// The command line said so beforehand.
    CommandLine(String),
    /// There was nobody to ask, or nobody answered.
    NotAsked,
}

/// True where a board may hang on the rig, and on the board a plate. What a program of somebody else's drives, nobody knows.
pub(crate) const fn may_have_a_board(rig: &RigSpec) -> bool {
    match rig {
        RigSpec::Hosted | RigSpec::Emulated(_) => false,
        RigSpec::Exec(_) | RigSpec::Serial { .. } | RigSpec::Probe { .. } => true,
    }
}

/// Whom a session talks to.
pub trait Desk {
    /// Asks, and waits for the answer until the session is ended.
    fn ask(&mut self, question: &Question<'_>) -> Answer;
    /// A step begins.
    fn begun(&mut self, step: &StepRecord);
    /// A step has ended.
    fn ended(&mut self, step: &StepRecord);
    /// Something happened in a run.
    fn event(&mut self, event: &Event);
    /// A scenario is about to be played: who looks on, nobody where this is not told.
    fn watch(&mut self, _plan: &platebench_runner::Plan) -> Watch {
        Watch::default()
    }
}
