//! Implements faults of the watchdog.

use crate::trust::mutant_controller::{Inner, Mutant};
use crate::trust::protocol_mutants::{Answers, packet_of};
use platebench_rig::LinkError;
use platebench_wire::{ControllerState, Message, Packet, Sample, StateCause};
use std::time::Duration;

/// How a watchdog deviates from the protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum WatchdogFault {
    /// Compares the clock with the deadline, both as u32.
    DeadlineWithoutWrap,
    FromSecondSample,
    FedByRejectedFrames,
    FedByRepeats,
    /// Stops only after a silence of more than the timeout.
    AfterLimit,
    /// Starts with the next tick of a timer of 10 ms.
    Ticks,
}

/// Replaces the watchdog of the controller, whose own timeout becomes the longest one.
pub(crate) struct OwnWatchdog {
    fault: WatchdogFault,
    is_replaced: bool,
    timeout_us: u64,
    clock_us: u64,
    /// When the watchdog was last fed; `None` if it does not run.
    fed_us: Option<u64>,
    last_sample: Option<u8>,
    samples: u32,
    /// Time stamp of the stop inside the controller, and the true one.
    stop_us: Option<[u32; 2]>,
}

impl OwnWatchdog {
    const LONGEST_MS: u16 = u16::MAX;
    const TICK_US: u64 = 10_000;

    pub(crate) fn with(fault: WatchdogFault) -> Box<dyn Mutant> {
        let (timeout_us, clock_us, fed_us, last_sample, samples, stop_us) = (0, 0, None, None, 0, None);
        Box::new(Self { fault, is_replaced: false, timeout_us, clock_us, fed_us, last_sample, samples, stop_us })
    }

    fn is_expired(&self) -> bool {
        let Some(fed_us) = self.fed_us.filter(|_| self.is_replaced) else { return false };
        match self.fault {
            WatchdogFault::DeadlineWithoutWrap => self.clock_us as u32 >= (fed_us + self.timeout_us) as u32,
            WatchdogFault::FromSecondSample => self.samples > 1 && self.clock_us >= fed_us + self.timeout_us,
            WatchdogFault::AfterLimit => self.clock_us > fed_us + self.timeout_us,
            WatchdogFault::Ticks => self.clock_us >= fed_us.next_multiple_of(Self::TICK_US) + self.timeout_us,
            WatchdogFault::FedByRejectedFrames | WatchdogFault::FedByRepeats => {
                self.clock_us >= fed_us + self.timeout_us
            }
        }
    }

    /// Lets the controller's own timeout pass, so that it stops with cause 1.
    fn stop(&mut self, inner: &mut Inner<'_>) -> Result<Vec<Packet>, LinkError> {
        let ahead = Duration::from_millis(u64::from(Self::LONGEST_MS));
        self.fed_us = None;
        self.stop_us = Some([(self.clock_us + ahead.as_micros() as u64) as u32, self.clock_us as u32]);
        inner.wait(ahead)
    }
}

impl Mutant for OwnWatchdog {
    fn handle(&mut self, frame: &[u8], inner: &mut Inner<'_>) -> Answers {
        self.clock_us = inner.clock_us();
        let fed_now = self.fed_us.map(|_| self.clock_us);
        match packet_of(frame) {
            None if frame.len() > 1 && self.fault == WatchdogFault::FedByRejectedFrames => self.fed_us = fed_now,
            Some(Packet { sequence, message: Message::Sample(_) }) => {
                let repeats = self.last_sample == Some(sequence);
                if repeats && self.fault == WatchdogFault::FedByRepeats {
                    self.fed_us = fed_now;
                } else if !repeats && self.is_expired() {
                    // The controller then answers the sample itself with the stop.
                    self.stop(inner)?;
                }
            }
            _ => {}
        }
        Ok(None)
    }

    fn wait(&mut self, inner: &mut Inner<'_>) -> Result<Vec<Packet>, LinkError> {
        self.clock_us = inner.clock_us();
        if self.is_expired() { self.stop(inner) } else { inner.wait(Duration::ZERO) }
    }

    fn on_receive(&mut self, packet: &mut Packet) {
        if let Message::Configure(configure) = &mut packet.message {
            self.timeout_us = match configure.watchdog_timeout_ms {
                0 => u64::from(configure.period_us.saturating_mul(5)),
                timeout_ms => u64::from(timeout_ms) * 1_000,
            };
            // A longer default timeout stays that of the controller.
            self.is_replaced = self.timeout_us <= u64::from(Self::LONGEST_MS) * 1_000;
            if self.is_replaced {
                configure.watchdog_timeout_ms = Self::LONGEST_MS;
            }
            (self.fed_us, self.last_sample, self.samples, self.stop_us) = (None, None, 0, None);
        }
    }

    fn on_send(&mut self, packet: &mut Packet) {
        let Message::Command(command) = &mut packet.message else { return };
        if let Some([inside, stop_us]) = self.stop_us
            && command.target_time_us == inside
        {
            command.target_time_us = stop_us;
        }
        match command.state {
            ControllerState::Running if self.last_sample == Some(packet.sequence) => {}
            ControllerState::Running => {
                self.last_sample = Some(packet.sequence);
                self.samples += 1;
                self.fed_us = Some(self.clock_us);
            }
            _ => self.fed_us = None,
        }
    }
}

/// Checks the values of a late sample before the watchdog: cause 3 instead of 1.
#[derive(Default)]
pub(crate) struct ValuesBeforeWatchdog {
    is_running: bool,
    has_invalid_values: bool,
    stopped_by_values: bool,
}

impl Mutant for ValuesBeforeWatchdog {
    fn on_receive(&mut self, packet: &mut Packet) {
        if let Message::Sample(Sample { setpoint_um, wd_um, wq_um, .. }) = packet.message {
            self.has_invalid_values = [setpoint_um, wd_um, wq_um].iter().any(|value| !value.is_finite());
        }
    }

    fn on_send(&mut self, packet: &mut Packet) {
        let Message::Command(command) = &mut packet.message else { return };
        let was_running = std::mem::replace(&mut self.is_running, command.state == ControllerState::Running);
        if command.state != ControllerState::Fault {
            self.stopped_by_values = false;
        } else if command.cause == StateCause::SampleTimeout {
            self.stopped_by_values |= was_running && self.has_invalid_values;
            if self.stopped_by_values {
                command.cause = StateCause::NonFinite;
            }
        }
    }
}
