#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::missing_panics_doc)]

mod coverage;
mod encodings;
mod line_tables;
mod mutation;

use platebench_experiments::firmware_analysis::{CodeMap, FirmwareSuite};
use platebench_rig::{BUILT_IN_IMAGE, RigSpec, Symbols};
use platebench_test_kit::{load_scenario, workspace_root};
use std::path::Path;

fn suite(scenarios: &[&str]) -> FirmwareSuite {
    suite_of(None, scenarios)
}

fn suite_of(elf: Option<&Path>, scenarios: &[&str]) -> FirmwareSuite {
    let scenarios = scenarios.iter().map(|name| load_scenario(name));
    FirmwareSuite::new(&RigSpec::emulated(elf.map(Path::to_owned)), scenarios.collect()).unwrap()
}

fn shipped_code() -> (CodeMap, Symbols) {
    let elf = BUILT_IN_IMAGE;
    let symbols = Symbols::read(elf);
    (CodeMap::read(elf, &symbols), symbols)
}
