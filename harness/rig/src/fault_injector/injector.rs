//! Wraps a link and applies the trial's faults to its messages.

use super::inject::ActiveFaults;
use super::packet::{FrameSplitter, QueuedPacket, decode_first_packet, is_sample};
use super::trial_clock::TrialClock;
use super::wire_fault::{Direction, WireFault};
use crate::chip_fault::{ChipFaultError, ChipFaultPlan};
use crate::compared_link::ComparedLink;
use crate::link::{Chip, Link, LinkError, LinkKind, RealTimeLine};
use platebench_wire::{ControllerState, Message, Packet};
use std::collections::VecDeque;
use std::time::Duration;

/// Largest number of messages in flight per direction. Further messages are lost.
pub(super) const MAX_QUEUED: usize = 256;

/// Delimiter of frames. It ends a truncated frame before a message that must pass unchanged.
pub(super) const DELIMITER: u8 = 0;

#[derive(Debug)]
pub struct FaultInjector<L> {
    pub(super) inner: ComparedLink<L>,
    pub(super) active_faults: ActiveFaults,
    pub(super) to_controller: VecDeque<QueuedPacket>,
    pub(super) from_controller: VecDeque<QueuedPacket>,
    frames: FrameSplitter,
    /// Wd and Wq of the last intact sample that the controller received, µm.
    delivered_sample: [f32; 2],
    overflow_count: u64,
    pub(super) scratch: Vec<u8>,
    pub(super) clock: Option<TrialClock>,
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

    /// Sets the next trial's faults and clears the counts. Call it before its configuration.
    pub fn set_faults(&mut self, faults: &[WireFault]) {
        self.active_faults = ActiveFaults::new(faults);
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

    pub(super) fn clear(&mut self) {
        self.to_controller.clear();
        self.from_controller.clear();
        self.frames = FrameSplitter::default();
    }

    pub(super) fn queue_sample(&mut self, now: Duration, bytes: &[u8]) {
        if let Some(packet) = self.active_faults.apply(Direction::ToController, now, bytes) {
            self.overflow_count += u64::from(!enqueue(&mut self.to_controller, packet));
        }
    }

    pub(super) fn queue_answers(&mut self, now: Duration) {
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

    pub(super) fn record_delivered(&mut self, packet: &QueuedPacket) {
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

pub(super) fn pop_due(queue: &mut VecDeque<QueuedPacket>, now: Duration) -> Option<QueuedPacket> {
    queue.pop_front_if(|packet| packet.due <= now)
}
