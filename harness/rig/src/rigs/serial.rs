//! Connects to a controller on a serial port.

use crate::factory::{Argument, Capability, ConnectError, ConnectOptions, Rig, RigFactory, RigProperties};
use crate::link::BoxedLink;
use crate::serial_port::{SerialError, SerialLink};
use platebench_model::record::ClockKind;
use std::path::PathBuf;

pub(super) const RIG: RigFactory = RigFactory {
    name: "serial",
    argument: Argument::Required("PORT[@BAUD]"),
    help: "a board on a serial port of this computer",
    capabilities: &[Capability::RealPlate, Capability::LocalPort],
    parse: |text| {
        let (port, baud) = parse_port(text.unwrap_or_default())?;
        Ok(Box::new(SerialRig { port: port.into(), baud }))
    },
};

#[derive(Debug)]
struct SerialRig {
    port: PathBuf,
    baud: u32,
}

impl Rig for SerialRig {
    fn properties(&self) -> RigProperties {
        RigProperties { default_clock: ClockKind::RealTime, baud: Some(self.baud), ..RigProperties::default() }
    }

    fn open(&self, options: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        let link = SerialLink::open(&self.port, self.baud)?;
        Ok(Box::new(link.with_reply_timeout(options.reply_timeout)))
    }
}

/// Parses `PORT[@BAUD]`.
pub(super) fn parse_port(text: &str) -> Result<(String, u32), &'static str> {
    let (port, baud) = text.rsplit_once('@').map_or((text, None), |(port, baud)| (port, Some(baud)));
    match baud.map_or(Ok(DEFAULT_BAUD), str::parse) {
        Ok(baud) if baud > 0 && !port.is_empty() => Ok((port.to_owned(), baud)),
        _ => Err("the port is missing, or the baud rate is not a whole number above 0"),
    }
}

/// Baud rate of the bench's firmware.
const DEFAULT_BAUD: u32 = 1_000_000;

impl From<SerialError> for ConnectError {
    fn from(error: SerialError) -> Self {
        let is_invalid = matches!(error, SerialError::NotATerminal { .. } | SerialError::Settings { .. });
        Self::new(error, is_invalid)
    }
}
