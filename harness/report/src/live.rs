//! Shows the signals of a running trial in the terminal.
//!
//! ```text
//!   trial loop ── LiveTap ── lock-free queue ── ViewThread: ViewState ── draw ── Screen
//!   standard error ── pipe ── StderrCapture ────────┘
//! ```
//!
//! The thread of [`view`] never blocks the run. If the view cannot draw, the run continues without
//! it.

#![cfg_attr(not(feature = "screen"), allow(dead_code))]

#[cfg(feature = "screen")]
mod draw;
pub mod error;
mod keys;
pub mod run_description;
#[cfg(feature = "screen")]
mod screen;
#[cfg(feature = "screen")]
mod signal_history;
#[cfg(feature = "screen")]
mod stderr_capture;
#[cfg(feature = "screen")]
pub mod view;
#[cfg(not(feature = "screen"))]
#[path = "live/without_screen.rs"]
pub mod view;
pub mod view_event;
#[cfg(feature = "screen")]
mod view_state;

pub use error::LiveViewError;
pub use keys::{INTERRUPT, watch_keys};
pub use run_description::{RunDescription, ScenarioDescription};
pub use view::{LiveView, ViewSender};
pub use view_event::ViewEvent;
