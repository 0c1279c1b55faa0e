//! From what a user wrote to a line.

use crate::emulated::{Emulated, EmulatedError};
use crate::hosted::Hosted;
use crate::link::Link;
use crate::spec::RigSpec;

/// A link of any kind.
pub type AnyLink = Box<dyn Link>;

/// Why there is no line to a controller.
#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    /// The kind of rig is known but not built yet.
    #[error("rig `{0}` is not in the command line yet, expected hosted or emulated[:ELF]")]
    NotYet(RigSpec),
    /// The emulated board did not come up.
    #[error(transparent)]
    Emulated(#[from] EmulatedError),
}

impl ConnectError {
    /// True where what the user named is at fault, not the rig.
    pub fn is_invalid_input(&self) -> bool {
        match self {
            Self::NotYet(_) | Self::Emulated(EmulatedError::Read { .. } | EmulatedError::Image(_)) => true,
            Self::Emulated(EmulatedError::Target(_)) => false,
        }
    }
}

impl RigSpec {
    /// Whether this kind of rig can be connected to at all.
    ///
    /// # Errors
    /// [`ConnectError::NotYet`].
    pub fn check(&self) -> Result<(), ConnectError> {
        match self {
            Self::Hosted | Self::Emulated(_) => Ok(()),
            Self::Exec(_) | Self::Serial { .. } | Self::Probe(_) => Err(ConnectError::NotYet(self.clone())),
        }
    }

    /// A new line to a controller of this kind; each call makes another one.
    ///
    /// # Errors
    /// [`ConnectError`].
    pub fn connect(&self) -> Result<AnyLink, ConnectError> {
        match self {
            Self::Hosted => Ok(Box::new(Hosted::new())),
            Self::Emulated(None) => Ok(Box::new(Emulated::built_in()?)),
            Self::Emulated(Some(elf)) => Ok(Box::new(Emulated::open(elf)?)),
            Self::Exec(_) | Self::Serial { .. } | Self::Probe(_) => Err(ConnectError::NotYet(self.clone())),
        }
    }
}
