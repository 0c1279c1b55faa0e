//! Writes a run as text, for people and for machines.
//!
//! * [`console`]: tables and progress for a terminal.
//! * [`junit`], [`tap`], [`markdown`], [`annotations`], [`events`], [`traceability`]: files and
//!   streams of `docs/formats.md`.
//! * [`comparison`]: a response and its baseline.
//! * `history`: since when an expectation does not pass.
//! * `cost`, `timing`: sentences about computing cost and real time.
//! * `table`, `escape`: one table type, one set of escapes.

pub mod annotations;
pub mod comparison;
pub mod console;
pub(crate) mod cost;
pub(crate) mod escape;
pub mod events;
pub(crate) mod history;
pub mod junit;
pub mod markdown;
mod table;
pub mod tap;
pub(crate) mod timing;
pub mod traceability;

pub use escape::{printable, printable_lines};
pub use table::Table;
