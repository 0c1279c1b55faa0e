//! Connects the bench to a controller. A *rig* is one kind of connection: hosted in this process,
//! emulated, program, serial port, network or debug probe. Each rig is a [`link::Link`], and all
//! transport the same bytes. The *target* is the processor or process on which the controller runs.
//! The caller passes the trial's time to each call. This crate contains no plate, profile or
//! verdict.

#![cfg_attr(not(feature = "emulated"), allow(dead_code, unused_imports))]

#[cfg(not(target_os = "linux"))]
compile_error!("the bench needs Linux: pseudo-terminals, signals and real-time scheduling are those of Linux");

pub mod baud;
mod built_in_image;
mod call_frames;
pub mod cancel;
pub mod chip_fault;
mod command_audit;
mod compared_link;
pub mod crash_report;
mod debug_port;
#[cfg(feature = "emulated")]
pub mod emulated;
pub mod factory;
pub mod fault_injector;
mod line_reader;
pub mod link;
mod pending_requests;
mod port;
pub mod port_lock;
#[cfg(feature = "probe")]
pub mod probe;
pub mod protocol_check;
pub mod pty;
pub mod rig_error;
pub mod rigs;
mod serial_port;
pub mod session;
pub mod symbols;
pub mod target_error;
mod tty;
pub mod wall_clock;

pub use baud::{BaudTooLow, check_baud, minimum_baud};
pub use built_in_image::BUILT_IN_IMAGE;
pub use cancel::CancelToken;
pub use chip_fault::{ChipFault, ChipFaultError, ChipFaultKind, ChipFaultPlan};
pub use command_audit::DrivesAfterSafe;
pub use crash_report::CrashReport;
pub use debug_port::{DebugPort, DebuggerError};
#[cfg(feature = "emulated")]
pub use emulated::{EmulatedError, EmulatedLink};
pub use factory::{Argument, Capability, ConnectError, ConnectOptions, FirmwareImage, Rig, RigFactory, RigProperties};
pub use fault_injector::{Direction, FaultInjector, WireFault, WireFaultKind};
pub use link::{BoxedLink, Chip, Link, LinkError, LinkKind, RealTimeLine};
pub use port::DEFAULT_REPLY_TIMEOUT;
pub use port_lock::LockHolder;
pub use protocol_check::{ProtocolCheck, check_protocol};
pub use pty::PtyLink;
pub use rig_error::RigError;
pub use rigs::exec::{ExecError, ExecLink};
pub use rigs::hosted::HostedLink;
pub use rigs::{NetworkError, RIGS, RigSpec, SpecError, rig_syntaxes};
pub use serial_port::{SerialError, SerialLink};
pub use session::{ReceivedMessage, Reply, SafeEnd, Session, printable_name};
pub use symbols::{CodeLocation, Symbols};
pub use target_error::TargetError;
pub use wall_clock::WallClockLink;
