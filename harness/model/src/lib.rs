//! Defines scenarios, traces, recordings and the record of a run, and reads and writes their files.

pub mod external_csv;
pub mod metrics;
pub mod record;
pub mod recording;
pub mod scenario;
pub mod trace;
