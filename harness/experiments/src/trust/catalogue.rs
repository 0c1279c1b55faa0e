//! Lists the mutants, each with the metrics that should detect it.

mod control;
mod interface;

use crate::trust::mutant_spec::MutantSpec;

pub fn catalogue() -> Vec<MutantSpec> {
    [
        control::amplitude_mutants(),
        control::resonance_mutants(),
        control::timing_mutants(),
        control::drive_limit_mutants(),
        control::law_mutants(),
        interface::protocol_mutants(),
        interface::blind_spot_mutants(),
        interface::counter_mutants(),
        interface::violating_mutants(),
        interface::configuration_mutants(),
    ]
    .concat()
}
