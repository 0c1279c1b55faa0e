//! Plays scenarios to a controller, in lockstep, in real time or on a real plate, and stores the
//! results.

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
mod loop_delay;
pub mod operator;
pub mod parallel;
pub mod plan;
mod plant_simulation;
pub mod real_plate;
pub mod real_time;
mod record_file;
pub mod rejudge;
pub mod replay;
mod reply_stats;
mod row_queue;
pub mod run;
mod scheduling;
mod steal_time;
pub mod stored_trials;
mod timing_stats;
mod trend;
pub mod trial;
mod worker;

pub use configure::{configure, law, missing_capability};
pub use fault::wire_fault_kind;
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
