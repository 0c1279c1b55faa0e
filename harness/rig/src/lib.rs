//! How a controller is reached.
//!
//! * [`spec`]: `--rig` as a user writes it.
//! * [`connect`]: from there to a line.
//! * [`link`]: bytes to a target and back; what every kind of rig provides.
//! * [`hosted`]: the controller crate in this process.
//! * [`emulated`]: a firmware image on an emulated STM32F4, in virtual time.
//! * `probe` (feature `probe`): a board on a debug probe.
//! * [`exec`]: a controller program on a pseudo-terminal.
//! * [`serial`]: a controller on a serial port; [`baud`]: whether that is fast enough.
//! * [`terminal`]: a pseudo-terminal for a controller that somebody else starts.
//! * [`paced`]: virtual time links in real time.
//! * [`faulty`]: faults of a line, on purpose, around any link.
//! * [`session`]: handshake, configuration, samples and a safe end over any link.
//!
//! Everything above the bytes is the same for every rig, so that a controller in this process is talked to exactly like one behind a cable. Plate, profiles
//! and verdicts are unknown here; time is an argument.

mod asked;
pub mod baud;
pub mod connect;
pub mod emulated;
pub mod exec;
pub mod faulty;
pub mod hosted;
pub mod link;
mod lock;
pub mod paced;
mod port;
#[cfg(feature = "probe")]
pub mod probe;
pub mod serial;
pub mod session;
pub mod spec;
mod symbols;
pub mod terminal;

pub use baud::{TooSlow, check_baud, smallest_baud};
pub use connect::{AnyLink, ConnectError};
pub use emulated::{Emulated, EmulatedError, TargetFault};
pub use exec::{Exec, ExecError};
pub use faulty::{Direction, Faulty, WireFault, WireFaultKind};
pub use hosted::Hosted;
pub use link::{Line, Link, LinkError};
pub use lock::Holder;
pub use paced::Paced;
pub use serial::{Serial, SerialError};
pub use session::{Heard, Reply, RigError, Session, printable_name};
pub use spec::{RigSpec, SpecError};
pub use symbols::Place;
pub use terminal::Terminal;
