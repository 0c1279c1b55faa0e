//! Traces: what happened in a trial, row by row, as CSV that anybody can read.
//!
//! A row holds the true plate state **at** `t_s` and the drive and frequency applied **from** `t_s` until the next row. Floats are
//! written in the shortest form that parses back to the same double, so that equal trials are equal byte for byte.
//!
//! Neighbours: the runner writes traces, `platebench-verdict` judges them. Nothing here knows what a good trace is.

mod file;
mod row;

pub use file::{Rows, TraceError, Writer, read};
pub use row::{COLUMNS, Column, Flags, Row, UNKNOWABLE};
