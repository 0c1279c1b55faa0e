//! Connects the bench to a controller. A *rig* is one kind of connection: hosted in this process,
//! emulated, program, serial port, network or debug probe. Each rig is a [`link::Link`], and all
//! transport the same bytes. The *target* is the processor or process on which the controller runs.
//! The caller passes the trial's time to each call. This crate contains no plate, profile or
//! verdict.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]
#![cfg_attr(not(feature = "emulated"), allow(dead_code, unused_imports))]

#[cfg(not(target_os = "linux"))]
compile_error!("the bench needs Linux: pseudo-terminals, signals and real-time scheduling are those of Linux");

#[cfg(test)]
extern crate self as platebench_rig;

pub mod cancel;
mod command_audit;
mod compared_link;
pub mod crash_report;
mod debug_port;
#[cfg(feature = "emulated")]
pub mod emulated;
pub mod factory;
pub mod fault_injector;
mod handshake;
pub mod link;
mod port;
#[cfg(feature = "probe")]
pub mod probe;
pub mod protocol_check;
mod rejected_bytes;
mod rejected_frame;
mod rig_error;
pub mod rigs;
// The link of the test kit with the types of this build. The kit has those of the library.
#[cfg(test)]
#[path = "../../../tests/kit/src/scripted_link.rs"]
pub mod scripted_link;
mod serial_port;
pub mod session;
pub mod symbols;
mod tty;
mod wait_budget;
pub mod wall_clock;

pub use cancel::{CANCEL_POLL_INTERVAL, CancelToken};
pub use command_audit::DrivesAfterSafe;
pub use compared_link::FREQUENCY_TOLERANCE_MHZ;
pub use crash_report::CrashReport;
pub use debug_port::{DebugPort, DebuggerError};
#[cfg(feature = "emulated")]
pub use emulated::{EmulatedError, EmulatedLink};
pub use factory::{
    Argument, BUILT_IN_IMAGE, Capability, ConnectError, ConnectOptions, FirmwareImage, Rig, RigFactory, RigProperties,
};
pub use fault_injector::FaultInjector;
pub use link::{
    BoxedLink, Chip, ChipFaultError, ChipFaultPlan, DatedChipFault, Link, LinkError, LinkKind, RealTimeLine,
    TargetError, UnsupportedAccess,
};
pub use port::{DEFAULT_REPLY_TIMEOUT, PtyLink};
pub use protocol_check::{
    CheckOptions, ProtocolCheck, ProtocolCoverage, ScriptDifference, check_protocol, is_defined_law,
};
pub use rejected_bytes::RejectedBytes;
pub use rejected_frame::RejectedFrame;
pub use rig_error::RigError;
pub use rigs::exec::{ExecError, ExecLink};
pub use rigs::hosted::HostedLink;
pub use rigs::serial::{BaudTooLow, check_baud, minimum_baud};
pub use rigs::{NetworkError, RIGS, RigSpec, SpecError, may_come_back, rig_syntaxes};
pub use serial_port::{LockHolder, SerialError, SerialLink, lock_file};
pub use session::{ReceivedMessage, Reply, SafeEnd, Session, printable_name};
pub use symbols::{CodeLocation, Symbols};
pub use wait_budget::WaitBudget;
pub use wall_clock::WallClockLink;
