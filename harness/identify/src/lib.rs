//! Plate parameters from recorded responses (section IV of the paper).
//!
//! * [`recording`]: what drove the plate and what was seen of it, from a trace.
//! * `telemetry`: the same from a foreign table whose columns are named.
//! * [`mod@arx`]: the paper's method, order one, by least squares and by instrumental variables.
//! * [`fit`]: the exact response held against every sample: the answer.
//! * [`estimate`]: intervals, and whether residuals are white.
//! * [`steps`], [`identification`]: Tables I and II and the plate, from all recordings together.
//! * `shown`: the tables as text, the plate as a file.
//!
//! Neighbours: `platebench-plate` propagates, `platebench-trace` reads traces. Nothing here knows a scenario, and nothing is judged.

pub mod arx;
mod doubt;
pub mod estimate;
pub mod external_csv;
pub mod fit;
pub mod identification;
pub mod recording;
pub mod steps;
pub mod table;

pub use arx::{ArxMethod, ArxModel, arx};
pub use doubt::Doubt;
pub use estimate::{Estimate, WhitenessTest};
pub use external_csv::{ColumnMapping, ExternalCsvError};
pub use fit::{DirectFit, fit_direct};
pub use identification::{Identification, RecordingFit, identify};
pub use recording::{RecordedInput, RecordedSample, Recording, RecordingError, SampleSource};
pub use steps::{FrequencyStep, VoltageStep};
pub use table::{IdentificationTable, PlateFileDetails, plate_file, tables};
