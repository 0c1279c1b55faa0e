//! The messages between the bench and the controller under test, down to the byte.
//!
//! Two tiers. [`frame`] turns a body of bytes into what travels on the line (CRC-32, COBS, a zero delimiter) and back;
//! [`message`] gives the body its meaning and can hold only what the protocol can say. The description for strangers,
//! with test vectors, is `docs/wire-protocol.md`; the tests here pin every byte of it.
//!
//! Neighbours: `platebench-controller` speaks it from the target's side, `platebench-rig` from the bench's.
//! No timing, no retries and no state of a session belong here.
#![no_std]

#[cfg(test)]
extern crate std;

mod cursor;
pub mod frame;
pub mod message;

pub use frame::{Encoded, FrameError, FrameReader, MAX_BODY, MAX_ENCODED};
pub use message::{
    Command, Configure, Configured, FaultReport, Gains, Identity, LawId, Message, MessageError, Packet, Rejection,
    Sample, Setpoint, State, StateCause, Telemetry, Tick, VERSION, capabilities, flags,
};
