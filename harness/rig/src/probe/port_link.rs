//! Runs the wire protocol over the serial port of a board on a debug probe.

use super::attached_board::AttachedBoard;
use super::error::ProbeError;
use super::image::Image;
use crate::link::{Link, LinkError, LinkKind, RealTimeLine};
use crate::serial_port::SerialLink;
use platebench_wire::{Message, Packet, PacketReader};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tracing::debug;

/// Dropping the link resets the chip, which boots at 0 V, and releases port and probe.
#[derive(Debug)]
pub struct PortLink {
    serial: SerialLink,
    board: AttachedBoard,
    image: Arc<Image>,
    answers: PacketReader,
}

impl PortLink {
    /// Waits for the handshake. Discards earlier bytes, such as noise or an old fault report.
    pub(super) fn open(
        serial: SerialLink,
        path: &Path,
        board: AttachedBoard,
        image: Arc<Image>,
    ) -> Result<Self, ProbeError> {
        let mut link = Self { serial, board, image, answers: PacketReader::new() };
        link.serial.expect_silence();
        let timeout = link.board.timeouts().handshake;
        let until = Instant::now() + timeout;
        let mut sequence = 0;
        loop {
            sequence = u8::wrapping_add(sequence, 1);
            let mut received = Vec::new();
            let hello = Packet { sequence, message: Message::Hello }.encode();
            let lost = |error: LinkError| ProbeError::Port { port: path.to_owned(), cause: error.to_string() };
            link.serial.exchange(Duration::ZERO, hello.as_bytes(), &mut received).map_err(lost)?;
            if link.contains_message(&received, |message| matches!(message, Message::Identity(_))) {
                debug!(sequence, "the firmware on the serial port answered the handshake");
                return Ok(link);
            }
            if Instant::now() >= until {
                let silent = ProbeError::NoHandshake { port: path.to_owned(), waited: timeout };
                return Err(link.board.trap_error(&link.image).unwrap_or(silent));
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
