//! Shows the signals of a running trial in the terminal.
//!
//! ```text
//!   trial loop ── LiveTap ── lock-free queue ── ViewThread: ViewState ── draw ── Screen
//!   standard error ── pipe ── StderrCapture ────────┘
//! ```
//!
//! `view_state` and `signal_history` decimate the trial to the resolution of a screen; `draw` knows
//! no terminal; the thread of [`view`] never blocks the run.
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
