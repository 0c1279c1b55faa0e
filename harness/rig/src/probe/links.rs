//! Runs the wire protocol with a board on a debug probe, with the same bytes: over its serial port
//! ([`PortLink`]) or over RTT channel 0 ([`RttLink`]).

use super::attached_board::AttachedBoard;
use super::board::RttChannels;
use super::error::ProbeError;
use super::image::FlashImage;
use crate::cancel::CancelToken;
use crate::handshake::handshake;
use crate::link::{Link, LinkError, LinkKind, RealTimeLine};
use crate::rig_error::RigError;
use crate::serial_port::SerialLink;
use platebench_wire::{ControllerState, Message, Packet, PacketReader};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tracing::{info, warn};

/// Dropping the link resets the chip, which boots at 0 V, and releases port and probe.
#[derive(Debug)]
pub struct PortLink {
    serial: SerialLink,
    board: AttachedBoard,
    image: Arc<FlashImage>,
    answers: PacketReader,
}

impl PortLink {
    /// Waits for the handshake. Discards earlier bytes, such as noise or an old fault report.
    pub(super) fn open(
        serial: SerialLink,
        path: &Path,
        board: AttachedBoard,
        image: Arc<FlashImage>,
    ) -> Result<Self, ProbeError> {
        let mut link = Self { serial, board, image, answers: PacketReader::new() };
        link.serial.expect_silence();
        let timeout = link.board.timeouts().handshake;
        match handshake(&mut link.serial, timeout, &CancelToken::never(), || None) {
            Ok(_) => Ok(link),
            Err(RigError::Link(error)) => Err(ProbeError::Port { port: path.to_owned(), cause: error.to_string() }),
            Err(_) => {
                let silent = ProbeError::NoHandshake { port: path.to_owned(), waited: timeout };
                Err(link.board.trap_error(&link.image).unwrap_or(silent))
            }
        }
    }

    fn contains_message(&mut self, received: &[u8], matches: impl Fn(&Message) -> bool) -> bool {
        // Uses `count` instead of `any`, because the reader must receive all bytes to keep an
        // incomplete frame for the next call.
        self.answers.packets(received).flatten().filter(|packet| matches(&packet.message)).count() > 0
    }
}

impl Link for PortLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let before = answer.len();
        let delay = self.serial.exchange(now, bytes, answer)?;
        let received = answer.get(before..).unwrap_or_default();
        // A trapped processor sends nothing, or one fault report. The probe can read more than the
        // report contains.
        if (received.is_empty() || self.contains_message(received, |message| matches!(message, Message::Fault(_))))
            && let Some(error) = self.board.trap_error(&self.image)
        {
            return Err(error.into());
        }
        Ok(delay)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.serial.advance_to(now, received)
    }

    fn kind(&self) -> LinkKind {
        self.serial.kind()
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        self.serial.real_time_line()
    }
}

const SAFE_SEQUENCE: u8 = 0xff;

#[derive(Debug)]
pub struct ShutdownResult {
    pub zero_volts_confirmed: bool,
    /// Result of the reset, after which the chip boots at 0 V. Every shutdown resets it.
    pub reset: Result<(), ProbeError>,
}

/// Dropping the link requests 0 V, resets the chip and releases the probe.
#[derive(Debug)]
pub struct RttLink {
    board: AttachedBoard,
    image: Arc<FlashImage>,
    /// `None` during an exchange, and after a failed one.
    channels: Option<RttChannels>,
    is_shut_down: bool,
}

impl RttLink {
    pub fn open(mut board: AttachedBoard, image: Arc<FlashImage>) -> Result<Self, ProbeError> {
        let address = image.rtt().ok_or(ProbeError::NoRtt)?;
        let channels = match board.rtt(address) {
            Ok(channels) => channels,
            Err(error) => return Err(board.trap_error(&image).unwrap_or(error)),
        };
        Ok(Self { board, image, channels: Some(channels), is_shut_down: false })
    }

    pub fn board(&mut self) -> &mut AttachedBoard {
        &mut self.board
    }

    fn exchange_bytes(&mut self, bytes: &[u8]) -> Result<Vec<u8>, ProbeError> {
        let channels =
            self.channels.take().ok_or_else(|| ProbeError::Rtt("the bench closed it after an earlier error".into()))?;
        let (channels, received) = self.board.exchange(channels, bytes.to_vec())?;
        self.channels = Some(channels);
        // No answer may mean that the processor has trapped.
        if received.is_empty()
            && let Some(error) = self.board.trap_error(&self.image)
        {
            self.channels = None;
            return Err(error);
        }
        Ok(received)
    }

    /// Requests 0 V, resets the chip and releases the probe. Later calls do nothing.
    pub fn shut_down(&mut self) -> ShutdownResult {
        let first = !std::mem::replace(&mut self.is_shut_down, true);
        let zero_volts_confirmed = first && self.channels.is_some() && self.request_safe_state();
        let reset = self.board.shut_down();
        if first {
            info!(zero_volts_confirmed, reset = reset.is_ok(), "session ended");
        }
        ShutdownResult { zero_volts_confirmed, reset }
    }

    fn request_safe_state(&mut self) -> bool {
        let frame = Packet { sequence: SAFE_SEQUENCE, message: Message::Safe }.encode();
        let Ok(received) = self.exchange_bytes(frame.as_bytes()) else { return false };
        PacketReader::new().packets(&received).flatten().any(|packet| {
            matches!(packet, Packet { sequence: SAFE_SEQUENCE, message: Message::Command(command) }
                if command.state == ControllerState::Safe && command.drive_vpp == 0.0)
        })
    }
}

impl Link for RttLink {
    fn exchange(&mut self, _now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let sent = Instant::now();
        answer.extend(self.exchange_bytes(bytes)?);
        Ok(sent.elapsed())
    }

    fn advance_to(&mut self, _now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        received.extend(self.exchange_bytes(&[])?);
        Ok(())
    }

    fn kind(&self) -> LinkKind {
        LinkKind::Lossy
    }
}

impl Drop for RttLink {
    fn drop(&mut self) {
        if let Err(error) = self.shut_down().reset {
            warn!(%error, "the chip was not reset at the end of the session");
        }
    }
}
