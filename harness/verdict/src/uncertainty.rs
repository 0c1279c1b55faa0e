//! Combines measurement uncertainties (GUM, JCGM 100:2008) and decides on conformity with them
//! (JCGM 106:2012, ILAC-G8:09/2019).

mod budget;
mod budget_file;
mod combine;
mod decision;

pub use budget::{Budget, Component, ComponentKind, Distribution, Instrument, QuantityBudget};
pub use budget_file::known_quantities;
pub use combine::{CombinedUncertainty, Contribution, EvaluationError, TypeA};
pub use decision::{Conformity, DecisionRule, GUARD_PROBABILITY, decide};
