//! Control laws of the plate and the controller's state machine, as they run on the STM32F4.
//!
//! The same source is compiled for the board, for the emulated board and for the bench's hosted rig: f32 throughout,
//! `libm` for what `core` lacks, no `mul_add`, so that all of them give the same bits.
//!
//! * [`law`]: what a law is given, what it answers, and which laws there are.
//! * [`pi`]: a proportional-integral controller whose integral tracks the saturated output.
//! * [`machine`]: idle, running, fault, safe; the only place that decides whether a plate is driven.
//! * [`device`]: bytes in, bytes out; what a board's main loop or a hosted rig calls.
//!
//! No clock is read here, no register touched and nothing allocated: time and bytes are arguments.
#![no_std]

#[cfg(test)]
extern crate std;

mod bang_bang;
mod deadbeat;
pub mod device;
mod dq_pi;
mod envelope;
mod frequency_only;
pub mod law;
mod loops;
pub mod machine;
mod open_loop;
mod pacing;
pub mod pi;
mod pll;
mod voltage_only;

pub use device::Device;
pub use law::{Actuation, Law, Measurement};
pub use machine::{Machine, PERIODS_WITHOUT_SAMPLE};
