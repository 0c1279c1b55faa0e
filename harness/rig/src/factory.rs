//! Defines a kind of rig: its entry in the list of rigs, its arguments and its connection.

use crate::cancel::CancelToken;
use crate::debug_port::DebugPort;
use crate::link::BoxedLink;
use crate::port::DEFAULT_REPLY_TIMEOUT;
use platebench_model::record::ClockKind;
use std::error::Error;
use std::fmt;
use std::panic::RefUnwindSafe;
use std::path::PathBuf;
use std::time::Duration;

/// Entry of a kind of rig in [`crate::RIGS`].
#[derive(Debug)]
pub struct RigFactory {
    /// Text before the colon of `--rig`.
    pub name: &'static str,
    pub argument: Argument,
    /// One line for the help: what the controller runs on and how it is reached.
    pub help: &'static str,
    pub capabilities: &'static [Capability],
    /// Parses the text after the colon; `None` without a colon.
    pub parse: fn(Option<&str>) -> ParsedRig,
}

/// The error is the problem of a wrong text.
pub type ParsedRig = Result<Box<dyn Rig>, &'static str>;

/// Syntax of the text after the colon.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Argument {
    None,
    Optional(&'static str),
    Required(&'static str),
}

/// Prints the syntax, such as `serial:PORT[@BAUD]`.
impl fmt::Display for RigFactory {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.argument {
            Argument::None => formatter.write_str(self.name),
            Argument::Optional(syntax) => write!(formatter, "{}[:{syntax}]", self.name),
            Argument::Required(syntax) => write!(formatter, "{}:{syntax}", self.name),
        }
    }
}

/// Property of all rigs of a kind. A rig without one of them is refused if a command needs it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Capability {
    /// The target runs in simulated time, and neither hardware nor another program takes part. The
    /// bench runs it in real time, too.
    Simulated,
    /// Several links may be open at the same time.
    ParallelLinks,
    /// The bench emulates the chip: a debugger, the coverage of instructions and mutants of machine
    /// code are possible.
    EmulatedChip,
    /// The controller may drive a plate of its own.
    RealPlate,
    /// The rig opens a serial port of this computer, also while no controller answers on it.
    LocalPort,
}

/// ELF of the bench's firmware for STM32F405, F407 and F427, built from
/// `firmware-under-test/stm32f4`.
pub const BUILT_IN_IMAGE: &[u8] = include_bytes!("../../../firmware-under-test/images/platebench-stm32f4.elf");

/// Image that the bench loads into the target.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum FirmwareImage {
    #[default]
    None,
    BuiltIn,
    File(PathBuf),
}

/// Properties of one rig with its arguments.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RigProperties {
    /// Clock of a run without `--clock`: real time on a line, else lockstep.
    pub default_clock: ClockKind,
    /// Bits per second. `None` if the rig has no baud rate or the bench cannot know it.
    pub baud: Option<u32>,
    pub image: FirmwareImage,
    /// Program and arguments that the bench starts.
    pub command: Vec<String>,
    /// Why this build of the bench cannot open the rig.
    pub unavailable: Option<&'static str>,
    /// Why the rig cannot run in real time.
    pub no_real_time: Option<&'static str>,
}

impl Default for RigProperties {
    fn default() -> Self {
        Self {
            default_clock: ClockKind::Lockstep,
            baud: None,
            image: FirmwareImage::None,
            command: Vec::new(),
            unavailable: None,
            no_real_time: None,
        }
    }
}

/// Rig with valid arguments. It contains data only; [`Rig::open`] creates the state.
pub trait Rig: fmt::Debug + Send + Sync + RefUnwindSafe {
    fn properties(&self) -> RigProperties {
        RigProperties::default()
    }

    /// Checks what can be checked without starting a program or opening a device.
    fn check(&self) -> Result<(), ConnectError> {
        Ok(())
    }

    fn open(&self, options: &ConnectOptions) -> Result<BoxedLink, ConnectError>;
}

#[derive(Debug, Clone)]
pub struct ConnectOptions {
    /// Longest wait for an answer in lockstep over a line, from the last byte of the request.
    pub reply_timeout: Duration,
    /// Cancels the waits for a program's handshake and for a debugger.
    pub cancel: CancelToken,
    /// The first emulated chip waits on this port for a debugger.
    pub debug_port: Option<DebugPort>,
}

impl Default for ConnectOptions {
    fn default() -> Self {
        Self { reply_timeout: DEFAULT_REPLY_TIMEOUT, cancel: CancelToken::never(), debug_port: None }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    #[error("`{rig}`: {reason}")]
    Refused { rig: String, reason: &'static str },
    /// The user's input is wrong.
    #[error("{0}")]
    Invalid(Box<dyn Error + Send + Sync>),
    /// The connection failed.
    #[error("{0}")]
    Failed(Box<dyn Error + Send + Sync>),
}

impl ConnectError {
    pub(crate) fn new(error: impl Error + Send + Sync + 'static, is_invalid_input: bool) -> Self {
        if is_invalid_input { Self::Invalid(Box::new(error)) } else { Self::Failed(Box::new(error)) }
    }

    /// True if the user's input is wrong, false if the connection failed.
    pub fn is_invalid_input(&self) -> bool {
        !matches!(self, Self::Failed(_))
    }

    /// Returns the rig's own error, if it has the type `E`.
    pub fn downcast_ref<E: Error + 'static>(&self) -> Option<&E> {
        match self {
            Self::Refused { .. } => None,
            Self::Invalid(error) | Self::Failed(error) => error.downcast_ref(),
        }
    }
}
