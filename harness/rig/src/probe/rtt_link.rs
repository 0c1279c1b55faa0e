//! Runs the wire protocol over RTT channel 0, with the same bytes as on a serial line.

use super::attached_board::AttachedBoard;
use super::error::ProbeError;
use super::image::Image;
use super::rtt_channels::RttChannels;
use crate::link::{Link, LinkError, LinkKind};
use platebench_wire::{ControllerState, Message, Packet, PacketReader};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tracing::{info, warn};

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
    image: Arc<Image>,
    /// `None` during an exchange, and after a failed one.
    channels: Option<RttChannels>,
    is_shut_down: bool,
}

impl RttLink {
    pub fn open(mut board: AttachedBoard, image: Arc<Image>) -> Result<Self, ProbeError> {
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
