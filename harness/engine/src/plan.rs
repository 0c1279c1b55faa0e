//! Describes a run: scenarios, clock, operator, hooks and the errors that end it.

use crate::live_tap::LiveTap;
use crate::timing::{Pacing, TimeBase};
use platebench_model::quoted;
use platebench_model::record::{ClockKind, Event, FolderError, Overrides};
use platebench_model::scenario::{Diagnostic, Scenario};
use platebench_model::trace::TraceError;
use platebench_plate::Time;
use platebench_rig::{BoxedLink, CancelToken, ConnectError, ConnectOptions, FaultInjector, RigError, RigSpec, Session};
use std::sync::Mutex;

/// Connects to the controller. An executor calls it at its start and after it has lost the
/// controller.
pub type LinkFactory<'a, L = BoxedLink> = dyn Fn() -> Result<L, ConnectError> + Send + Sync + 'a;

pub type RigSession<L = BoxedLink> = Session<FaultInjector<L>>;

#[derive(Debug, Clone)]
pub struct RunPlan {
    /// Scenarios to which the overrides are already applied.
    pub scenarios: Vec<Scenario>,
    pub jobs: usize,
    pub clock: Clock,
    pub own_clock: bool,
    pub rig: String,
    pub overrides: Overrides,
}

impl RunPlan {
    pub fn new(rig: &RigSpec, clock: Clock, jobs: usize, scenarios: Vec<Scenario>, overrides: Overrides) -> Self {
        Self { scenarios, jobs, clock, own_clock: rig.has_own_clock(), rig: rig.to_string(), overrides }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Clock {
    Lockstep {
        /// True if the rig's wire time and computing time act as loop delay.
        wire_time: bool,
    },
    RealTime(TimeBase),
    RealPlate,
}

impl Clock {
    /// Clock of a run whose user selects none, see [`RigSpec::default_clock`].
    pub fn default_for(rig: &RigSpec) -> Self {
        match rig.default_clock() {
            ClockKind::Lockstep => Self::Lockstep { wire_time: false },
            ClockKind::RealTime => Self::RealTime(TimeBase { time_scale: 1.0, pacing: Pacing::Bench }),
            ClockKind::RealPlate => Self::RealPlate,
        }
    }

    pub const fn kind(self) -> ClockKind {
        match self {
            Self::Lockstep { .. } => ClockKind::Lockstep,
            Self::RealTime(_) => ClockKind::RealTime,
            Self::RealPlate => ClockKind::RealPlate,
        }
    }

    pub fn connect(self, rig: &RigSpec, options: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        match self {
            Self::Lockstep { .. } => rig.connect_with(options),
            Self::RealTime(_) | Self::RealPlate => rig.connect_real_time_with(options),
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum RunError {
    #[error("{0}")]
    Scenario(Box<Diagnostic>),
    #[error(transparent)]
    Connect(#[from] ConnectError),
    #[error(transparent)]
    Rig(RigError),
    #[error("{file}: {error}")]
    Refused { file: String, error: RigError },
    #[error("the controller is now {found}, but was {expected} when the run began; keep the same controller connected")]
    DifferentController { found: String, expected: String },
    #[error("{file} was changed during the run; keep the program or image until the run ends")]
    DifferentProgram { file: String },
    #[error("{} does not announce that it can pace itself, which --pacing target needs; use --pacing bench", quoted(.0))]
    NoTargetPacing(String),
    #[error(
        "{} does not announce that it drives its own plate, which --plate-mode real needs; use --plate-mode emulated",
        quoted(.0)
    )]
    NoRealPlate(String),
    #[error(transparent)]
    Folder(#[from] FolderError),
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error("the connection to the controller failed in {0} consecutive trials; check the controller and its line")]
    Lost(u32),
    #[error("{trials} consecutive trials ended with: {error}")]
    Rejected { trials: u32, error: RigError },
    #[error("the run was cancelled")]
    Cancelled,
    #[error("the bench has a defect, please report it: {0}")]
    Internal(String),
}

impl From<RigError> for RunError {
    fn from(error: RigError) -> Self {
        if matches!(error, RigError::Cancelled) { Self::Cancelled } else { Self::Rig(error) }
    }
}

pub struct RunHooks<'a> {
    pub cancel: CancelToken,
    pub operator: &'a dyn Operator,
    pub live_tap: LiveTap,
    pub on_event: Box<dyn FnMut(Event) + 'a>,
    /// The events of this number of first trials of each scenario contain the rows.
    pub trials_with_rows: usize,
    /// Session that the run takes over and leaves at 0 V, for a controller that keeps its history
    /// over several runs.
    pub kept_session: Option<&'a Mutex<Option<RigSession>>>,
}

impl Default for RunHooks<'_> {
    fn default() -> Self {
        Self {
            cancel: CancelToken::never(),
            operator: &NoOperator,
            live_tap: LiveTap::default(),
            on_event: Box::new(|_| {}),
            trials_with_rows: 0,
            kept_session: None,
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub struct Question<'a> {
    pub text: &'a str,
    pub kind: QuestionKind,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum QuestionKind {
    /// Asks for an action. The operator answers `yes` after it.
    Action,
    Confirm,
    Text,
    Number,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    Terminal(String),
    /// An option on the command line gave this answer in advance.
    CommandLine(String),
    /// No operator is present, none answered in time, or the question was cancelled.
    Absent,
}

impl Answer {
    pub fn text(&self) -> Option<&str> {
        match self {
            Self::Terminal(text) | Self::CommandLine(text) => Some(text),
            Self::Absent => None,
        }
    }

    pub fn is_yes(&self) -> bool {
        self.text() == Some("yes")
    }
}

/// Only [`Operator::ask`] may wait, because the trial continues during the other calls.
pub trait Operator: Sync {
    /// Waits for the answer until `cancel` is cancelled, or for a bounded time.
    fn ask(&self, question: Question<'_>, cancel: &CancelToken) -> Answer;

    /// `seconds` is the time until the action. 0 means that the action is due now.
    fn announce(&self, _action: &str, _seconds: u32) {}

    fn show_force(&self, _now: Time, _demanded_n: f64, _measured_n: Option<f64>) {}

    fn trial_ended(&self) {}
}

/// Never answers, so expectations that need an operator become inconclusive.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoOperator;

impl Operator for NoOperator {
    fn ask(&self, _question: Question<'_>, _cancel: &CancelToken) -> Answer {
        Answer::Absent
    }
}
