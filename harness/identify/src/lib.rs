//! Plate parameters from recorded responses (section IV of the paper).
//!
//! * [`recording`]: what drove the plate and what was seen of it, from a trace.
//! * [`telemetry`]: the same from a foreign table whose columns are named.
//! * [`mod@arx`]: the paper's method, order one, by least squares and by instrumental variables.
//! * [`fit`]: the exact response held against every sample: the answer.
//! * [`estimate`]: intervals, and whether residuals are white.
//! * [`steps`], [`identification`]: Tables I and II and the plate, from all recordings together.
//! * [`shown`]: the tables as text, the plate as a file.
//!
//! Neighbours: `platebench-plate` propagates, `platebench-trace` reads traces. Nothing here knows a scenario, and nothing is judged.

pub mod arx;
pub mod estimate;
pub mod fit;
pub mod identification;
pub mod recording;
pub mod shown;
pub mod steps;
pub mod telemetry;

pub use arx::{Arx, Method, arx};
pub use estimate::{Estimate, Whiteness};
pub use fit::{Fit, direct};
pub use identification::{Identification, Whole, identify};
pub use recording::{Input, Output, Recording, Signal, Unusable};
pub use shown::{Named, Table, plate_file, tables};
pub use steps::{FrequencyStep, VoltageStep};
pub use telemetry::{Columns, TelemetryError};
