//! Describes a run: scenarios, clock, hooks and the errors that end it.

use crate::live_tap::LiveTap;
use crate::operator::{NoOperator, Operator};
use crate::real_time::TimeBase;
use platebench_record::{ClockKind, Event, FolderError, Overrides};
use platebench_rig::{BoxedLink, CancelToken, ConnectError, ConnectOptions, RigError, RigSpec};
use platebench_scenario::{Diagnostic, Scenario};
use platebench_trace::TraceError;

/// Connects to a controller: once per worker, and again after a controller was lost.
pub type LinkFactory<'a> = dyn Fn() -> Result<BoxedLink, ConnectError> + Send + Sync + 'a;

/// A run to play.
#[derive(Debug, Clone)]
pub struct RunPlan {
    /// The scenarios, with the overrides applied.
    pub scenarios: Vec<Scenario>,
    /// How many trials may run at once.
    pub jobs: usize,
    /// How time passes for the plate.
    pub clock: Clock,
    /// True if the controller's clock runs while the plate waits.
    pub own_clock: bool,
    /// The rig as named on the command line.
    pub rig: String,
    /// Options of the command line that changed the scenarios.
    pub overrides: Overrides,
}

/// How time passes for the plate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Clock {
    /// The plate waits while a sample travels and the controller computes.
    Lockstep {
        /// True if the rig's wire and computing time acts as loop delay.
        wire_time: bool,
    },
    /// The plate follows the wall clock.
    RealTime(TimeBase),
    /// The controller drives a real plate by its own clock.
    RealPlate,
}

impl Clock {
    /// Its kind, for records.
    pub const fn kind(self) -> ClockKind {
        match self {
            Self::Lockstep { .. } => ClockKind::Lockstep,
            Self::RealTime(_) => ClockKind::RealTime,
            Self::RealPlate => ClockKind::RealPlate,
        }
    }

    /// Connects to a controller on `rig` for this clock.
    ///
    /// # Errors
    /// [`ConnectError`].
    pub fn connect(self, rig: &RigSpec, options: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        match self {
            Self::Lockstep { .. } => rig.connect_with(options),
            Self::RealTime(_) | Self::RealPlate => rig.connect_real_time_with(options),
        }
    }
}

/// Why a run has no record.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A scenario requires what the controller does not have.
    #[error("{0}")]
    Scenario(Box<Diagnostic>),
    /// The rig could not be opened.
    #[error(transparent)]
    Connect(#[from] ConnectError),
    /// The controller does not answer.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// Another controller answered during the run.
    #[error("{found} answers now, the run began with {expected}: expected the same controller until its end")]
    DifferentController {
        /// The controller that answered.
        found: String,
        /// The controller in the record.
        expected: String,
    },
    /// The controller does not announce target pacing.
    #[error("{0} does not announce that it can pace itself, expected --pacing bench")]
    NoTargetPacing(String),
    /// The controller does not announce its own plate.
    #[error("{0} does not announce that it drives its own plate, expected --plate-mode emulated")]
    NoRealPlate(String),
    /// The run folder cannot be written.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// A trace cannot be written.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// The run was cancelled. Its folder holds the trials that were complete.
    #[error("the run was cancelled")]
    Cancelled,
    /// A defect of the bench.
    #[error("the bench has a defect, please report it: {0}")]
    Internal(String),
}

/// What accompanies a run. The default is an operator who is absent, no live view and no events.
pub struct RunHooks<'a> {
    /// Ends the run early.
    pub cancel: CancelToken,
    /// The person at a real plate.
    pub operator: &'a dyn Operator,
    /// Receives the rows of one trial at a time.
    pub live_tap: LiveTap,
    /// Receives every event.
    pub on_event: Box<dyn FnMut(Event) + 'a>,
}

impl Default for RunHooks<'_> {
    fn default() -> Self {
        Self {
            cancel: CancelToken::never(),
            operator: &NoOperator,
            live_tap: LiveTap::default(),
            on_event: Box::new(|_| {}),
        }
    }
}
