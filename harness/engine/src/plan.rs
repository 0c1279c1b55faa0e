//! Describes a run: scenarios, clock, hooks and the errors that end it.

use crate::live_tap::LiveTap;
use crate::operator::{NoOperator, Operator};
use crate::real_time::TimeBase;
use platebench_model::record::{ClockKind, Event, FolderError, Overrides};
use platebench_model::scenario::{Diagnostic, Scenario};
use platebench_model::trace::TraceError;
use platebench_rig::{BoxedLink, CancelToken, ConnectError, ConnectOptions, RigError, RigSpec};

/// Connects to the controller. An executor calls it at its start and after it has lost the
/// controller.
pub type LinkFactory<'a, L = BoxedLink> = dyn Fn() -> Result<L, ConnectError> + Send + Sync + 'a;

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
    Rig(#[from] RigError),
    #[error("the controller is now {found}, but was {expected} when the run began; keep the same controller connected")]
    DifferentController { found: String, expected: String },
    #[error("{0} does not announce that it can pace itself, which --pacing target needs; use --pacing bench")]
    NoTargetPacing(String),
    #[error(
        "{0} does not announce that it drives its own plate, which --plate-mode real needs; use --plate-mode emulated"
    )]
    NoRealPlate(String),
    #[error(transparent)]
    Folder(#[from] FolderError),
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error("the connection to the controller failed in {0} consecutive trials; check the controller and its line")]
    Lost(u32),
    #[error("the run was cancelled")]
    Cancelled,
    #[error("the bench has a defect, please report it: {0}")]
    Internal(String),
}

pub struct RunHooks<'a> {
    pub cancel: CancelToken,
    pub operator: &'a dyn Operator,
    pub live_tap: LiveTap,
    pub on_event: Box<dyn FnMut(Event) + 'a>,
    /// The events of this number of first trials of each scenario contain the rows.
    pub trials_with_rows: usize,
}

impl Default for RunHooks<'_> {
    fn default() -> Self {
        Self {
            cancel: CancelToken::never(),
            operator: &NoOperator,
            live_tap: LiveTap::default(),
            on_event: Box::new(|_| {}),
            trials_with_rows: 0,
        }
    }
}
