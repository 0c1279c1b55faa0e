//! The same faults over a line in real time.

use super::parcel::Parcel;
use super::{DELIMITER, Faulty, is_sample, pop_due};
use crate::link::{Line, Link, LinkError};
use std::time::{Duration, Instant};

/// From instants of the wall to instants of the trial.
#[derive(Debug, Clone, Copy)]
pub(super) struct Clock {
    pub(super) start: Instant,
    /// Trial seconds per wall second.
    pub(super) scale: f64,
}

/// Beyond what any trial lasts, and short enough to be added to any instant.
const LONGEST: Duration = Duration::from_secs(1 << 30);

impl Clock {
    pub(super) fn trial(&self, instant: Instant) -> Duration {
        let seconds = instant.saturating_duration_since(self.start).as_secs_f64() * self.scale;
        Duration::try_from_secs_f64(seconds).unwrap_or(LONGEST).min(LONGEST)
    }

    pub(super) fn wall(&self, time: Duration) -> Instant {
        let seconds = time.as_secs_f64() / self.scale;
        self.start + Duration::try_from_secs_f64(seconds).unwrap_or(LONGEST).min(LONGEST)
    }
}

impl<L: Link> Faulty<L> {
    /// In real time: the trial starts at `start` and runs `scale` times as fast as the wall. To be called after [`Faulty::arm`]; until then a line passes
    /// everything unharmed.
    pub fn run_from(&mut self, start: Instant, scale: f64) {
        self.clock = Some(Clock { start, scale: scale.max(f64::MIN_POSITIVE) });
    }

    fn bare(&mut self) -> Result<&mut dyn Line, LinkError> {
        self.inner.line().ok_or_else(|| LinkError::Disconnected("the link has no line in real time".to_owned()))
    }

    /// Puts what is due by now on the line to the controller.
    fn send_due(&mut self, clock: Clock) -> Result<(), LinkError> {
        let now = clock.trial(Instant::now());
        while let Some(parcel) = pop_due(&mut self.to_controller, now) {
            self.take_given(&parcel);
            self.bare()?.send(parcel.bytes())?;
        }
        Ok(())
    }

    /// Hands over what is due by now; the instant at which the first of it was.
    fn receive_due(&mut self, clock: Clock, bytes: &mut Vec<u8>) -> Option<Instant> {
        let now = clock.trial(Instant::now());
        let mut first = None;
        while let Some(parcel) = pop_due(&mut self.from_controller, now) {
            bytes.extend_from_slice(parcel.bytes());
            first = first.or(Some(parcel.due));
        }
        first.map(|due| clock.wall(due))
    }
}

impl<L: Link> Line for Faulty<L> {
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        match self.clock {
            Some(clock) if self.harm.is_armed() && is_sample(bytes) => {
                self.post(clock.trial(Instant::now()), bytes);
                self.send_due(clock)
            }
            clock => {
                if self.harm.is_armed() {
                    self.forget();
                    let now = clock.map_or(Duration::ZERO, |clock| clock.trial(Instant::now()));
                    self.from_controller.extend(Parcel::new(now, &[DELIMITER]));
                    self.bare()?.send(&[DELIMITER])?;
                }
                self.bare()?.send(bytes)
            }
        }
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        let Some(clock) = self.clock.filter(|_| self.harm.is_armed()) else {
            return self.bare()?.receive(until, bytes);
        };
        loop {
            self.send_due(clock)?;
            if let Some(at) = self.receive_due(clock, bytes) {
                return Ok(Some(at));
            }
            let next = self.due().map_or(until, |due| clock.wall(due).min(until));
            let mut scratch = std::mem::take(&mut self.scratch);
            let arrived = self.bare().and_then(|line| line.receive(next, &mut scratch));
            self.scratch = scratch;
            if let Some(at) = arrived? {
                self.return_scratch(clock.trial(at));
            }
            if Instant::now() >= until {
                self.send_due(clock)?;
                return Ok(self.receive_due(clock, bytes));
            }
        }
    }
}
