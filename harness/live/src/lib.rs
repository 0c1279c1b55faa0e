//! The live view: what passes between bench, controller and plate, in the terminal that the bench was started in.
//!
//! ```text
//!   loop ── Tap ── queue without locks ── View's thread: Scope ── draw ── Screen
//!   standard error ── pipe ── Diverted ─────────┘
//! ```
//!
//! * [`subject`]: what is looked at, known beforehand.
//! * `scope`, `history`: what was seen so far, thinned out to what a screen can show.
//! * `draw`: a picture of it; nothing there knows a terminal.
//! * `screen`, `diverted`: the terminal, taken and given back.
//! * [`view`]: the thread that looks, draws and never holds anybody up.
//!
//! Nothing is judged and nothing is recorded here; where a picture cannot be drawn the run goes on without one.

mod diverted;
mod draw;
mod history;
mod scope;
mod screen;
pub mod subject;
pub mod view;

pub use subject::{Show, Subject};
pub use view::{INTERRUPT, NoView, Teller, Told, View, watch_keys};
