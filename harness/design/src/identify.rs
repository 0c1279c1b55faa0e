//! Identifies plate parameters from recorded responses (section IV of the paper).

pub mod arx;
pub mod effect;
mod effect_fit;
pub mod estimate;
pub mod fit;
pub mod identification;
mod inconsistency;
mod parameter_uncertainty;
pub mod steps;
pub mod table;

pub use arx::{ArxMethod, ArxModel, arx};
pub use effect::{EffectFit, IdentifiedHeating, IdentifiedSecondMode};
pub use estimate::{Estimate, WhitenessTest};
pub use fit::{DirectFit, fit_direct};
pub use identification::{Identification, RecordingFit, identify};
pub use inconsistency::Inconsistency;
pub use parameter_uncertainty::{ParameterUncertainty, parameter_uncertainties, uncertainty_table};
pub use steps::{FrequencyStep, VoltageStep};
pub use table::{IdentificationTable, PlateFileDetails, plate_file, tables};
