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
pub mod events;
#[cfg(feature = "screen")]
mod screen;
#[cfg(feature = "screen")]
pub mod view;
#[cfg(not(feature = "screen"))]
#[path = "live/without_screen.rs"]
pub mod view;
#[cfg(feature = "screen")]
mod view_state;

pub use events::{INTERRUPT, LiveViewError, RunDescription, watch_keys};
pub use view::{LiveView, ViewSender};
