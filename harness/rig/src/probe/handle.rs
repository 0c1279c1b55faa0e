//! A board on a probe, from the bench's side of the thread.

use super::board::{Board, ChipId, Flashed};
use super::error::ProbeError;
use super::fault::Fault;
use super::image::Image;
use super::link::Channels;
use super::spec::ProbeSpec;
use super::worker::Worker;
use super::{Lister, Patience};
use std::sync::Arc;
use std::time::Duration;
use tracing::{info, warn};

/// A board whose chip is the one asked for. Dropping it resets the chip, which boots at 0 V, and releases the probe.
#[derive(Debug)]
pub struct Attached {
    worker: Worker<Board>,
    chip: ChipId,
    patience: Patience,
    ended: bool,
}

impl Attached {
    /// Finds the probe among what `list` finds, attaches and checks who the chip is. Nothing is written.
    ///
    /// # Errors
    /// [`ProbeError`] for each way in which that can fail, within [`Patience::attach`].
    pub fn attach(
        spec: &ProbeSpec,
        list: impl FnOnce() -> Lister + Send + 'static,
        patience: Patience,
    ) -> Result<Self, ProbeError> {
        let spec = spec.clone();
        let make = move || Board::attach(&spec, &list());
        let (worker, chip) = Worker::start("attaching", patience.attach, make)?;
        Ok(Self { worker, chip, patience, ended: false })
    }

    /// Who the chip is.
    pub fn chip(&self) -> &ChipId {
        &self.chip
    }

    /// How long is waited for what.
    pub fn patience(&self) -> &Patience {
        &self.patience
    }

    fn call<R: Send + 'static>(
        &self,
        doing: &'static str,
        patience: Duration,
        job: impl FnOnce(&mut Board) -> Result<R, ProbeError> + Send + 'static,
    ) -> Result<R, ProbeError> {
        self.worker.call(doing, patience + self.patience.grace, job)
    }

    /// Brings the image into flash, and reads it back byte by byte; does nothing where it is there already. Flashing resets and halts the processor:
    /// its outputs float until [`Attached::restart`].
    ///
    /// # Errors
    /// [`ProbeError`] where it does not fit, cannot be written or is not what was written.
    pub fn flash(&mut self, image: &Arc<Image>) -> Result<Flashed, ProbeError> {
        let image = Arc::clone(image);
        let flashed = self.call("flashing", self.patience.flash, move |board| board.flash(&image))?;
        info!(chip = self.chip.name, ?flashed, "firmware");
        Ok(flashed)
    }

    /// Resets the chip and lets the firmware run.
    ///
    /// # Errors
    /// [`ProbeError`] where the chip does not come back.
    pub fn restart(&mut self, image: &Image) -> Result<(), ProbeError> {
        let (rtt, patience) = (image.rtt(), self.patience.reset);
        self.call("resetting the chip", patience, move |board| board.restart(rtt, patience))
    }

    /// The trap that the processor is in, if it is in one. The processor stays halted then.
    ///
    /// # Errors
    /// [`ProbeError`] where that cannot be read.
    pub fn fault(&mut self, image: &Arc<Image>) -> Result<Option<Fault>, ProbeError> {
        let image = Arc::clone(image);
        self.call("reading a fault", self.patience.fault, move |board| board.fault(&image))
    }

    pub(super) fn rtt(&mut self, address: u64) -> Result<Channels, ProbeError> {
        let patience = self.patience.rtt;
        self.call("starting RTT", patience, move |board| board.rtt(address, patience))
    }

    /// The channels travel to the probe's thread and back.
    pub(super) fn exchange(
        &mut self,
        mut channels: Channels,
        bytes: Vec<u8>,
        patience: Duration,
    ) -> Result<(Channels, Vec<u8>), ProbeError> {
        self.call("an exchange", patience, move |board| {
            let said = board.exchange(&mut channels, &bytes, patience)?;
            Ok((channels, said))
        })
    }

    /// Resets the chip, lets it boot at 0 V and releases the probe; at most once.
    ///
    /// # Errors
    /// [`ProbeError`] where the reset could not be done.
    pub fn end(&mut self) -> Result<(), ProbeError> {
        if std::mem::replace(&mut self.ended, true) {
            return Ok(());
        }
        let patience = self.patience.reset;
        let reset = self.call("the last reset", patience, move |board| board.restart(None, patience));
        self.worker.stop(self.patience.grace);
        reset
    }
}

impl Drop for Attached {
    fn drop(&mut self) {
        if let Err(error) = self.end() {
            warn!(%error, "the chip was not reset at the end");
        }
    }
}
