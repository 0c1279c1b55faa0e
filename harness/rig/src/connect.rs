//! From what a user wrote to a line.

use crate::emulated::{Emulated, EmulatedError};
use crate::exec::{Exec, ExecError, Words};
use crate::hosted::Hosted;
use crate::link::Link;
use crate::paced::Paced;
#[cfg(feature = "probe")]
use crate::probe::{Lister, Patience, ProbeError, Setup};
use crate::serial::{DEFAULT_BAUD, Serial, SerialError};
use crate::spec::RigSpec;
use std::path::Path;

/// A link of any kind.
pub type AnyLink = Box<dyn Link>;

/// Why there is no line to a controller.
#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    /// Debug probes are not in this build.
    #[error(
        "`{0}`: this bench was built without debug probes; `cargo build --release --ignore-rust-version --package platebench-cli --features probe` builds one that has them"
    )]
    NotBuilt(RigSpec),
    /// The line is too slow and too irregular for real time.
    #[error(
        "`{0}`: RTT through a debug probe does not keep real time; use --clock lockstep, or name the board's serial port with ,port=PORT[@BAUD]"
    )]
    NotInRealTime(RigSpec),
    /// The board on a debug probe cannot be worked with.
    #[cfg(feature = "probe")]
    #[error(transparent)]
    Probe(#[from] ProbeError),
    /// The emulated board did not come up.
    #[error(transparent)]
    Emulated(#[from] EmulatedError),
    /// The program did not come up.
    #[error(transparent)]
    Exec(#[from] ExecError),
    /// The port cannot be used.
    #[error(transparent)]
    Serial(#[from] SerialError),
}

impl ConnectError {
    /// True where what the user named is at fault, not the rig.
    pub fn is_invalid_input(&self) -> bool {
        match self {
            Self::NotBuilt(_)
            | Self::NotInRealTime(_)
            | Self::Emulated(EmulatedError::Read { .. } | EmulatedError::Image(_))
            | Self::Serial(SerialError::NoTerminal { .. } | SerialError::Settings { .. }) => true,
            #[cfg(feature = "probe")]
            Self::Probe(error) => error.is_invalid_input(),
            Self::Exec(error) => match error {
                ExecError::Quoting(_) | ExecError::Empty(_) | ExecError::NoPlace(_) | ExecError::Start { .. } => true,
                ExecError::Terminal(_) | ExecError::Ended { .. } | ExecError::Silent { .. } | ExecError::Link(_) => {
                    false
                }
            },
            Self::Emulated(EmulatedError::Target(_))
            | Self::Serial(SerialError::Open { .. } | SerialError::InUse { .. }) => false,
        }
    }
}

impl RigSpec {
    /// Whether this kind of rig can be connected to at all. Starts nothing and opens no device.
    ///
    /// # Errors
    /// [`ConnectError`], which is the user's doing.
    pub fn check(&self) -> Result<(), ConnectError> {
        match self {
            Self::Hosted | Self::Emulated(_) | Self::Serial { .. } => Ok(()),
            Self::Exec(command) => Ok(Words::of(command).map(drop)?),
            Self::Probe { .. } => self.check_probe(),
        }
    }

    /// Bits per second, where the line has a rate that counts: a pseudo-terminal throttles nothing.
    pub fn baud(&self) -> Option<u32> {
        match self {
            Self::Serial { baud, .. } | Self::Probe { port: Some(_), baud, .. } => Some(baud.unwrap_or(DEFAULT_BAUD)),
            Self::Hosted | Self::Emulated(_) | Self::Exec(_) | Self::Probe { port: None, .. } => None,
        }
    }

    /// The file of the firmware that the rig is loaded with; `None` where it brings its own or takes the bench's.
    pub fn image(&self) -> Option<&Path> {
        match self {
            Self::Emulated(elf) | Self::Probe { elf, .. } => elf.as_deref(),
            Self::Hosted | Self::Exec(_) | Self::Serial { .. } => None,
        }
    }

    /// True where several lines at once reach several controllers; false for what there is one of.
    pub fn is_plural(&self) -> bool {
        match self {
            Self::Hosted | Self::Emulated(_) | Self::Exec(_) => true,
            Self::Serial { .. } | Self::Probe { .. } => false,
        }
    }

    /// True where the controller has a clock of its own, which goes on while the plate waits: in lockstep it needs more patience than five periods.
    pub fn has_own_clock(&self) -> bool {
        match self {
            Self::Hosted | Self::Emulated(_) => false,
            Self::Exec(_) | Self::Serial { .. } | Self::Probe { .. } => true,
        }
    }

    /// False where the line is too slow and too irregular for real time: RTT is polled through a probe, some milliseconds for each message.
    pub fn keeps_real_time(&self) -> bool {
        !matches!(self, Self::Probe { port: None, .. })
    }

    /// A new line to a controller of this kind, in lockstep; each call makes another one.
    ///
    /// # Errors
    /// [`ConnectError`].
    pub fn connect(&self) -> Result<AnyLink, ConnectError> {
        match self {
            Self::Hosted => Ok(Box::new(Hosted::new())),
            Self::Emulated(_) => Ok(Box::new(self.emulated()?)),
            Self::Exec(command) => Ok(Box::new(Exec::start(command)?)),
            Self::Serial { port, baud } => Ok(Box::new(Serial::open(Path::new(port), baud.unwrap_or(DEFAULT_BAUD))?)),
            Self::Probe { .. } => self.on_probe(),
        }
    }

    /// A new line to a controller of this kind that can be used in real time: [`Link::line`] has it.
    ///
    /// # Errors
    /// [`ConnectError`].
    pub fn connect_in_real_time(&self) -> Result<AnyLink, ConnectError> {
        match self {
            Self::Hosted => Ok(Box::new(Paced::new(Hosted::new()))),
            Self::Emulated(_) => Ok(Box::new(Paced::new(self.emulated()?))),
            Self::Probe { port: None, .. } => Err(ConnectError::NotInRealTime(self.clone())),
            Self::Exec(_) | Self::Serial { .. } | Self::Probe { .. } => self.connect(),
        }
    }

    #[cfg(not(feature = "probe"))]
    fn check_probe(&self) -> Result<(), ConnectError> {
        Err(ConnectError::NotBuilt(self.clone()))
    }

    #[cfg(not(feature = "probe"))]
    fn on_probe(&self) -> Result<AnyLink, ConnectError> {
        Err(ConnectError::NotBuilt(self.clone()))
    }

    #[cfg(feature = "probe")]
    fn check_probe(&self) -> Result<(), ConnectError> {
        Ok(Setup::of(self).map(drop)?)
    }

    #[cfg(feature = "probe")]
    fn on_probe(&self) -> Result<AnyLink, ConnectError> {
        Setup::of(self)?.connect(Lister::new, Patience::default())
    }

    fn emulated(&self) -> Result<Emulated, EmulatedError> {
        match self {
            Self::Emulated(Some(elf)) => Emulated::open(elf),
            _ => Emulated::built_in(),
        }
    }
}
