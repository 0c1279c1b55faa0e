//! What is to be played, how time passes, who looks on, how it is ended early and why it may end without a record.

use crate::folder::FolderError;
use crate::real_plate::Person;
use crate::real_time::Pace;
use crate::trial::Patience;
use crate::watch::Watch;
use platebench_rig::{AnyLink, ConnectError, RigError};
use platebench_scenario::{Diagnostic, Scenario};
use platebench_trace::TraceError;
use platebench_verdict::record::Overrides;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Makes a new link to a controller; called once per worker, and again where a controller was lost.
pub type Connect<'a> = dyn Fn() -> Result<AnyLink, ConnectError> + Send + Sync + 'a;

/// What is to be done.
#[derive(Debug, Clone)]
pub struct Plan {
    /// What is played, with the overrides already applied.
    pub scenarios: Vec<Scenario>,
    /// How many trials may run at once.
    pub jobs: usize,
    /// How time passes for the plate.
    pub clock: Clock,
    /// True where the controller has a clock of its own, which does not wait for the plate's.
    pub own_clock: bool,
    /// The rig as named on the command line.
    pub rig: String,
    /// Options of the command line that changed the scenarios.
    pub overrides: Overrides,
}

/// How time passes for the plate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Clock {
    /// It waits while a sample travels and the controller computes.
    Lockstep {
        /// True where the time that the rig takes acts on the plate as loop delay.
        wire_time: bool,
    },
    /// It does not wait.
    RealTime(Pace),
    /// There is no plate here: the controller drives a real one, by its own clock.
    OwnPlate,
}

impl Clock {
    /// The name in records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Lockstep { .. } => "lockstep",
            Self::RealTime(_) => "real-time",
            Self::OwnPlate => "real-plate",
        }
    }
}

/// A switch that ends a run early, from any thread.
#[derive(Debug, Clone, Default)]
pub struct Cancel(Arc<AtomicBool>);

impl Cancel {
    /// Ends the run: trials that go on are driven to 0 V and given up.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// True once the run is to end.
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

impl Patience for Cancel {
    fn is_over(&self) -> bool {
        self.is_cancelled()
    }
}

/// Why there is no record.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A scenario asks for what the controller does not have.
    #[error("{0}")]
    Scenario(Box<Diagnostic>),
    /// There is no line to a controller.
    #[error(transparent)]
    Connect(#[from] ConnectError),
    /// The controller does not answer.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The record names one controller.
    #[error("{found} answers now, the run began with {expected}: expected the same controller until its end")]
    OtherController {
        /// Who answers.
        found: String,
        /// Who is in the record.
        expected: String,
    },
    /// The controller has no timer of its own to pace the plate by.
    #[error("{0} does not say that it can pace itself, expected --pacing bench")]
    NoPace(String),
    /// The controller has no plate of its own.
    #[error("{0} does not say that it drives a plate of its own, expected --plate-mode emulated")]
    NoPlate(String),
    /// The run folder cannot be written.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// A trace cannot be written.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// The run was ended early; what was whole by then is in the run folder.
    #[error("the run was ended early")]
    Cancelled,
    /// A fault of the bench itself.
    #[error("the bench has a fault of its own, please report it: {0}")]
    Bench(String),
}

/// Who is there while a run goes on.
#[derive(Clone, Copy)]
pub struct Company<'a> {
    /// Somebody at the plate, where that is a real one.
    pub person: &'a dyn Person,
    /// Somebody who looks on: of trials that go on at once at one of them.
    pub watch: &'a Watch,
}
