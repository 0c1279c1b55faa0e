//! Why a board on a debug probe cannot be worked with.

use super::fault::Fault;
use crate::emulated::TargetFault;
use crate::link::LinkError;
use probe_rs::flashing::FlashError;
use probe_rs::probe::DebugProbeError;
use std::error::Error;
use std::path::PathBuf;
use std::time::Duration;

/// Why a board on a debug probe cannot be worked with. Messages carry the whole chain of causes, so there is no [`Error::source`] behind them.
#[derive(Debug, thiserror::Error)]
pub enum ProbeError {
    /// What stands after `probe:` is not understood.
    #[error(
        "`probe:{text}`: expected probe:CHIP[@VID:PID[:SERIAL]] with VID and PID in hexadecimal, such as STM32F407VG@0483:374b"
    )]
    Spec {
        /// As written.
        text: String,
    },
    /// The bench does not know how to check the identity of this chip.
    #[error(
        "`{chip}` is none of the chips that the bench can check; it works with STM32F4, such as STM32F405RG, STM32F407VG or STM32F427VI"
    )]
    UnsupportedChip {
        /// As written.
        chip: String,
    },
    /// No chip description has this name, or several have.
    #[error("no description of a chip `{chip}`: {cause}")]
    UnknownChip {
        /// As written.
        chip: String,
        /// What the registry of chips says.
        cause: String,
    },
    /// No probe is connected, or none that was meant.
    #[error(
        "no debug probe {}; is it plugged in, and may this user open it (docs/attach-a-board.md)?{}",
        .wanted.as_ref().map_or_else(|| "was found".to_owned(), |wanted| format!("matches {wanted}")),
        listed(.others)
    )]
    NoProbe {
        /// The selector, where there was one.
        wanted: Option<String>,
        /// Probes that are there all the same.
        others: Vec<String>,
    },
    /// More than one probe is meant.
    #[error("{} debug probes could be meant; choose one with --rig probe:CHIP@VID:PID[:SERIAL]:{}", .found.len(), listed(.found))]
    SeveralProbes {
        /// All that match.
        found: Vec<String>,
    },
    /// The operating system does not let this user open the probe.
    #[error("no permission to open the debug probe {probe}; on Linux a udev rule is missing (docs/attach-a-board.md)")]
    Denied {
        /// Which one.
        probe: String,
    },
    /// Somebody else has the probe.
    #[error("the debug probe {probe} is in use by another program: {cause}")]
    Busy {
        /// Which one.
        probe: String,
        /// What the operating system says.
        cause: String,
    },
    /// The probe cannot be opened for another reason.
    #[error("the debug probe {probe} cannot be opened: {}; unplug it and plug it in again", chain(.cause))]
    Open {
        /// Which one.
        probe: String,
        /// What the driver says.
        cause: Box<DebugProbeError>,
    },
    /// The probe works, the chip does not answer.
    #[error("no answer from a {chip} through the debug probe {probe}; check power, SWDIO, SWCLK and ground: {}", chain(.cause))]
    NoTarget {
        /// Which chip was asked for.
        chip: String,
        /// Which probe.
        probe: String,
        /// What was tried.
        cause: Box<probe_rs::Error>,
    },
    /// Another chip than the one asked for.
    #[error("the chip says {found:#05x} ({family}), which is no {asked}; nothing was written to it")]
    WrongChip {
        /// Which chip was asked for.
        asked: String,
        /// Its device identity.
        found: u16,
        /// Which chips have this identity.
        family: &'static str,
    },
    /// The file is no firmware image.
    #[error("this is no firmware image that can be flashed: {problem}")]
    Image {
        /// What is wrong with it.
        problem: String,
    },
    /// The file with the firmware cannot be read.
    #[error("{}: {error}", path.display())]
    Read {
        /// Which file.
        path: PathBuf,
        /// Why not.
        error: std::io::Error,
    },
    /// The image does not fit the chip.
    #[error(
        "the image puts {bytes} bytes at {address:#010x}, where {chip} has no flash; which chip was it linked for?"
    )]
    NotInFlash {
        /// Which chip was asked for.
        chip: String,
        /// Where the image wants to be.
        address: u32,
        /// How much of it.
        bytes: usize,
    },
    /// Erasing or programming failed.
    #[error("flashing failed: {}", chain(.0))]
    Flash(Box<FlashError>),
    /// Programming said that all was well, and the flash holds something else.
    #[error("flash does not hold what was written: {found:#04x} at {address:#010x} instead of {expected:#04x}")]
    Verify {
        /// The first byte that differs.
        address: u32,
        /// What the image has there.
        expected: u8,
        /// What was read back.
        found: u8,
    },
    /// The firmware has no RTT.
    #[error(
        "the firmware has no RTT control block (no symbol _SEGGER_RTT); it talks over its serial port: name that port: --rig probe:CHIP,port=PORT[@BAUD]"
    )]
    NoRtt,
    /// The firmware has RTT and did not start it.
    #[error("no RTT control block at {address:#010x} within {} ms of the reset; does the firmware run? {cause}", .waited.as_millis())]
    RttNotStarted {
        /// Where it should be.
        address: u64,
        /// How long was waited.
        waited: Duration,
        /// What was found instead.
        cause: String,
    },
    /// The firmware was started, and nothing comes from the serial port.
    #[error(
        "the firmware did not introduce itself on {} within {} ms of the reset; is that the board's serial port, at the firmware's baud rate?", port.display(), waited.as_millis()
    )]
    NoIntroduction {
        /// Where it was waited for.
        port: PathBuf,
        /// How long.
        waited: Duration,
    },
    /// The serial port went away while the firmware was waited for.
    #[error("{}: {cause}", port.display())]
    Port {
        /// Which one.
        port: PathBuf,
        /// What the line says.
        cause: String,
    },
    /// RTT without a channel 0 in both directions.
    #[error("the firmware's RTT has no channel 0 {direction}")]
    RttChannel {
        /// The direction that is missing.
        direction: &'static str,
    },
    /// RTT stopped making sense.
    #[error("RTT failed: {0}")]
    Rtt(String),
    /// The line to the chip failed.
    #[error("{doing} failed: {}", chain(.cause))]
    Line {
        /// What was being done.
        doing: &'static str,
        /// What went wrong.
        cause: Box<probe_rs::Error>,
    },
    /// A call into the probe did not come back.
    #[error("the debug probe hangs: {doing} did not end within {} ms; unplug the probe and plug it in again", .waited.as_millis())]
    Hung {
        /// What was being done.
        doing: &'static str,
        /// How long was waited.
        waited: Duration,
    },
    /// The thread of the probe is gone.
    #[error("the debug probe's driver broke down during {doing}")]
    Crashed {
        /// What was being done.
        doing: &'static str,
    },
    /// The operating system gives no thread.
    #[error("no thread for the debug probe: {0}")]
    Thread(#[from] std::io::Error),
    /// The processor trapped.
    #[error("{0}")]
    Trapped(Box<Fault>),
}

impl ProbeError {
    /// True where what the user named is at fault, not the board or the way to it.
    pub fn is_invalid_input(&self) -> bool {
        matches!(
            self,
            Self::Spec { .. }
                | Self::UnsupportedChip { .. }
                | Self::UnknownChip { .. }
                | Self::SeveralProbes { .. }
                | Self::Image { .. }
                | Self::Read { .. }
                | Self::NotInFlash { .. }
                | Self::NoRtt
        )
    }

    /// For `map_err`: a line failure while `doing` something.
    pub(super) fn line(doing: &'static str) -> impl Fn(probe_rs::Error) -> Self {
        move |cause| Self::Line { doing, cause: Box::new(cause) }
    }
}

impl From<ProbeError> for LinkError {
    /// A trap is the firmware's doing; everything else means that the board is out of reach.
    fn from(error: ProbeError) -> Self {
        match error {
            ProbeError::Trapped(fault) => Self::Target(Box::new(TargetFault::OnBoard(fault.to_string()))),
            lost => Self::Disconnected(lost.to_string()),
        }
    }
}

/// An error and everything behind it; probe-rs tells the reason in the sources only.
pub(super) fn chain(error: &dyn Error) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(cause) = next {
        let said = cause.to_string();
        if !text.ends_with(&said) {
            text = format!("{}: {said}", text.trim_end_matches('.'));
        }
        next = cause.source();
    }
    text
}

fn listed(probes: &[String]) -> String {
    probes.iter().fold(String::new(), |text, probe| text + "\n  " + probe)
}
