//! Plays scenarios to a controller.
//!
//! * [`plan`]: describes a run and its errors.
//! * [`mod@run`]: plays all trials of all scenarios on several workers; `worker`: one of them.
//! * [`trial`]: one trial in lockstep; [`real_time`]: one in real time; [`real_plate`]: one on a real plate.
//! * `plant_simulation`, `controller_log`, `command_checks`: what the first two share.
//! * [`live_tap`]: rows for a live view; [`operator`]: the person at the plate.
//! * [`mod@rejudge`]: judges a stored run without a rig. [`stored_trials`]: its trials; [`comparison`] with a
//!   reference; [`baseline`]: a new reference.
//! * [`delay_boundary`]: the longest loop delay at which a law settles.
//! * `delay_attribution`: excuses what the rig's loop delay makes impossible.
//! * `trend`: compares the cost of control steps with earlier runs.
//!
//! Reports belong to `platebench-report`, exit codes to the command line.

mod abort;
pub mod baseline;
mod command_checks;
pub mod comparison;
mod configure;
mod controller_log;
mod delay_attribution;
pub mod delay_boundary;
mod fault;
pub mod live_tap;
pub mod operator;
pub mod plan;
mod plant_simulation;
pub mod real_plate;
pub mod real_time;
pub mod rejudge;
mod row_queue;
pub mod run;
mod scheduling;
pub mod stored_trials;
mod timing_stats;
mod trend;
pub mod trial;
mod worker;

pub use configure::{configure, law};
pub use live_tap::{LiveTap, TapReader};
pub use operator::{Answer, NoOperator, Operator, Question, QuestionKind};
pub use plan::{Clock, RunError, RunHooks, RunPlan};
pub use plant_simulation::ManualInputs;
pub use platebench_record::Event;
pub use platebench_rig::CancelToken;
pub use real_time::{ManualControl, Pacing, TimeBase};
pub use rejudge::{RejudgeError, rejudge};
pub use run::run;
pub use trend::inputs_digest;
