//! Writes a run as text, for people and for machines.

pub mod annotations;
pub mod board_matrix;
pub mod comparison;
pub mod console;
pub(crate) mod cost;
pub(crate) mod escape;
pub mod events;
pub(crate) mod history;
pub mod junit;
pub mod markdown;
pub mod replay;
pub mod scenario_list;
pub mod tap;
pub(crate) mod timing;
pub mod traceability;
pub mod tube_plot;

pub use escape::{printable, printable_lines};
