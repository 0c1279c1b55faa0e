//! Speaks the wire protocol over RTT: channel 0 in both directions, with the bytes of a serial line.

use super::attached_board::AttachedBoard;
use super::error::{ProbeError, error_chain};
use super::image::Image;
use crate::link::{Link, LinkError};
use platebench_wire::{ControllerState, Message, Packet, PacketReader};
use probe_rs::Core;
use probe_rs::rtt::{DownChannel, Rtt, UpChannel};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tracing::{info, warn};

/// Sequence number of the request for 0 V at the end.
const SAFE_SEQUENCE: u8 = 0xff;

/// Channel 0 in both directions.
#[derive(Debug)]
pub(super) struct RttChannels {
    up: UpChannel,
    down: DownChannel,
}

impl RttChannels {
    pub(super) fn from_rtt(rtt: Rtt) -> Result<Self, ProbeError> {
        let up = rtt.up_channels.into_iter().find(|channel| channel.number() == 0);
        let down = rtt.down_channels.into_iter().find(|channel| channel.number() == 0);
        Ok(Self {
            up: up.ok_or(ProbeError::RttChannel { direction: "to the bench" })?,
            down: down.ok_or(ProbeError::RttChannel { direction: "from the bench" })?,
        })
    }

    /// Reads the waiting bytes. Then sends `bytes`, if any, and reads up to the end of the next frame.
    pub(super) fn exchange(
        &mut self,
        core: &mut Core<'_>,
        bytes: &[u8],
        timeout: Duration,
    ) -> Result<Vec<u8>, ProbeError> {
        let until = Instant::now() + timeout;
        let mut received = Vec::new();
        self.read(core, &mut received)?;
        if bytes.is_empty() {
            return Ok(received);
        }
        // The first frame to end may be an unsolicited one that has begun.
        let mut ends = if received.last().is_some_and(|&byte| byte != 0) { 2 } else { 1 };
        let mut unsent = bytes;
        loop {
            if !unsent.is_empty() {
                let sent = self.down.write(core, unsent).map_err(rtt_error)?;
                unsent = unsent.get(sent..).unwrap_or_default();
            }
            let before = received.len();
            self.read(core, &mut received)?;
            let new = received.iter().skip(before).filter(|&&byte| byte == 0).count();
            ends -= new.min(ends);
            if ends == 0 || Instant::now() >= until {
                return Ok(received);
            }
        }
    }

    fn read(&mut self, core: &mut Core<'_>, received: &mut Vec<u8>) -> Result<(), ProbeError> {
        let mut buffer = [0; 256];
        let count = self.up.read(core, &mut buffer).map_err(rtt_error)?;
        received.extend(buffer.iter().take(count));
        Ok(())
    }
}

fn rtt_error(error: probe_rs::rtt::Error) -> ProbeError {
    match error {
        probe_rs::rtt::Error::Probe(cause) => ProbeError::Line { doing: "an exchange", cause: Box::new(cause) },
        other => ProbeError::Rtt(error_chain(&other)),
    }
}

/// Result of the end of a session.
#[derive(Debug)]
pub struct ShutdownResult {
    /// The firmware confirmed 0 V before the reset.
    pub zero_volts_confirmed: bool,
    /// The reset that follows in any case; the chip boots at 0 V.
    pub reset: Result<(), ProbeError>,
}

/// A controller on a debug probe. Dropping it requests 0 V, resets the chip and releases the probe.
#[derive(Debug)]
pub struct RttLink {
    board: AttachedBoard,
    image: Arc<Image>,
    /// `None` during an exchange, and after one that failed.
    channels: Option<RttChannels>,
    is_shut_down: bool,
}

impl RttLink {
    /// Opens the RTT of the firmware on `board`.
    ///
    /// # Errors
    /// [`ProbeError::NoRtt`] if the image has none, [`ProbeError::RttNotStarted`] if it does not start it.
    pub fn open(mut board: AttachedBoard, image: Arc<Image>) -> Result<Self, ProbeError> {
        let address = image.rtt().ok_or(ProbeError::NoRtt)?;
        let channels = match board.rtt(address) {
            Ok(channels) => channels,
            Err(error) => return Err(board.trap_error(&image).unwrap_or(error)),
        };
        Ok(Self { board, image, channels: Some(channels), is_shut_down: false })
    }

    /// The board.
    pub fn board(&mut self) -> &mut AttachedBoard {
        &mut self.board
    }

    fn exchange_bytes(&mut self, bytes: &[u8]) -> Result<Vec<u8>, ProbeError> {
        let channels = self.channels.take().ok_or_else(|| ProbeError::Rtt("closed after an earlier error".into()))?;
        let (channels, received) = self.board.exchange(channels, bytes.to_vec())?;
        self.channels = Some(channels);
        // A trapped processor sends nothing.
        if received.is_empty()
            && let Some(error) = self.board.trap_error(&self.image)
        {
            self.channels = None;
            return Err(error);
        }
        Ok(received)
    }

    /// Requests 0 V, resets the chip and releases the probe; at most once.
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
}

impl Drop for RttLink {
    fn drop(&mut self) {
        if let Err(error) = self.shut_down().reset {
            warn!(%error, "the chip was not reset at the end of the session");
        }
    }
}
