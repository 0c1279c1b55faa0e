//! Defines the errors of a board on a debug probe.

use crate::crash_report::CrashReport;
use crate::link::LinkError;
use crate::serial::SerialError;
use crate::target_error::TargetError;
use probe_rs::flashing::FlashError;
use probe_rs::probe::DebugProbeError;
use std::error::Error;
use std::path::PathBuf;
use std::time::Duration;

/// Why a board on a debug probe cannot be used. Messages contain the whole chain of causes; there is no
/// [`Error::source`].
#[derive(Debug, thiserror::Error)]
pub enum ProbeError {
    /// The part after `probe:` has a wrong form.
    #[error(
        "`probe:{text}`: expected probe:CHIP[@VID:PID[:SERIAL]] with VID and PID in hexadecimal, such as \
         STM32F407VG@0483:374b"
    )]
    Spec {
        /// As typed.
        text: String,
    },
    /// The bench cannot check the identity of this chip.
    #[error(
        "the bench cannot check the identity of a `{chip}`, expected an STM32F4 such as STM32F405RG, STM32F407VG \
         or STM32F427VI"
    )]
    UnsupportedChip {
        /// As typed.
        chip: String,
    },
    /// No chip description has this name, or several have.
    #[error("no description of a chip `{chip}`: {cause}")]
    UnknownChip {
        /// As typed.
        chip: String,
        /// Message of the chip registry.
        cause: String,
    },
    /// No probe is connected, or none that matches.
    #[error(
        "no debug probe {}; is it plugged in, and may this user open it (docs/attach-a-board.md)?{}",
        .wanted.as_ref().map_or_else(|| "was found".to_owned(), |wanted| format!("matches {wanted}")),
        format_list(.others)
    )]
    NoProbe {
        /// The selector, if any.
        wanted: Option<String>,
        /// The connected probes.
        others: Vec<String>,
    },
    /// More than one probe matches.
    #[error(
        "{} debug probes match; choose one with --rig probe:CHIP@VID:PID[:SERIAL]:{}", .found.len(), format_list(.found)
    )]
    SeveralProbes {
        /// The matching probes.
        found: Vec<String>,
    },
    /// The operating system does not let this user open the probe.
    #[error("no permission to open the debug probe {probe}; on Linux a udev rule is missing (docs/attach-a-board.md)")]
    PermissionDenied {
        /// Which probe.
        probe: String,
    },
    /// Another program uses the probe.
    #[error("the debug probe {probe} is in use by another program: {cause}")]
    Busy {
        /// Which probe.
        probe: String,
        /// Message of the operating system.
        cause: String,
    },
    /// The probe cannot be opened for another reason.
    #[error("the debug probe {probe} cannot be opened: {}; unplug it and plug it in again", error_chain(.cause))]
    Open {
        /// Which probe.
        probe: String,
        /// Error of the driver.
        cause: Box<DebugProbeError>,
    },
    /// The chip does not answer.
    #[error(
        "no answer from a {chip} through the debug probe {probe}; check power, SWDIO, SWCLK and ground: {}",
        error_chain(.cause)
    )]
    NoTarget {
        /// The requested chip.
        chip: String,
        /// Which probe.
        probe: String,
        /// Error of the driver.
        cause: Box<probe_rs::Error>,
    },
    /// Another chip than the requested one.
    #[error("the chip has identity {found:#05x} ({family}), expected a {expected}; nothing was written to it")]
    WrongChip {
        /// The requested chip.
        expected: String,
        /// The device identity.
        found: u16,
        /// The chips with this identity.
        family: &'static str,
    },
    /// The file is not a firmware image.
    #[error("the file is not a firmware image: {problem}")]
    Image {
        /// The problem.
        problem: String,
    },
    /// The firmware file cannot be read.
    #[error("{}: {error}", path.display())]
    Read {
        /// Which file.
        path: PathBuf,
        /// The system's error.
        error: std::io::Error,
    },
    /// The image does not fit the chip.
    #[error("the image has {bytes} bytes at {address:#010x}, where {chip} has no flash; link it for this chip")]
    NotInFlash {
        /// The requested chip.
        chip: String,
        /// Address of the segment.
        address: u32,
        /// Its length.
        bytes: usize,
    },
    /// Erasing or programming failed.
    #[error("flashing failed: {}", error_chain(.0))]
    Flash(Box<FlashError>),
    /// The flash differs from the image after programming.
    #[error("flash verification failed at {address:#010x}: found {found:#04x}, expected {expected:#04x}")]
    Verify {
        /// The first different byte.
        address: u32,
        /// Its value in the image.
        expected: u8,
        /// Its value in the flash.
        found: u8,
    },
    /// The firmware has no RTT.
    #[error(
        "the firmware has no RTT control block (no symbol _SEGGER_RTT), so it needs its serial port: \
         --rig probe:CHIP,port=PORT[@BAUD]"
    )]
    NoRtt,
    /// The firmware has RTT but did not start it.
    #[error(
        "no RTT control block at {address:#010x} within {} ms after the reset; does the firmware run? {cause}",
        .waited.as_millis()
    )]
    RttNotStarted {
        /// Its expected address.
        address: u64,
        /// The time-out.
        waited: Duration,
        /// Error of the driver.
        cause: String,
    },
    /// The firmware does not answer on the serial port.
    #[error(
        "the firmware did not answer the handshake on {} within {} ms after the reset; is that the board's serial \
         port, at the firmware's baud rate?",
        port.display(),
        waited.as_millis()
    )]
    NoHandshake {
        /// The serial port.
        port: PathBuf,
        /// The time-out.
        waited: Duration,
    },
    /// The serial port was lost during the handshake.
    #[error("{}: {cause}", port.display())]
    Port {
        /// Which probe.
        port: PathBuf,
        /// Error of the line.
        cause: String,
    },
    /// RTT lacks channel 0 in one direction.
    #[error("the firmware's RTT has no channel 0 {direction}")]
    RttChannel {
        /// The missing direction.
        direction: &'static str,
    },
    /// RTT returned invalid data.
    #[error("RTT failed: {0}")]
    Rtt(String),
    /// The line to the chip failed.
    #[error("{doing} failed: {}", error_chain(.cause))]
    Line {
        /// The call.
        doing: &'static str,
        /// Error of the driver.
        cause: Box<probe_rs::Error>,
    },
    /// A call to the probe did not return.
    #[error(
        "the debug probe hangs: {doing} did not end within {} ms; unplug the probe and plug it in again",
        .waited.as_millis()
    )]
    CallTimedOut {
        /// The call.
        doing: &'static str,
        /// The time-out.
        waited: Duration,
    },
    /// The probe's thread ended.
    #[error("the debug probe's driver ended during {doing}")]
    ProbeThreadGone {
        /// The call.
        doing: &'static str,
    },
    /// The system cannot start a thread.
    #[error("cannot start a thread for the debug probe: {0}")]
    Thread(#[from] std::io::Error),
    /// The processor trapped.
    #[error("{0}")]
    Trapped(Box<CrashReport>),
    /// The board's serial port cannot be used.
    #[error(transparent)]
    Serial(#[from] SerialError),
}

impl ProbeError {
    /// True if the input is wrong, false if the board or the probe does not work.
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

    /// For `map_err`: an error of the driver while `doing` something.
    pub(super) fn line_error(doing: &'static str) -> impl Fn(probe_rs::Error) -> Self {
        move |cause| Self::Line { doing, cause: Box::new(cause) }
    }
}

impl From<ProbeError> for LinkError {
    /// A trap is an error of the firmware; everything else means that the board is lost.
    fn from(error: ProbeError) -> Self {
        match error {
            ProbeError::Trapped(crash) => Self::Target(Box::new(TargetError::Trap(crash))),
            lost => Self::Disconnected(lost.to_string()),
        }
    }
}

/// An error with all its sources, because only those of probe-rs name the reason.
pub(super) fn error_chain(error: &dyn Error) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(cause) = next {
        let cause_text = cause.to_string();
        if !text.ends_with(&cause_text) {
            text = format!("{}: {cause_text}", text.trim_end_matches('.'));
        }
        next = cause.source();
    }
    text
}

fn format_list(probes: &[String]) -> String {
    probes.iter().fold(String::new(), |text, probe| text + "\n  " + probe)
}
