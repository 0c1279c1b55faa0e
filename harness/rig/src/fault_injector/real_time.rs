//! Applies the trial's faults to a link in real time.

use super::injector::{DELIMITER, FaultInjector, pop_due};
use super::packet::{QueuedPacket, is_sample};
use super::trial_clock::TrialClock;
use crate::link::{Link, LinkError, RealTimeLine};
use std::time::{Duration, Instant};

impl<L: Link> FaultInjector<L> {
    /// `scale` is in trial seconds per wall second. Before this call, all messages pass unchanged.
    pub fn start_real_time(&mut self, start: Instant, scale: f64) {
        self.clock = Some(TrialClock { start, scale: scale.max(f64::MIN_POSITIVE) });
    }

    fn inner_line(&mut self) -> Result<&mut dyn RealTimeLine, LinkError> {
        self.inner
            .link
            .real_time_line()
            .ok_or_else(|| LinkError::Disconnected("the link cannot be used in real time".to_owned()))
    }

    fn send_due(&mut self, clock: TrialClock) -> Result<(), LinkError> {
        let now = clock.trial_time(Instant::now());
        while let Some(packet) = pop_due(&mut self.to_controller, now) {
            self.record_delivered(&packet);
            self.inner_line()?.send(&packet.bytes)?;
        }
        Ok(())
    }

    /// Appends the due messages and returns the arrival of the first one.
    fn receive_due(&mut self, clock: TrialClock, bytes: &mut Vec<u8>) -> Option<Instant> {
        let now = clock.trial_time(Instant::now());
        let mut first = None;
        while let Some(packet) = pop_due(&mut self.from_controller, now) {
            bytes.extend_from_slice(&packet.bytes);
            first = first.or(Some(packet.due));
        }
        first.map(|due| clock.wall_instant(due))
    }
}

impl<L: Link> RealTimeLine for FaultInjector<L> {
    fn start(&mut self) -> Result<(), LinkError> {
        self.inner_line()?.start()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        match self.clock {
            Some(clock) if self.active_faults.has_faults() && is_sample(bytes) => {
                self.queue_sample(clock.trial_time(Instant::now()), bytes);
                self.send_due(clock)
            }
            clock => {
                if self.active_faults.has_faults() {
                    self.clear();
                    let now = clock.map_or(Duration::ZERO, |clock| clock.trial_time(Instant::now()));
                    self.from_controller.extend(QueuedPacket::new(now, &[DELIMITER]));
                    self.inner_line()?.send(&[DELIMITER])?;
                }
                self.inner_line()?.send(bytes)
            }
        }
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        let Some(clock) = self.clock.filter(|_| self.active_faults.has_faults()) else {
            return self.inner_line()?.receive(until, bytes);
        };
        loop {
            self.send_due(clock)?;
            if let Some(at) = self.receive_due(clock, bytes) {
                return Ok(Some(at));
            }
            let next = self.next_due().map_or(until, |due| clock.wall_instant(due).min(until));
            let mut scratch = std::mem::take(&mut self.scratch);
            let arrived = self.inner_line().and_then(|line| line.receive(next, &mut scratch));
            self.scratch = scratch;
            if let Some(at) = arrived? {
                self.queue_answers(clock.trial_time(at));
            }
            if Instant::now() >= until {
                self.send_due(clock)?;
                return Ok(self.receive_due(clock, bytes));
            }
        }
    }
}
