//! Opens a firmware image on the emulated chip.

#[cfg(feature = "emulated")]
use crate::emulated::{EmulatedError, EmulatedLink};
use crate::factory::{
    Argument, Capability, ConnectError, ConnectOptions, FirmwareImage, Rig, RigFactory, RigProperties,
};
use crate::link::BoxedLink;
use std::path::PathBuf;

pub(super) const RIG: RigFactory = RigFactory {
    name: "emulated",
    argument: Argument::Optional("ELF"),
    help: "a firmware image on an emulated STM32F427; without ELF the image of the bench",
    capabilities: &[Capability::Simulated, Capability::ParallelLinks, Capability::EmulatedChip],
    parse: |elf| Ok(Box::new(EmulatedRig { elf: elf.map(PathBuf::from) })),
};

const UNAVAILABLE: Option<&str> = if cfg!(feature = "emulated") {
    None
} else {
    Some("this bench was built without the emulated target; build it with the feature `emulated`")
};

#[derive(Debug)]
pub(super) struct EmulatedRig {
    /// `None` for the built-in image.
    pub(super) elf: Option<PathBuf>,
}

impl Rig for EmulatedRig {
    fn properties(&self) -> RigProperties {
        let image = self.elf.clone().map_or(FirmwareImage::BuiltIn, FirmwareImage::File);
        RigProperties { image, unavailable: UNAVAILABLE, ..RigProperties::default() }
    }

    #[cfg(feature = "emulated")]
    fn open(&self, options: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        let elf = self.elf.as_deref();
        let link = match &options.debug_port {
            Some(port) => EmulatedLink::open_with_debugger(elf, port, &options.cancel),
            None => elf.map_or_else(EmulatedLink::built_in, EmulatedLink::open),
        };
        match (link, elf) {
            (Ok(link), _) => Ok(Box::new(link)),
            (Err(error @ EmulatedError::Image(_)), Some(elf)) => {
                Err(ConnectError::Invalid(format!("{}: {error}", elf.display()).into()))
            }
            (Err(error), _) => Err(error.into()),
        }
    }

    #[cfg(not(feature = "emulated"))]
    fn open(&self, _: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        Err(ConnectError::Refused { rig: RIG.to_string(), reason: UNAVAILABLE.unwrap_or_default() })
    }
}

#[cfg(feature = "emulated")]
impl From<EmulatedError> for ConnectError {
    fn from(error: EmulatedError) -> Self {
        let is_invalid = matches!(error, EmulatedError::Read { .. } | EmulatedError::Image(_));
        Self::new(error, is_invalid)
    }
}
