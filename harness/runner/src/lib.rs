//! Playing scenarios to a controller.
//!
//! * [`trial`]: one trial in lockstep: plate state → sample → controller → drive → plate → row.
//! * [`mod@run`]: all trials of all scenarios, over several workers, in an order that no result depends on.
//! * [`folder`]: the run folder: inputs, traces, record.
//! * [`mod@rejudge`]: a stored run, judged again without a rig.
//! * [`event`]: what a run says while it goes on.
//!
//! What is shown of a run belongs to `platebench-report`; exit codes belong to the command line.

mod configure;
pub mod event;
pub mod folder;
pub mod rejudge;
pub mod run;
mod stage;
pub mod trial;

pub use event::Event;
pub use folder::{FolderError, RunFolder};
pub use rejudge::{RejudgeError, rejudge};
pub use run::{Cancel, Plan, RunError, run};
