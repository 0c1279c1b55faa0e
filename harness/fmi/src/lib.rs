//! Exports the plate as an FMU: a co-simulation unit of FMI 3.0 for Simulink, `OpenModelica`,
//! `FMPy` and other tools.
//!
//! The FMU contains the plate file and the shared library of this crate, whose C interface is in
//! `c_interface`. The crate fmi-export is not used, because its fmi-sys needs libclang at build
//! time.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

mod c_interface;
mod fmu_file;
mod instance;

pub use fmu_file::{FmuError, find_library, write};
pub use instance::{INPUTS, Instance, InstanceError, OUTPUTS, Variable};
