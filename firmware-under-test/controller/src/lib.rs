//! Implements the control laws and the controller's state machine, as they run on the STM32F4.
//!
//! The board, the emulated board and the hosted rig compile the same source. Their results are
//! equal bit for bit, because the source uses f32 throughout, `libm` for the functions that `core`
//! lacks, and no `mul_add`. Callers pass time and bytes as arguments; this crate accesses no clock
//! and no register and allocates no memory.
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
