//! Calls the board on the probe's thread, with time-outs.

use super::board::{Board, ChipId, FlashOutcome};
use super::error::ProbeError;
use super::image::Image;
use super::probe_thread::ProbeThread;
use super::rtt_channels::RttChannels;
use super::spec::ProbeSpec;
use super::timeouts::Timeouts;
use crate::crash_report::CrashReport;
use probe_rs::probe::list::Lister;
use std::sync::Arc;
use std::time::Duration;
use tracing::{info, warn};

/// Dropping the value resets the chip, which boots at 0 V, and releases the probe.
#[derive(Debug)]
pub struct AttachedBoard {
    thread: ProbeThread<Board>,
    chip: ChipId,
    timeouts: Timeouts,
    is_shut_down: bool,
}

impl AttachedBoard {
    /// Attaches to the chip and checks its identity. Writes nothing.
    pub fn attach(
        spec: &ProbeSpec,
        list: impl FnOnce() -> Lister + Send + 'static,
        timeouts: Timeouts,
    ) -> Result<Self, ProbeError> {
        let spec = spec.clone();
        let make = move || Board::attach(&spec, &list());
        let (thread, chip) = ProbeThread::spawn("attaching", timeouts.attach, make)?;
        Ok(Self { thread, chip, timeouts, is_shut_down: false })
    }

    pub fn chip(&self) -> &ChipId {
        &self.chip
    }

    pub fn timeouts(&self) -> &Timeouts {
        &self.timeouts
    }

    fn call<R: Send + 'static>(
        &self,
        doing: &'static str,
        timeout: Duration,
        job: impl FnOnce(&mut Board) -> Result<R, ProbeError> + Send + 'static,
    ) -> Result<R, ProbeError> {
        self.thread.call(doing, timeout + self.timeouts.grace, job)
    }

    /// Writes the image to flash and verifies it. Does nothing if the flash already contains it. A
    /// write resets and halts the processor, whose outputs float until [`AttachedBoard::restart`].
    pub fn flash(&mut self, image: &Arc<Image>) -> Result<FlashOutcome, ProbeError> {
        let image = Arc::clone(image);
        let outcome = self.call("flashing", self.timeouts.flash, move |board| board.flash(&image))?;
        info!(chip = self.chip.name, ?outcome, "firmware flashed");
        Ok(outcome)
    }

    pub fn restart(&mut self, image: &Image) -> Result<(), ProbeError> {
        let (rtt, timeout) = (image.rtt(), self.timeouts.reset);
        self.call("resetting the chip", timeout, move |board| board.restart(rtt, timeout))
    }

    /// Returns the crash if the processor is in a fault handler. The processor then stays halted.
    pub fn read_crash(&mut self, image: &Arc<Image>) -> Result<Option<CrashReport>, ProbeError> {
        let image = Arc::clone(image);
        self.call("reading a crash", self.timeouts.crash, move |board| board.read_crash(&image))
    }

    pub(super) fn trap_error(&mut self, image: &Arc<Image>) -> Option<ProbeError> {
        match self.read_crash(image) {
            Ok(crash) => crash.map(|crash| ProbeError::Trapped(Box::new(crash))),
            Err(error) => {
                warn!(%error, "the probe cannot read whether the processor trapped");
                None
            }
        }
    }

    pub(super) fn rtt(&mut self, address: u64) -> Result<RttChannels, ProbeError> {
        let timeout = self.timeouts.rtt;
        self.call("starting RTT", timeout, move |board| board.rtt(address, timeout))
    }

    pub(super) fn exchange(
        &mut self,
        mut channels: RttChannels,
        bytes: Vec<u8>,
    ) -> Result<(RttChannels, Vec<u8>), ProbeError> {
        let timeout = self.timeouts.exchange;
        self.call("an RTT exchange", timeout, move |board| {
            let received = board.exchange(&mut channels, &bytes, timeout)?;
            Ok((channels, received))
        })
    }

    /// Resets the chip, lets it boot at 0 V and releases the probe. Later calls do nothing.
    pub fn shut_down(&mut self) -> Result<(), ProbeError> {
        if std::mem::replace(&mut self.is_shut_down, true) {
            return Ok(());
        }
        let timeout = self.timeouts.reset;
        let reset = self.call("the reset at the session's end", timeout, move |board| board.restart(None, timeout));
        self.thread.stop(self.timeouts.grace);
        reset
    }
}

impl Drop for AttachedBoard {
    fn drop(&mut self) {
        if let Err(error) = self.shut_down() {
            warn!(%error, "the chip was not reset at the end of the session");
        }
    }
}
