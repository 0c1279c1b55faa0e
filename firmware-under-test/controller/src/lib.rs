//! Implements the control laws and the controller's state machine, as they run on the STM32F4.
//!
//! Board, emulated board and hosted rig compile the same source and give the same bits, because the
//! source uses f32 throughout, `libm` for the functions that `core` lacks, and no `mul_add`.
//! Clocks, registers and allocation do not belong here; time and bytes are arguments.
#![no_std]

#[cfg(test)]
extern crate std;

mod bang_bang;
mod deadbeat;
pub mod design;
pub mod device;
mod dq_pi;
mod envelope;
mod frequency_only;
pub mod law;
mod loops;
mod open_loop;
mod pacer;
pub mod pi;
mod pll;
pub mod state_machine;
mod voltage_only;

pub use device::Device;
pub use law::{Actuation, Law, Measurement};
pub use state_machine::{DEFAULT_WATCHDOG_PERIODS, StateMachine};
