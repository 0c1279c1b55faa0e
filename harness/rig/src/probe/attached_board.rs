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

/// A board with the requested chip. Dropping it resets the chip, which boots at 0 V, and releases the
/// probe.
#[derive(Debug)]
pub struct AttachedBoard {
    thread: ProbeThread<Board>,
    chip: ChipId,
    timeouts: Timeouts,
    is_shut_down: bool,
}

impl AttachedBoard {
    /// Finds the probe among those that `list` finds, attaches and checks the chip. Writes nothing.
    ///
    /// # Errors
    /// [`ProbeError`], within [`Timeouts::attach`].
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

    /// The chip.
    pub fn chip(&self) -> &ChipId {
        &self.chip
    }

    /// The time-outs of its calls.
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

    /// Writes the image to flash and reads it back; writes nothing if it is there already. Flashing resets
    /// and halts the processor: its outputs float until [`AttachedBoard::restart`].
    ///
    /// # Errors
    /// [`ProbeError`] if it does not fit, cannot be written, or reads back differently.
    pub fn flash(&mut self, image: &Arc<Image>) -> Result<FlashOutcome, ProbeError> {
        let image = Arc::clone(image);
        let outcome = self.call("flashing", self.timeouts.flash, move |board| board.flash(&image))?;
        info!(chip = self.chip.name, ?outcome, "firmware flashed");
        Ok(outcome)
    }

    /// Resets the chip and lets the firmware run.
    ///
    /// # Errors
    /// [`ProbeError`] if the chip does not restart.
    pub fn restart(&mut self, image: &Image) -> Result<(), ProbeError> {
        let (rtt, timeout) = (image.rtt(), self.timeouts.reset);
        self.call("resetting the chip", timeout, move |board| board.restart(rtt, timeout))
    }

    /// Reads the crash if the processor is in a fault handler; it then stays halted.
    ///
    /// # Errors
    /// [`ProbeError`] if the probe cannot read it.
    pub fn read_crash(&mut self, image: &Arc<Image>) -> Result<Option<CrashReport>, ProbeError> {
        let image = Arc::clone(image);
        self.call("reading a crash", self.timeouts.crash, move |board| board.read_crash(&image))
    }

    /// The crash of the firmware as an error, if there is one.
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

    /// Exchanges bytes over RTT; moves the channels to the probe's thread and back.
    pub(super) fn exchange(
        &mut self,
        mut channels: RttChannels,
        bytes: Vec<u8>,
    ) -> Result<(RttChannels, Vec<u8>), ProbeError> {
        let timeout = self.timeouts.exchange;
        self.call("an exchange", timeout, move |board| {
            let received = board.exchange(&mut channels, &bytes, timeout)?;
            Ok((channels, received))
        })
    }

    /// Resets the chip, lets it boot at 0 V and releases the probe; at most once.
    ///
    /// # Errors
    /// [`ProbeError`] if the reset fails.
    pub fn shut_down(&mut self) -> Result<(), ProbeError> {
        if std::mem::replace(&mut self.is_shut_down, true) {
            return Ok(());
        }
        let timeout = self.timeouts.reset;
        let reset = self.call("the last reset", timeout, move |board| board.restart(None, timeout));
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
