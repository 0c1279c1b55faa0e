//! Opens the link that `--rig` names.

use crate::connect_options::ConnectOptions;
#[cfg(feature = "emulated")]
use crate::emulated::{EmulatedError, EmulatedLink};
use crate::exec::{CommandLine, ExecError, ExecLink};
use crate::hosted::HostedLink;
use crate::link::BoxedLink;
use crate::network::{NetworkError, connect_rfc2217, connect_tcp};
#[cfg(feature = "probe")]
use crate::probe::{Lister, ProbeError, ProbeSetup, Timeouts};
use crate::serial::{DEFAULT_BAUD, SerialError, SerialLink};
use crate::spec::RigSpec;
use crate::wall_clock::WallClockLink;
use std::path::Path;

#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    #[error(
        "`{0}`: this bench was built without debug probes; build it with `cargo build --release \
         --ignore-rust-version --package platebench-cli --features probe`"
    )]
    ProbeSupportMissing(RigSpec),
    #[cfg(not(feature = "emulated"))]
    #[error("`{0}`: this bench was built without the emulated target; build it with the feature `emulated`")]
    EmulationMissing(RigSpec),
    #[error(
        "`{0}`: RTT through a debug probe does not keep real time; use --clock lockstep, or add the board's \
         serial port as ,port=PORT[@BAUD]"
    )]
    NoRealTime(RigSpec),
    #[cfg(feature = "probe")]
    #[error(transparent)]
    Probe(ProbeError),
    #[cfg(feature = "emulated")]
    #[error(transparent)]
    Emulated(#[from] EmulatedError),
    #[error(transparent)]
    Exec(#[from] ExecError),
    #[error(transparent)]
    Serial(#[from] SerialError),
    #[error(transparent)]
    Network(#[from] NetworkError),
}

#[cfg(feature = "probe")]
impl From<ProbeError> for ConnectError {
    fn from(error: ProbeError) -> Self {
        match error {
            ProbeError::Serial(error) => Self::Serial(error),
            error => Self::Probe(error),
        }
    }
}

impl ConnectError {
    /// True if the user's input is wrong, false if the connection failed.
    pub fn is_invalid_input(&self) -> bool {
        match self {
            Self::ProbeSupportMissing(_)
            | Self::NoRealTime(_)
            | Self::Serial(SerialError::NotATerminal { .. } | SerialError::Settings { .. }) => true,
            #[cfg(not(feature = "emulated"))]
            Self::EmulationMissing(_) => true,
            #[cfg(feature = "emulated")]
            Self::Emulated(error) => matches!(error, EmulatedError::Read { .. } | EmulatedError::Image(_)),
            #[cfg(feature = "probe")]
            Self::Probe(error) => error.is_invalid_input(),
            Self::Exec(error) => match error {
                ExecError::Quoting(_)
                | ExecError::Empty(_)
                | ExecError::NoPortPlaceholder(_)
                | ExecError::Start { .. } => true,
                ExecError::Terminal(_)
                | ExecError::Exited { .. }
                | ExecError::NoAnswer { .. }
                | ExecError::Cancelled(_)
                | ExecError::Link(_) => false,
            },
            Self::Network(_) | Self::Serial(SerialError::Open { .. } | SerialError::InUse { .. }) => false,
        }
    }
}

impl RigSpec {
    /// Checks what can be checked without starting a program or opening a device.
    pub fn check(&self) -> Result<(), ConnectError> {
        match self {
            #[cfg(not(feature = "emulated"))]
            Self::Emulated(_) => Err(ConnectError::EmulationMissing(self.clone())),
            #[cfg(feature = "emulated")]
            Self::Emulated(_) => Ok(()),
            Self::Hosted | Self::Serial { .. } | Self::Tcp(_) | Self::Rfc2217 { .. } => Ok(()),
            Self::Exec(command) => Ok(CommandLine::parse(command).map(drop)?),
            #[cfg(feature = "probe")]
            Self::Probe { .. } => Ok(ProbeSetup::from_spec(self).map(drop)?),
            #[cfg(not(feature = "probe"))]
            Self::Probe { .. } => Err(ConnectError::ProbeSupportMissing(self.clone())),
        }
    }

    /// Bits per second. `None` if the rig has no baud rate or the bench cannot know it (`tcp:`).
    pub fn baud(&self) -> Option<u32> {
        match self {
            Self::Serial { baud, .. } | Self::Rfc2217 { baud, .. } | Self::Probe { port: Some(_), baud, .. } => {
                Some(baud.unwrap_or(DEFAULT_BAUD))
            }
            Self::Hosted | Self::Emulated(_) | Self::Exec(_) | Self::Tcp(_) | Self::Probe { port: None, .. } => None,
        }
    }

    /// Path of the ELF; `None` for the built-in image and for rigs without an image.
    pub fn image(&self) -> Option<&Path> {
        match self {
            Self::Emulated(elf) | Self::Probe { elf, .. } => elf.as_deref(),
            Self::Hosted | Self::Exec(_) | Self::Serial { .. } | Self::Tcp(_) | Self::Rfc2217 { .. } => None,
        }
    }

    pub fn allows_parallel_links(&self) -> bool {
        match self {
            Self::Hosted | Self::Emulated(_) | Self::Exec(_) => true,
            Self::Serial { .. } | Self::Tcp(_) | Self::Rfc2217 { .. } | Self::Probe { .. } => false,
        }
    }

    /// True if the controller's clock runs while the plate waits. Such a controller needs a longer
    /// watchdog timeout in lockstep.
    pub const fn has_own_clock(&self) -> bool {
        !self.is_simulated()
    }

    /// True if neither hardware nor another program takes part. An `exec:` rig counts as hardware,
    /// because a foreign program may drive a plate.
    pub const fn is_simulated(&self) -> bool {
        matches!(self, Self::Hosted | Self::Emulated(_))
    }

    pub fn is_line(&self) -> bool {
        matches!(self, Self::Serial { .. } | Self::Tcp(_) | Self::Rfc2217 { .. } | Self::Probe { port: Some(_), .. })
    }

    /// False for RTT, because the debug probe polls it and takes some milliseconds per message.
    pub fn supports_real_time(&self) -> bool {
        !matches!(self, Self::Probe { port: None, .. })
    }

    pub fn connect(&self) -> Result<BoxedLink, ConnectError> {
        self.connect_with(&ConnectOptions::default())
    }

    pub fn connect_real_time(&self) -> Result<BoxedLink, ConnectError> {
        self.connect_real_time_with(&ConnectOptions::default())
    }

    pub fn connect_with(&self, options: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        Ok(match self {
            Self::Hosted => Box::new(HostedLink::new()),
            Self::Emulated(_) => Box::new(self.open_emulated(options)?),
            Self::Exec(command) => Box::new(ExecLink::start_with(command, options)?),
            Self::Serial { port, baud } => {
                let link = SerialLink::open(Path::new(port), baud.unwrap_or(DEFAULT_BAUD))?;
                Box::new(link.with_reply_timeout(options.reply_timeout))
            }
            Self::Tcp(address) => Box::new(connect_tcp(address)?.with_reply_timeout(options.reply_timeout)),
            Self::Rfc2217 { address, baud } => {
                let link = connect_rfc2217(address, baud.unwrap_or(DEFAULT_BAUD))?;
                Box::new(link.with_reply_timeout(options.reply_timeout))
            }
            #[cfg(feature = "probe")]
            Self::Probe { .. } => ProbeSetup::from_spec(self)?.connect(Lister::new, Timeouts::default())?,
            #[cfg(not(feature = "probe"))]
            Self::Probe { .. } => return Err(ConnectError::ProbeSupportMissing(self.clone())),
        })
    }

    pub fn connect_real_time_with(&self, options: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        match self {
            Self::Hosted => Ok(Box::new(WallClockLink::new(HostedLink::new()))),
            Self::Emulated(_) => Ok(Box::new(WallClockLink::new(self.open_emulated(options)?))),
            Self::Probe { port: None, .. } => Err(ConnectError::NoRealTime(self.clone())),
            Self::Exec(_) | Self::Serial { .. } | Self::Tcp(_) | Self::Rfc2217 { .. } | Self::Probe { .. } => {
                self.connect_with(options)
            }
        }
    }

    #[cfg(feature = "emulated")]
    fn open_emulated(&self, options: &ConnectOptions) -> Result<EmulatedLink, EmulatedError> {
        if let Some(port) = &options.debug_port {
            return EmulatedLink::open_with_debugger(self.image(), port, &options.cancel);
        }
        self.image().map_or_else(EmulatedLink::built_in, EmulatedLink::open)
    }

    #[cfg(not(feature = "emulated"))]
    fn open_emulated(&self, _: &ConnectOptions) -> Result<HostedLink, ConnectError> {
        Err(ConnectError::EmulationMissing(self.clone()))
    }
}
