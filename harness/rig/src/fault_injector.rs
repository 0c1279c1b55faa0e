//! Applies planned faults to samples and commands: loss, damage, repetition, delay, noise. The
//! handshake, the configuration and the request for 0 V always pass, so that no fault prevents 0 V.
//! Equal trials get equal faults, because only instants and seeds determine them. In lockstep, a
//! lost sample still advances the target's time, so that its watchdog acts. The line keeps the
//! order, so that messages after a delayed one wait. `docs/scenarios.md` describes the effects.

mod faults;

use crate::compared_link::ComparedLink;
use crate::link::{Chip, ChipFaultError, ChipFaultPlan, Link, LinkError, LinkKind, RealTimeLine};
use faults::{ActiveFaults, FrameSplitter, QueuedPacket, decode_first_packet, is_sample};
use platebench_model::scenario::{Direction, Fault};
use platebench_wire::{ControllerState, Message, Packet};
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Largest number of messages in flight per direction. Further messages are lost.
const MAX_QUEUED: usize = 256;

/// Delimiter of frames. It ends a truncated frame before a message that must pass unchanged.
const DELIMITER: u8 = 0;

#[derive(Debug)]
pub struct FaultInjector<L> {
    inner: ComparedLink<L>,
    active_faults: ActiveFaults,
    to_controller: VecDeque<QueuedPacket>,
    from_controller: VecDeque<QueuedPacket>,
    frames: FrameSplitter,
    /// Wd and Wq of the last intact sample that the controller received, µm.
    delivered_sample: [f32; 2],
    overflow_count: u64,
    scratch: Vec<u8>,
    clock: Option<TrialClock>,
}

impl<L: Link> FaultInjector<L> {
    pub fn new(inner: L) -> Self {
        Self {
            inner: ComparedLink::new(inner),
            active_faults: ActiveFaults::default(),
            to_controller: VecDeque::with_capacity(MAX_QUEUED),
            from_controller: VecDeque::with_capacity(MAX_QUEUED),
            frames: FrameSplitter::default(),
            delivered_sample: [0.0; 2],
            overflow_count: 0,
            scratch: Vec::with_capacity(MAX_QUEUED),
            clock: None,
        }
    }

    pub fn inner_mut(&mut self) -> &mut L {
        &mut self.inner.link
    }

    /// Sets the next trial's faults and clears the counts. `seed` is that of the trial. Call it
    /// before its configuration.
    pub fn set_faults(&mut self, faults: &[Fault], seed: u64) {
        self.active_faults = ActiveFaults::new(faults, seed);
        self.overflow_count = 0;
        self.delivered_sample = [0.0; 2];
        self.clock = None;
        self.clear();
    }

    /// Sets the faults of the chip that act from the next restart on. Call it before the trial's
    /// configuration.
    pub fn set_chip_faults(&mut self, plan: &ChipFaultPlan) -> Result<(), ChipFaultError> {
        match self.chip() {
            Some(chip) => chip.set_faults(plan),
            None if plan.faults.is_empty() => Ok(()),
            None => Err(ChipFaultError::Unsupported),
        }
    }

    /// Compares the next lockstep trial with the reference. Call it before its configuration.
    pub fn compare_with_reference(&mut self, is_compared: bool) {
        self.inner.compare_with_reference(is_compared);
    }

    /// Largest difference of a command from the hosted reference for the same bytes, in percent of
    /// the drive limit or the frequency range. It is 100 if only one of them stopped, and `None`
    /// without a comparison or a command.
    pub fn reference_difference_percent(&self) -> Option<f64> {
        self.inner.reference_difference_percent()
    }

    pub fn next_due(&self) -> Option<Duration> {
        let fronts = [&self.to_controller, &self.from_controller].map(VecDeque::front);
        fronts.into_iter().flatten().map(|packet| packet.due).min()
    }

    /// Wd and Wq of the last delivered sample, µm. `None` if the trial has no faults.
    pub fn delivered_sample(&self) -> Option<[f32; 2]> {
        self.active_faults.has_faults().then_some(self.delivered_sample)
    }

    /// Numbers of affected messages by kind of fault, without zeros. `overflow` counts messages
    /// lost in a full queue.
    pub fn fault_counts(&self) -> impl Iterator<Item = (&'static str, u64)> + use<L> {
        let overflow = Some(("overflow", self.overflow_count));
        self.active_faults.counts().into_iter().flatten().chain(overflow).filter(|(_, count)| *count > 0)
    }

    fn clear(&mut self) {
        self.to_controller.clear();
        self.from_controller.clear();
        self.frames = FrameSplitter::default();
    }

    fn queue_sample(&mut self, now: Duration, bytes: &[u8]) {
        if let Some(packet) = self.active_faults.apply(Direction::ToController, now, bytes) {
            self.overflow_count += u64::from(!enqueue(&mut self.to_controller, packet));
        }
    }

    fn queue_answers(&mut self, now: Duration) {
        for &byte in &self.scratch {
            let Some(frame) = self.frames.push(byte) else { continue };
            let packet = match decode_first_packet(frame).map(|packet| packet.message) {
                Some(Message::Command(command)) if command.state != ControllerState::Safe => {
                    self.active_faults.apply(Direction::FromController, now, frame)
                }
                _ => QueuedPacket::new(now, frame),
            };
            if let Some(packet) = packet {
                self.overflow_count += u64::from(!enqueue(&mut self.from_controller, packet));
            }
        }
        self.scratch.clear();
    }

    fn record_delivered(&mut self, packet: &QueuedPacket) {
        if let Some(Packet { message: Message::Sample(sample), .. }) = decode_first_packet(&packet.bytes) {
            self.delivered_sample = [sample.wd_um, sample.wq_um];
        }
    }

    /// Delivers the due messages up to `now`. Returns the target's delay for the last one.
    fn deliver_until(&mut self, now: Duration, answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let mut last = None;
        while let Some(packet) = pop_due(&mut self.to_controller, now) {
            self.record_delivered(&packet);
            let delay = self.inner.exchange(packet.due, &packet.bytes, &mut self.scratch)?;
            last = Some((packet.due, delay));
            self.queue_answers(packet.due);
        }
        if last.is_none_or(|(at, _)| at < now) {
            self.inner.advance_to(now, &mut self.scratch)?;
            self.queue_answers(now);
        }
        while let Some(packet) = pop_due(&mut self.from_controller, now) {
            answer.extend_from_slice(&packet.bytes);
        }
        Ok(last.map_or(Duration::ZERO, |(_, delay)| delay))
    }
}

impl<L: Link> Link for FaultInjector<L> {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        if !self.active_faults.has_faults() {
            return self.inner.exchange(now, bytes, answer);
        }
        if !is_sample(bytes) {
            self.clear();
            answer.push(DELIMITER);
            return self.inner.exchange(now, &[&[DELIMITER], bytes].concat(), answer);
        }
        self.queue_sample(now, bytes);
        self.deliver_until(now, answer)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        if self.active_faults.has_faults() {
            self.deliver_until(now, received).map(drop)
        } else {
            self.inner.advance_to(now, received)
        }
    }

    fn answer_sample(&mut self, now: Duration, packet: &Packet, is_checked: bool) -> Option<Result<Packet, LinkError>> {
        let needs_bytes = self.active_faults.has_faults() || self.inner.is_comparing();
        if needs_bytes { None } else { self.inner.link.answer_sample(now, packet, is_checked) }
    }

    fn kind(&self) -> LinkKind {
        self.inner.link.kind()
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.clear();
        self.inner.link.restart()
    }

    fn continue_trial(&mut self) {
        self.clear();
        self.inner.link.continue_trial();
    }

    fn chip(&mut self) -> Option<&mut dyn Chip> {
        self.inner.link.chip()
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        if self.inner.link.real_time_line().is_some() { Some(self) } else { None }
    }
}

/// Keeps the order of the messages. Returns false if the queue is full.
fn enqueue(queue: &mut VecDeque<QueuedPacket>, mut packet: QueuedPacket) -> bool {
    if queue.len() >= MAX_QUEUED {
        return false;
    }
    if let Some(ahead) = queue.back() {
        packet.due = packet.due.max(ahead.due);
    }
    queue.push_back(packet);
    true
}

fn pop_due(queue: &mut VecDeque<QueuedPacket>, now: Duration) -> Option<QueuedPacket> {
    queue.pop_front_if(|packet| packet.due <= now)
}

impl<L: Link> FaultInjector<L> {
    /// `scale` is in trial seconds per wall second. Before this call, all messages pass unchanged.
    pub fn start_real_time(&mut self, start: Instant, scale: f64) {
        self.clock = Some(TrialClock { start, scale: scale.max(f64::MIN_POSITIVE) });
    }

    fn inner_now(&mut self) -> Instant {
        self.inner.link.real_time_line().map_or_else(Instant::now, RealTimeLine::now)
    }

    fn inner_line(&mut self) -> Result<&mut dyn RealTimeLine, LinkError> {
        self.inner
            .link
            .real_time_line()
            .ok_or_else(|| LinkError::Disconnected("the link cannot be used in real time".to_owned()))
    }

    fn send_due(&mut self, clock: TrialClock) -> Result<(), LinkError> {
        let now = clock.trial_time(self.inner_now());
        while let Some(packet) = pop_due(&mut self.to_controller, now) {
            self.record_delivered(&packet);
            self.inner_line()?.send(&packet.bytes)?;
        }
        Ok(())
    }

    /// Appends the due messages and returns the arrival of the first one.
    fn receive_due(&mut self, clock: TrialClock, bytes: &mut Vec<u8>) -> Option<Instant> {
        let now = clock.trial_time(self.inner_now());
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

    fn now(&mut self) -> Instant {
        self.inner_now()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        match self.clock {
            Some(clock) if self.active_faults.has_faults() && is_sample(bytes) => {
                let now = clock.trial_time(self.inner_now());
                self.queue_sample(now, bytes);
                self.send_due(clock)
            }
            clock => {
                if self.active_faults.has_faults() {
                    self.clear();
                    let wall = self.inner_now();
                    let now = clock.map_or(Duration::ZERO, |clock| clock.trial_time(wall));
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
            if self.inner_now() >= until {
                self.send_due(clock)?;
                return Ok(self.receive_due(clock, bytes));
            }
        }
    }
}

#[derive(Debug, Clone, Copy)]
struct TrialClock {
    start: Instant,
    /// Trial seconds per wall second.
    scale: f64,
}

/// Longer than any trial, and short enough to be added to any instant.
const MAX_TRIAL_DURATION: Duration = Duration::from_secs(1 << 30);

impl TrialClock {
    fn trial_time(&self, instant: Instant) -> Duration {
        bounded_duration(instant.saturating_duration_since(self.start).as_secs_f64() * self.scale)
    }

    fn wall_instant(&self, time: Duration) -> Instant {
        self.start + bounded_duration(time.as_secs_f64() / self.scale)
    }
}

fn bounded_duration(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds).unwrap_or(MAX_TRIAL_DURATION).min(MAX_TRIAL_DURATION)
}

#[cfg(test)]
mod tests;
