//! Reads and writes traces. A trace is a CSV file with the rows of one trial.
//!
//! A row contains the plate state **at** `t_s`, and the drive and frequency that act **from** `t_s`
//! until the next row. Floats have the shortest text that gives the same f64 again, so equal trials
//! have equal bytes.

mod atomic_file;
mod file_error;
mod regular_file;
mod row;
mod trace_file;

pub use atomic_file::{AtomicFile, remove_temporary_files, sync_tree, write_atomically, write_new};
pub use file_error::{AtPath, FileError};
pub use regular_file::{MAX_IMAGE_BYTES, MAX_TABLE_BYTES, open_regular_file, read_regular_file, read_text_file};
pub use row::{COLUMNS, Column, Flags, OPTIONAL_COLUMNS, Row};
pub use trace_file::{TraceError, TraceReader, TraceWriter, read_trace};
