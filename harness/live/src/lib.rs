//! Shows the signals of a running trial in the terminal.
//!
//! ```text
//!   trial loop ── LiveTap ── lock-free queue ── ViewThread: ViewState ── draw ── Screen
//!   standard error ── pipe ── StderrCapture ────────┘
//! ```
//!
//! * [`run_description`]: scenarios and rig, known before the run.
//! * `view_state`, `signal_history`: the trial so far, decimated to the resolution of a screen.
//! * `draw`: draws the state; knows no terminal.
//! * `screen`, `stderr_capture`: take the terminal and restore it.
//! * [`view`]: the thread that reads, draws and never blocks the run; [`view_event`]: events that it shows.
//!
//! This crate judges and records nothing. If it cannot draw, the run continues without it.

mod draw;
pub mod error;
pub mod run_description;
mod screen;
mod signal_history;
mod stderr_capture;
pub mod view;
pub mod view_event;
mod view_state;

pub use error::LiveViewError;
pub use run_description::{RunDescription, ScenarioDescription};
pub use view::{INTERRUPT, LiveView, ViewSender, watch_keys};
pub use view_event::ViewEvent;
