//! Lists correct controllers that differ from the firmware.

use crate::trust::mutant_controller::{Mutant, MutantController};
use crate::trust::mutants::clean::{ByteWiseReads, other_gains, own_clock, reported_compute_time};
use platebench_rig::{BoxedLink, HostedLink};

#[derive(Debug, Clone, Copy)]
pub struct CleanVariant {
    pub name: &'static str,
    pub description: &'static str,
    build: fn() -> Box<dyn Mutant>,
}

impl CleanVariant {
    pub fn link(&self) -> BoxedLink {
        Box::new(MutantController::new(HostedLink::new(), self.build))
    }
}

pub fn clean_variants() -> Vec<CleanVariant> {
    let variant = |name, description, build| CleanVariant { name, description, build };
    vec![
        variant("gains-plus-5", "amplitude gains 5 % higher", || other_gains(1.0 / 1.05)),
        variant("compute-time", "reports 200 µs per control step", reported_compute_time),
        variant("own-clock", "clock with another start, which wraps and is 100 ppm fast", own_clock),
        variant("byte-wise", "reads and writes byte by byte", || Box::new(ByteWiseReads)),
    ]
}
