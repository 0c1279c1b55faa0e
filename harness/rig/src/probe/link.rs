//! The wire protocol over RTT: channel 0 down to the firmware, channel 0 up to the bench, the same bytes as on a serial line.

use super::error::{ProbeError, chain};
use super::handle::Attached;
use super::image::Image;
use crate::link::{Link, LinkError};
use platebench_wire::{FrameReader, Message, Packet, State};
use probe_rs::Core;
use probe_rs::rtt::{DownChannel, Rtt, UpChannel};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tracing::{info, warn};

/// Sequence number of the question for 0 V at the end.
const LAST: u8 = 0xff;

/// Channel 0 in both directions.
#[derive(Debug)]
pub(super) struct Channels {
    up: UpChannel,
    down: DownChannel,
}

impl Channels {
    pub(super) fn of(rtt: Rtt) -> Result<Self, ProbeError> {
        let up = rtt.up_channels.into_iter().find(|channel| channel.number() == 0);
        let down = rtt.down_channels.into_iter().find(|channel| channel.number() == 0);
        Ok(Self {
            up: up.ok_or(ProbeError::RttChannel { direction: "to the bench" })?,
            down: down.ok_or(ProbeError::RttChannel { direction: "from the bench" })?,
        })
    }

    /// What the firmware has said until now; with `bytes`, these are sent then and what comes up to the end of the next frame is added.
    pub(super) fn exchange(
        &mut self,
        core: &mut Core<'_>,
        bytes: &[u8],
        patience: Duration,
    ) -> Result<Vec<u8>, ProbeError> {
        let until = Instant::now() + patience;
        let mut said = Vec::new();
        self.read(core, &mut said)?;
        if bytes.is_empty() {
            return Ok(said);
        }
        // The firmware may be in the middle of saying something unasked: its end is not the end of the answer.
        let mut ends = if said.last().is_some_and(|&byte| byte != 0) { 2 } else { 1 };
        let mut unsent = bytes;
        loop {
            if !unsent.is_empty() {
                let sent = self.down.write(core, unsent).map_err(failed)?;
                unsent = unsent.get(sent..).unwrap_or_default();
            }
            let before = said.len();
            self.read(core, &mut said)?;
            let new = said.iter().skip(before).filter(|&&byte| byte == 0).count();
            ends -= new.min(ends);
            if ends == 0 || Instant::now() >= until {
                return Ok(said);
            }
        }
    }

    fn read(&mut self, core: &mut Core<'_>, said: &mut Vec<u8>) -> Result<(), ProbeError> {
        let mut buffer = [0; 256];
        let count = self.up.read(core, &mut buffer).map_err(failed)?;
        said.extend(buffer.iter().take(count));
        Ok(())
    }
}

fn failed(error: probe_rs::rtt::Error) -> ProbeError {
    match error {
        probe_rs::rtt::Error::Probe(cause) => ProbeError::Line { doing: "an exchange", cause: Box::new(cause) },
        other => ProbeError::Rtt(chain(&other)),
    }
}

/// How a session with a board ended.
#[derive(Debug)]
pub struct Ending {
    /// The firmware said that it is safe at 0 V before the reset.
    pub zero_volts_confirmed: bool,
    /// The reset that follows in any case: its boot state is 0 V.
    pub reset: Result<(), ProbeError>,
}

/// A controller on a debug probe. Dropping it asks for 0 V, resets the chip and releases the probe.
#[derive(Debug)]
pub struct RttLink {
    board: Attached,
    image: Arc<Image>,
    /// Away during an exchange, and for good after one that failed.
    channels: Option<Channels>,
    ended: bool,
}

impl RttLink {
    /// Finds the RTT of the firmware that runs on `board`.
    ///
    /// # Errors
    /// [`ProbeError::NoRtt`] where the image has none, [`ProbeError::RttNotStarted`] where it does not start it.
    pub fn open(mut board: Attached, image: Arc<Image>) -> Result<Self, ProbeError> {
        let address = image.rtt().ok_or(ProbeError::NoRtt)?;
        let channels = match board.rtt(address) {
            Ok(channels) => channels,
            Err(error) => return Err(trapped(&mut board, &image).unwrap_or(error)),
        };
        Ok(Self { board, image, channels: Some(channels), ended: false })
    }

    /// The board itself.
    pub fn board(&mut self) -> &mut Attached {
        &mut self.board
    }

    fn say(&mut self, bytes: &[u8]) -> Result<Vec<u8>, ProbeError> {
        let channels = self.channels.take().ok_or_else(|| ProbeError::Rtt("given up after an earlier error".into()))?;
        let (channels, said) = self.board.exchange(channels, bytes.to_vec(), self.board.patience().exchange)?;
        self.channels = Some(channels);
        // A processor that has trapped says nothing any more.
        if said.is_empty()
            && let Some(error) = trapped(&mut self.board, &self.image)
        {
            self.channels = None;
            return Err(error);
        }
        Ok(said)
    }

    /// Asks for 0 V, resets the chip and releases the probe; at most once.
    pub fn end(&mut self) -> Ending {
        let first = !std::mem::replace(&mut self.ended, true);
        let zero_volts_confirmed = first && self.channels.is_some() && self.is_safe();
        let reset = self.board.end();
        if first {
            info!(zero_volts_confirmed, reset = reset.is_ok(), "end of the session");
        }
        Ending { zero_volts_confirmed, reset }
    }

    fn is_safe(&mut self) -> bool {
        let frame = Packet { sequence: LAST, message: Message::Safe }.encode();
        let Ok(said) = self.say(frame.as_bytes()) else { return false };
        let mut reader = FrameReader::new();
        said.iter().any(|&byte| {
            let packet = reader.push(byte).and_then(Result::ok).and_then(|body| Packet::decode(body).ok());
            matches!(packet, Some(Packet { sequence: LAST, message: Message::Command(command) })
                if command.state == State::Safe && command.drive_vpp == 0.0)
        })
    }
}

/// The trap, where there is one to be read.
pub(super) fn trapped(board: &mut Attached, image: &Arc<Image>) -> Option<ProbeError> {
    match board.fault(image) {
        Ok(fault) => fault.map(|fault| ProbeError::Trapped(Box::new(fault))),
        Err(error) => {
            warn!(%error, "whether the processor trapped could not be read");
            None
        }
    }
}

impl Link for RttLink {
    fn exchange(&mut self, _now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let asked = Instant::now();
        answer.extend(self.say(bytes)?);
        Ok(asked.elapsed())
    }

    fn pass(&mut self, _now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        said.extend(self.say(&[])?);
        Ok(())
    }
}

impl Drop for RttLink {
    fn drop(&mut self) {
        let ending = self.end();
        if let Err(error) = ending.reset {
            warn!(%error, "the chip was not reset at the end");
        }
    }
}
