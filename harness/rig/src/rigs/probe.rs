//! Opens a board on a debug probe, over its serial port or over RTT.

use super::serial::parse_port;
use crate::factory::{Argument, ConnectError, ConnectOptions, FirmwareImage, Rig, RigFactory, RigProperties};
use crate::link::BoxedLink;
#[cfg(feature = "probe")]
use crate::probe::{Lister, ProbeError, ProbeSetup, Timeouts};
use platebench_model::record::ClockKind;
use std::path::PathBuf;

pub(super) const RIG: RigFactory = RigFactory {
    name: "probe",
    argument: Argument::Required("CHIP[@VID:PID[:SERIAL]][,elf=ELF][,port=PORT[@BAUD]]"),
    help: "a board on a debug probe, over its serial port; without PORT over RTT",
    capabilities: &[],
    parse: |text| Ok(Box::new(parse(text.unwrap_or_default())?)),
};

const UNAVAILABLE: Option<&str> = if cfg!(feature = "probe") {
    None
} else {
    Some(
        "this bench was built without debug probes; build it with `cargo build --release --ignore-rust-version \
         --package platebench-cli --features probe`",
    )
};
const NO_REAL_TIME: &str = "RTT through a debug probe does not keep real time: use --clock lockstep or name the \
                            board's serial port, --rig probe:CHIP,port=PORT[@BAUD]";

#[derive(Debug)]
struct ProbeRig {
    /// `CHIP[@VID:PID[:SERIAL]]`, see `probe::ProbeSpec`.
    #[cfg_attr(not(feature = "probe"), expect(dead_code, reason = "this build does not open it"))]
    board: String,
    /// `None` for the built-in image.
    elf: Option<PathBuf>,
    /// Serial port of the board and its baud rate; `None` for RTT, which the probe polls, so that it
    /// takes some milliseconds per message.
    port: Option<(PathBuf, u32)>,
}

/// Parses the text after `probe:`. A path in it cannot contain a comma.
fn parse(text: &str) -> Result<ProbeRig, &'static str> {
    let mut parts = text.split(',');
    let board = parts.next().filter(|board| !board.is_empty()).ok_or("the chip is missing")?.to_owned();
    let (mut elf, mut port) = (None, None);
    for part in parts {
        match part.split_once('=') {
            Some(("elf", path)) if elf.is_none() && !path.is_empty() => elf = Some(path.into()),
            Some(("port", text)) if port.is_none() => {
                let (path, baud) = parse_port(text)?;
                port = Some((path.into(), baud));
            }
            Some(("elf" | "port", _)) => return Err("elf= or port= appears twice, or elf= is empty"),
            _ => return Err("only elf= and port= may follow a comma"),
        }
    }
    Ok(ProbeRig { board, elf, port })
}

impl Rig for ProbeRig {
    fn properties(&self) -> RigProperties {
        let has_port = self.port.is_some();
        RigProperties {
            default_clock: if has_port { ClockKind::RealTime } else { ClockKind::Lockstep },
            baud: self.port.as_ref().map(|(_, baud)| *baud),
            image: self.elf.clone().map_or(FirmwareImage::BuiltIn, FirmwareImage::File),
            unavailable: UNAVAILABLE,
            no_real_time: (!has_port).then_some(NO_REAL_TIME),
            ..RigProperties::default()
        }
    }

    #[cfg(feature = "probe")]
    fn check(&self) -> Result<(), ConnectError> {
        Ok(self.setup().map(drop)?)
    }

    #[cfg(feature = "probe")]
    fn open(&self, _: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        Ok(self.setup()?.connect(Lister::new, Timeouts::default())?)
    }

    #[cfg(not(feature = "probe"))]
    fn open(&self, _: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        Err(ConnectError::Refused { rig: RIG.to_string(), reason: UNAVAILABLE.unwrap_or_default() })
    }
}

#[cfg(feature = "probe")]
impl ProbeRig {
    fn setup(&self) -> Result<ProbeSetup, ProbeError> {
        ProbeSetup::from_arguments(&self.board, self.elf.as_deref(), self.port.clone())
    }
}

#[cfg(feature = "probe")]
impl From<ProbeError> for ConnectError {
    fn from(error: ProbeError) -> Self {
        match error {
            ProbeError::Serial(error) => error.into(),
            error => {
                let is_invalid = error.is_invalid_input();
                Self::new(error, is_invalid)
            }
        }
    }
}
