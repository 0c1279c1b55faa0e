//! Plays scenarios in lockstep, in real time or on a real plate, and stores the results.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

mod applicability;
pub mod comparison;
mod controller_log;
pub mod delay_boundary;
pub mod executor;
mod firmware_digest;
pub mod live_tap;
pub mod lockstep;
pub mod plan;
mod plant_simulation;
pub mod real_plate;
pub mod real_time;
pub mod rejudge;
pub mod replay;
pub mod run;
mod run_player;
mod run_recorder;
mod timing;
mod trend;
pub mod trial;
pub mod workers;

pub use applicability::why_not_applicable;
pub use executor::{Executor, ExecutorSettings, MAX_LOSSES, SafeEnds, ScenarioEnd};
pub use firmware_digest::FirmwareDigest;
pub use live_tap::{LiveTap, TapReader};
pub use plan::{
    Answer, Clock, LinkFactory, NoOperator, Operator, Question, QuestionKind, RigSession, RunError, RunHooks, RunPlan,
};
pub use plant_simulation::{ManualControl, ManualInputs};
pub use platebench_model::record::Event;
pub use platebench_rig::CancelToken;
pub use rejudge::{RejudgeError, rejudge};
pub use run::run;
pub use timing::{Pacing, TimeBase};
pub use trial::{Trial, TrialResult, configure, law, law_names};
