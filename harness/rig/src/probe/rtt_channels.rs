//! Exchanges bytes over RTT channel 0, on the probe's thread.

use super::error::{ProbeError, error_chain};
use probe_rs::Core;
use probe_rs::rtt::{DownChannel, Rtt, UpChannel};
use std::time::{Duration, Instant};

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
            up: up.ok_or(ProbeError::RttChannel { direction: "up channel 0 (to the bench)" })?,
            down: down.ok_or(ProbeError::RttChannel { direction: "down channel 0 (from the bench)" })?,
        })
    }

    /// Reads waiting bytes. Then sends `bytes`, if any, and reads to the end of the next frame.
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
        // If a part of an unsolicited frame has arrived, the end of that frame precedes the answer.
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
        probe_rs::rtt::Error::Probe(cause) => ProbeError::Line { doing: "an RTT exchange", cause: Box::new(cause) },
        other => ProbeError::Rtt(error_chain(&other)),
    }
}
