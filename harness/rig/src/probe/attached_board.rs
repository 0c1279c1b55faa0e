//! Calls the board on the probe's thread, with time-outs for each wait.

use super::board::{Board, ChipId, FlashOutcome, ProbeSpec, RttChannels};
use super::error::ProbeError;
use super::image::FlashImage;
use crate::crash_report::CrashReport;
use probe_rs::probe::list::Lister;
use std::cell::Cell;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
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
    pub fn flash(&mut self, image: &Arc<FlashImage>) -> Result<FlashOutcome, ProbeError> {
        let image = Arc::clone(image);
        let outcome = self.call("flashing", self.timeouts.flash, move |board| board.flash(&image))?;
        info!(chip = self.chip.name, ?outcome, "firmware flashed");
        Ok(outcome)
    }

    pub fn restart(&mut self, image: &FlashImage) -> Result<(), ProbeError> {
        let (rtt, timeout) = (image.rtt(), self.timeouts.reset);
        self.call("resetting the chip", timeout, move |board| board.restart(rtt, timeout))
    }

    /// Returns the crash if the processor is in a fault handler. The processor then stays halted.
    pub fn read_crash(&mut self, image: &Arc<FlashImage>) -> Result<Option<CrashReport>, ProbeError> {
        let image = Arc::clone(image);
        self.call("reading a crash", self.timeouts.crash, move |board| board.read_crash(&image))
    }

    pub(super) fn trap_error(&mut self, image: &Arc<FlashImage>) -> Option<ProbeError> {
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

type Job<T> = Box<dyn FnOnce(&mut T) + Send>;

/// Runs the probe on its own thread, because a hanging USB transfer cannot be interrupted. After a
/// time-out the thread is abandoned. Further calls then fail at once, and the end of the process
/// releases the probe.
#[derive(Debug)]
struct ProbeThread<T> {
    jobs: Option<Sender<Job<T>>>,
    /// This channel disconnects when the thread has ended and its value is dropped.
    ended: Receiver<()>,
    abandoned: Cell<bool>,
}

impl<T: 'static> ProbeThread<T> {
    pub(super) fn spawn<R: Send + 'static>(
        doing: &'static str,
        timeout: Duration,
        build: impl FnOnce() -> Result<(T, R), ProbeError> + Send + 'static,
    ) -> Result<(Self, R), ProbeError> {
        let (jobs, queue) = channel::<Job<T>>();
        let (built, answer) = channel();
        let (alive, ended) = channel::<()>();
        let run = move || {
            // Declared before `value`, so that it is dropped after `value`.
            let _alive = alive;
            let mut value = match build() {
                Ok((value, result)) => {
                    if built.send(Ok(result)).is_err() {
                        return;
                    }
                    value
                }
                Err(error) => {
                    let _ = built.send(Err(error));
                    return;
                }
            };
            drop(built);
            for job in queue {
                job(&mut value);
            }
        };
        thread::Builder::new().name("debug-probe".to_owned()).spawn(run)?;
        let result = receive_within(&answer, doing, timeout)??;
        Ok((Self { jobs: Some(jobs), ended, abandoned: Cell::new(false) }, result))
    }

    pub(super) fn call<R: Send + 'static>(
        &self,
        doing: &'static str,
        timeout: Duration,
        job: impl FnOnce(&mut T) -> Result<R, ProbeError> + Send + 'static,
    ) -> Result<R, ProbeError> {
        if self.abandoned.get() {
            return Err(ProbeError::ProbeHangs { doing });
        }
        let (answer, answered) = channel();
        let sent = self.jobs.as_ref().map(|jobs| {
            jobs.send(Box::new(move |value| {
                let _ = answer.send(job(value));
            }))
        });
        let Some(Ok(())) = sent else { return Err(ProbeError::ProbeThreadGone { doing }) };
        let result = receive_within(&answered, doing, timeout);
        self.abandoned.set(result.is_err());
        result?
    }

    /// Ends the thread. Warns if it has not dropped its value within `timeout`.
    pub(super) fn stop(&mut self, timeout: Duration) {
        self.jobs = None;
        let timeout = if self.abandoned.get() { Duration::ZERO } else { timeout };
        if self.ended.recv_timeout(timeout) == Err(RecvTimeoutError::Timeout) {
            warn!("the debug probe is not released before the end of the process");
        }
    }
}

fn receive_within<R>(answer: &Receiver<R>, doing: &'static str, timeout: Duration) -> Result<R, ProbeError> {
    answer.recv_timeout(timeout).map_err(|error| match error {
        RecvTimeoutError::Timeout => ProbeError::CallTimedOut { doing, waited: timeout },
        RecvTimeoutError::Disconnected => ProbeError::ProbeThreadGone { doing },
    })
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timeouts {
    pub attach: Duration,
    /// Includes the comparisons of the flash content before and after the write.
    pub flash: Duration,
    pub reset: Duration,
    /// Longest wait for the RTT control block after a reset.
    pub rtt: Duration,
    /// Longest wait for the first answer on the serial port after a reset.
    pub handshake: Duration,
    /// Longest wait for an answer. A missing answer is no error.
    pub exchange: Duration,
    pub crash: Duration,
    /// Added to the time-out of a call. If the call has not ended then, the probe counts as hung.
    pub grace: Duration,
}

impl Default for Timeouts {
    fn default() -> Self {
        Self {
            attach: Duration::from_secs(20),
            flash: Duration::from_mins(2),
            reset: Duration::from_secs(3),
            rtt: Duration::from_secs(2),
            handshake: Duration::from_secs(2),
            exchange: Duration::from_millis(100),
            crash: Duration::from_secs(2),
            grace: Duration::from_secs(2),
        }
    }
}
