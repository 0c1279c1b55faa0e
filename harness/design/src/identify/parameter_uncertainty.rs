//! Combines the errors of identified parameters with the uncertainty budget of the measurement.

use crate::identify::estimate::Estimate;
use crate::identify::identification::Identification;
use crate::identify::table::IdentificationTable;
use platebench_verdict::uncertainty::{Budget, CombinedUncertainty, EvaluationError, TypeA};
use serde::Serialize;

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ParameterUncertainty {
    pub quantity: String,
    pub value: f64,
    pub interval: [f64; 2],
    pub combined: CombinedUncertainty,
}

/// Omits parameters without budget or estimate. The fit gives a repeatability that is not stated.
pub fn parameter_uncertainties(
    found: &Identification,
    budget: &Budget,
) -> Result<Vec<ParameterUncertainty>, EvaluationError> {
    let parameters = [
        ("gain_um_per_vpp", found.gain_um_per_vpp),
        ("time_constant_s", found.time_constant_s),
        ("resonance_hz", found.resonance_hz),
        ("slope_hz_per_k", found.slope_hz_per_k),
    ];
    let budgeted =
        parameters.into_iter().filter_map(|(name, estimate)| Some((name, estimate?, budget.quantity(name)?)));
    budgeted
        .map(|(name, estimate, quantity)| {
            let Estimate { value, error, freedom, .. } = estimate;
            let observed = TypeA { standard: error, degrees_of_freedom: freedom };
            let combined = quantity.combine(value, Some(observed), budget.coverage)?;
            let interval = [value - combined.expanded, value + combined.expanded];
            Ok(ParameterUncertainty { quantity: name.to_owned(), value, interval, combined })
        })
        .collect()
}

pub fn uncertainty_table(parameters: &[ParameterUncertainty]) -> IdentificationTable {
    let header = ["quantity", "value", "u", "ν", "k", "U", "largest contribution"];
    let row = |parameter: &ParameterUncertainty| {
        let combined = &parameter.combined;
        let largest = combined.contributions.iter().max_by(|a, b| a.standard.total_cmp(&b.standard));
        vec![
            parameter.quantity.clone(),
            format!("{:.6e}", parameter.value),
            format!("{:.3e}", combined.standard),
            combined.degrees_of_freedom.map_or_else(|| "∞".to_owned(), |freedom| format!("{freedom:.1}")),
            format!("{:.2}", combined.coverage_factor),
            format!("{:.3e}", combined.expanded),
            largest.map_or_else(String::new, |largest| format!("{:.3e}, {}", largest.standard, largest.source)),
        ]
    };
    IdentificationTable {
        title: "Combined and expanded uncertainty".to_owned(),
        header: header.map(str::to_owned).to_vec(),
        rows: parameters.iter().map(row).collect(),
        notes: Vec::new(),
    }
}
