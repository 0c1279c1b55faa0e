//! Lists correct controllers that differ from the firmware.

use crate::mutant_controller::{Mutant, MutantController};
use crate::mutants::clean::{ByteWiseReads, OtherGains, OwnClock, ReportedComputeTime};
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
        variant("gains-plus-5", "amplitude gains 5 % higher", || Box::new(OtherGains(1.0 / 1.05))),
        variant("compute-time", "reports 200 µs per control step", || Box::new(ReportedComputeTime)),
        variant("own-clock", "clock with another start, which wraps and is 100 ppm fast", || Box::new(OwnClock)),
        variant("byte-wise", "reads and writes byte by byte", || Box::new(ByteWiseReads)),
    ]
}
