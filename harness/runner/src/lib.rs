//! Playing scenarios to a controller.
//!
//! * [`trial`]: one trial in lockstep: plate state → sample → controller → drive → plate → row.
//! * [`real_time`]: the same with a clock that does not wait.
//! * [`real_plate`]: the same on a plate that the controller drives itself.
//! * [`plan`]: what is to be played, how time passes, and how it is ended early.
//! * [`mod@run`]: all trials of all scenarios, over several workers, in an order that no result depends on.
//! * `worker`: one of them, with a link to a controller of its own.
//! * [`folder`]: the run folder: inputs, traces, record.
//! * [`mod@rejudge`]: a stored run, judged again without a rig.
//! * `trend`: what a control step costs, beside earlier runs.
//! * [`fidelity`]: how far each tier of the plate is from the exact one, measured.
//! * [`event`]: what a run says while it goes on.
//! * [`mod@watch`]: whoever looks on meanwhile.
//!
//! What is shown of a run belongs to `platebench-report`; exit codes belong to the command line.

mod accounting;
mod configure;
mod end;
pub mod event;
mod fault;
pub mod fidelity;
pub mod folder;
mod measured;
mod observed;
pub mod plan;
mod queue;
pub mod real_plate;
pub mod real_time;
pub mod rejudge;
pub mod run;
mod scheduling;
mod stage;
mod trend;
pub mod trial;
pub mod watch;
mod worker;

pub use configure::configure;
pub use configure::law;
pub use event::Event;
pub use folder::{FolderError, RunFolder};
pub use plan::{Cancel, Clock, Company, Plan, RunError};
pub use real_plate::{Answer, Nobody, Person};
pub use real_time::{Hand, Pace, Pacing};
pub use rejudge::{RejudgeError, rejudge};
pub use run::{run, run_in_company};
pub use stage::Held;
pub use trend::inputs_digest;
pub use watch::{Viewer, Watch};
