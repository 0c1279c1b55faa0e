//! Encodes and decodes the messages between the bench and the controller under test.
//!
//! [`EncodedFrame`] turns a body into a frame on the line, [`FrameReader`] turns a frame back into
//! its body. [`Packet`] decodes a body and holds only valid messages. `docs/wire-protocol.md`
//! describes the protocol, and the tests of this crate check every byte. Timing, retries and
//! session state are not part of this crate.
#![no_std]

#[cfg(test)]
extern crate std;

mod configuration;
mod control;
mod field;
mod frame;
mod identity;
mod packet;
mod packet_reader;

pub use configuration::{Configure, Configured, Gains, Rejection};
pub use control::{Command, ControllerState, FaultReport, Sample, Setpoint, StateCause, Telemetry, Tick, flags};
pub use field::MessageError;
pub use frame::{EncodedFrame, FrameError, FrameReader, MAX_BODY, MAX_ENCODED};
pub use identity::{Identity, LawId, capabilities};
pub use packet::{Message, Packet, VERSION};
pub use packet_reader::{PacketError, PacketReader};
