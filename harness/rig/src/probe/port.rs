//! The wire protocol over a board's serial port, with the debug probe beside it: it flashes and resets, and looks where the processor is when an answer is missing.

use super::error::ProbeError;
use super::handle::Attached;
use super::image::Image;
use super::link::trapped;
use crate::link::{Line, Link, LinkError};
use crate::serial::Serial;
use platebench_wire::{FrameReader, Message, Packet};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tracing::debug;

/// A controller on a serial port whose board is on a debug probe. Dropping it resets the chip, which boots at 0 V, and releases port and probe.
#[derive(Debug)]
pub struct PortLink {
    serial: Serial,
    board: Attached,
    image: Arc<Image>,
    answers: FrameReader,
}

impl PortLink {
    /// Waits until the firmware that was just started says who it is. What came before that, noise of the reset and a report of an earlier trap, is thrown away.
    ///
    /// # Errors
    /// [`ProbeError::NoIntroduction`] where it does not within its time, [`ProbeError::Trapped`] where it trapped instead.
    pub(super) fn open(serial: Serial, path: &Path, board: Attached, image: Arc<Image>) -> Result<Self, ProbeError> {
        let mut link = Self { serial, board, image, answers: FrameReader::new() };
        let patience = link.board.patience().introduction;
        let until = Instant::now() + patience;
        let mut sequence = 0;
        loop {
            sequence = u8::wrapping_add(sequence, 1);
            let mut said = Vec::new();
            let asked = Packet { sequence, message: Message::Hello }.encode();
            let lost = |error: LinkError| ProbeError::Port { port: path.to_owned(), cause: error.to_string() };
            link.serial.exchange(Duration::ZERO, asked.as_bytes(), &mut said).map_err(lost)?;
            if link.hears(&said, |message| matches!(message, Message::Identity(_))) {
                debug!(sequence, "the firmware on the serial port introduced itself");
                return Ok(link);
            }
            if Instant::now() >= until {
                let silent = ProbeError::NoIntroduction { port: path.to_owned(), waited: patience };
                return Err(trapped(&mut link.board, &link.image).unwrap_or(silent));
            }
        }
    }

    fn hears(&mut self, said: &[u8], is_it: impl Fn(&Message) -> bool) -> bool {
        let mut heard = false;
        for &byte in said {
            let Some(Ok(body)) = self.answers.push(byte) else { continue };
            heard |= Packet::decode(body).is_ok_and(|packet| is_it(&packet.message));
        }
        heard
    }
}

impl Link for PortLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let before = answer.len();
        let delay = self.serial.exchange(now, bytes, answer)?;
        let said = answer.get(before..).unwrap_or_default();
        // A processor that has trapped reports it once at most; the probe knows more than the report.
        if (said.is_empty() || self.hears(said, |message| matches!(message, Message::Fault(_))))
            && let Some(error) = trapped(&mut self.board, &self.image)
        {
            return Err(error.into());
        }
        Ok(delay)
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.serial.pass(now, said)
    }

    fn line(&mut self) -> Option<&mut dyn Line> {
        self.serial.line()
    }
}
