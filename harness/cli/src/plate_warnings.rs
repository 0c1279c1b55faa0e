//! Warns of plate files that no ultrasonic tactile plate resembles, such as a gain in a wrong unit.

use crate::stdio;
use platebench_model::scenario::load::implausible_values;
use platebench_model::scenario::{Scenario, plate_warnings};
use platebench_plate::Plate;
use std::collections::BTreeSet;
use std::path::Path;

/// Many scenarios share a plate, so each warning is printed once.
pub(crate) fn warn_of_scenarios(scenarios: &[Scenario]) {
    let mut printed = BTreeSet::new();
    for warning in scenarios.iter().flat_map(plate_warnings) {
        if printed.insert(warning.message.clone()) {
            stdio::note(&format!("warning: {warning}"));
        }
    }
}

pub(crate) fn warn_of_plate(path: &Path, plate: &Plate) {
    for warning in implausible_values(path, plate).unwrap_or_default() {
        stdio::note(&format!("warning: {warning}"));
    }
}
