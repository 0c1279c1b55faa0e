//! Identifies plate parameters from recorded responses (section IV of the paper).
//!
//! * [`recording`]: inputs and samples, from a trace or ([`external_csv`]) another table.
//! * [`mod@arx`]: the paper's method, order one, by least squares and by instrumental variables.
//! * [`fit`]: fits the exact response to all samples; its values are the result.
//! * [`estimate`]: intervals, and a test of the residuals.
//! * [`steps`], [`identification`]: Tables I and II and the plate, from all recordings together.
//! * [`table`]: the tables as text, and the plate file.

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
