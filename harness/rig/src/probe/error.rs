//! Defines the errors of a board on a debug probe.

use crate::crash_report::CrashReport;
use crate::link::{LinkError, TargetError};
use crate::serial_port::SerialError;
use probe_rs::flashing::FlashError;
use probe_rs::probe::DebugProbeError;
use std::error::Error;
use std::path::PathBuf;
use std::time::Duration;

/// Each message contains the whole chain of causes.
#[derive(Debug, thiserror::Error)]
pub enum ProbeError {
    #[error(
        "`probe:{text}`: expected probe:CHIP[@VID:PID[:SERIAL]] with VID and PID in hexadecimal, such as \
         STM32F407VG@0483:374b"
    )]
    Spec { text: String },
    #[error(
        "the bench cannot check the identity of a `{chip}`, expected an STM32F4 such as STM32F405RG, STM32F407VG \
         or STM32F427VI"
    )]
    UnsupportedChip { chip: String },
    #[error("no description of a chip `{chip}`, expected a full part number such as STM32F407VG: {cause}")]
    UnknownChip { chip: String, cause: String },
    #[error(
        "no debug probe {}; is it plugged in, and may this user open it (docs/attach-a-board.md)?{}",
        .wanted.as_ref().map_or_else(|| "was found".to_owned(), |wanted| format!("matches {wanted}")),
        format_list(.others)
    )]
    NoProbe { wanted: Option<String>, others: Vec<String> },
    #[error(
        "{} debug probes match; choose one with --rig probe:CHIP@VID:PID[:SERIAL]:{}", .found.len(), format_list(.found)
    )]
    SeveralProbes { found: Vec<String> },
    #[error("no permission to open the debug probe {probe}; on Linux a udev rule is missing (docs/attach-a-board.md)")]
    PermissionDenied { probe: String },
    #[error("the debug probe {probe} is in use by another program: {cause}")]
    Busy { probe: String, cause: String },
    #[error("the debug probe {probe} cannot be opened: {}; unplug it and plug it in again", error_chain(.cause))]
    Open { probe: String, cause: Box<DebugProbeError> },
    #[error(
        "no answer from a {chip} through the debug probe {probe}; check power, SWDIO, SWCLK and ground: {}",
        error_chain(.cause)
    )]
    NoTarget { chip: String, probe: String, cause: Box<probe_rs::Error> },
    #[error(
        "the connected chip has the device code {found:#05x} ({family}), expected a {expected}; \
         nothing was written to it"
    )]
    WrongChip {
        expected: String,
        /// Lower twelve bits of `DBGMCU_IDCODE`.
        found: u16,
        family: &'static str,
    },
    #[error("the file is not a firmware image: {problem}")]
    Image { problem: String },
    #[error("{}: {error}", path.display())]
    Read { path: PathBuf, error: std::io::Error },
    #[error(
        "the image has {bytes} bytes from {address:#010x}, which do not fit into the flash of {chip}; \
         link it for this chip"
    )]
    NotInFlash { chip: String, address: u32, bytes: usize },
    #[error("flashing failed: {}", error_chain(.0))]
    Flash(Box<FlashError>),
    #[error("flash verification failed at {address:#010x}: found {found:#04x}, expected {expected:#04x}")]
    Verify { address: u32, expected: u8, found: u8 },
    #[error(
        "the firmware has no RTT control block (no symbol _SEGGER_RTT), so it needs its serial port: \
         --rig probe:CHIP,port=PORT[@BAUD]"
    )]
    NoRtt,
    #[error(
        "no RTT control block at {address:#010x} within {} ms after the reset; does the firmware run? {cause}",
        .waited.as_millis()
    )]
    RttNotStarted { address: u64, waited: Duration, cause: String },
    #[error(
        "the firmware did not answer the handshake on {} within {} ms after the reset; is that the board's serial \
         port, at the firmware's baud rate?",
        port.display(),
        waited.as_millis()
    )]
    NoHandshake { port: PathBuf, waited: Duration },
    #[error("the serial port {} failed during the handshake: {cause}", port.display())]
    Port { port: PathBuf, cause: String },
    #[error("the firmware's RTT control block has no {direction}, expected one for the bench's messages")]
    RttChannel { direction: &'static str },
    #[error("the RTT connection to the firmware failed: {0}")]
    Rtt(String),
    #[error("{doing} failed: {}", error_chain(.cause))]
    Line { doing: &'static str, cause: Box<probe_rs::Error> },
    #[error(
        "the debug probe hangs: {doing} did not end within {} ms; unplug the probe and plug it in again",
        .waited.as_millis()
    )]
    CallTimedOut { doing: &'static str, waited: Duration },
    #[error("{doing} is not possible, because the debug probe hangs; unplug the probe and plug it in again")]
    ProbeHangs { doing: &'static str },
    #[error("internal error: the thread of the debug probe ended during {doing}; start the run again")]
    ProbeThreadGone { doing: &'static str },
    #[error("cannot start a thread for the debug probe: {0}")]
    Thread(#[from] std::io::Error),
    #[error("{0}")]
    Trapped(Box<CrashReport>),
    #[error(transparent)]
    Serial(#[from] SerialError),
}

impl ProbeError {
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

    pub(super) fn line_error(doing: &'static str) -> impl Fn(probe_rs::Error) -> Self {
        move |cause| Self::Line { doing, cause: Box::new(cause) }
    }
}

impl From<ProbeError> for LinkError {
    /// A trap is an error of the firmware. After any other error, the board is lost.
    fn from(error: ProbeError) -> Self {
        match error {
            ProbeError::Trapped(crash) => Self::Target(Box::new(TargetError::Trap(crash))),
            lost => Self::Disconnected(lost.to_string()),
        }
    }
}

/// Joins the messages of all causes, because the outer errors of probe-rs do not name the reason.
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
