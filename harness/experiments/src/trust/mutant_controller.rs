//! Wraps the link to a correct controller and changes its messages in both directions.

use platebench_rig::{Chip, Link, LinkError};
use platebench_wire::{Command, ControllerState, Message, Packet, PacketReader};
use std::collections::VecDeque;
use std::time::Duration;

/// A mistake of a controller, with its state. By default a method changes nothing. A closure that
/// takes a message is a mutant.
pub trait Mutant: Send {
    /// Handles a frame (with its delimiter) instead of the methods below and returns the packets to
    /// the bench, which pass [`Mutant::on_send`]. `None`: the methods below handle the frame.
    fn handle(&mut self, _frame: &[u8], _inner: &mut Inner<'_>) -> Result<Option<Vec<Packet>>, LinkError> {
        Ok(None)
    }

    /// Passes the time without a frame. Returns the packets like [`Mutant::handle`].
    fn wait(&mut self, inner: &mut Inner<'_>) -> Result<Vec<Packet>, LinkError> {
        inner.wait(Duration::ZERO)
    }

    /// Changes a packet to the controller.
    fn on_receive(&mut self, packet: &mut Packet) {
        self.on_message(&mut packet.message);
    }

    /// Changes a packet to the bench. By default it skips commands outside the state `Running`.
    fn on_send(&mut self, packet: &mut Packet) {
        let is_idle = matches!(&packet.message, Message::Command(command) if command.state != ControllerState::Running);
        if !is_idle {
            self.on_message(&mut packet.message);
        }
    }

    fn on_message(&mut self, _message: &mut Message) {}

    /// Returns the replacement of a frame (with delimiter) that cannot be decoded. `None` drops it.
    fn on_unreadable_frame(&mut self, frame: &[u8]) -> Option<Vec<u8>> {
        Some(frame.to_vec())
    }

    /// Returns a packet that the controller receives before the sample with this sequence number.
    fn before_sample(&mut self, _sequence: u8) -> Option<Packet> {
        None
    }

    fn reads_bytewise(&self) -> bool {
        false
    }

    fn command_delay(&mut self) -> Duration {
        Duration::ZERO
    }
}

impl<F: FnMut(&mut Message) + Send> Mutant for F {
    fn on_message(&mut self, message: &mut Message) {
        self(message);
    }
}

/// The correct controller in a mutant.
pub struct Inner<'a> {
    link: &'a mut dyn Link,
    trial_start: Duration,
    now: Duration,
}

impl Inner<'_> {
    /// Time on the clock of the controller since its restart, µs. It does not wrap.
    pub fn clock_us(&self) -> u64 {
        (self.trial_start + self.now).as_micros() as u64
    }

    /// Sends bytes to the controller and returns its answers.
    pub fn send(&mut self, bytes: &[u8]) -> Result<Vec<Packet>, LinkError> {
        let mut answer = Vec::new();
        self.link.exchange(self.now, bytes, &mut answer)?;
        Ok(PacketReader::new().packets(&answer).flatten().collect())
    }

    /// Moves the time of the controller to `ahead` after the present and returns what it sends.
    pub fn wait(&mut self, ahead: Duration) -> Result<Vec<Packet>, LinkError> {
        let mut received = Vec::new();
        self.link.advance_to(self.now + ahead, &mut received)?;
        Ok(PacketReader::new().packets(&received).flatten().collect())
    }
}

/// Maximum length of a frame. Longer ones are forwarded in parts of this length.
const MAX_UNDELIMITED_BYTES: usize = 4096;

/// A controller whose messages a mutant changes. It works in lockstep only.
pub struct MutantController<L> {
    inner: L,
    build: fn() -> Box<dyn Mutant>,
    mutant: Box<dyn Mutant>,
    received: Vec<u8>,
    reader: PacketReader,
    scratch: Vec<u8>,
    /// Answers that the bench has not received yet, in order, each with the time of its arrival.
    outgoing: VecDeque<(Duration, Packet)>,
    trial_start: Duration,
    /// Time of the last call since the start of the trial.
    now: Duration,
}

impl<L: Link> MutantController<L> {
    /// Every restart calls `build`, so that each trial begins with a new mutant.
    pub fn new(inner: L, build: fn() -> Box<dyn Mutant>) -> Self {
        Self {
            inner,
            build,
            mutant: build(),
            received: Vec::new(),
            reader: PacketReader::new(),
            scratch: Vec::new(),
            outgoing: VecDeque::new(),
            trial_start: Duration::ZERO,
            now: Duration::ZERO,
        }
    }

    /// Forwards a frame with its delimiter. Returns the time that the inner link reports.
    fn deliver(&mut self, now: Duration, frame: &[u8]) -> Result<Duration, LinkError> {
        let mut inner = Inner { link: &mut self.inner, trial_start: self.trial_start, now };
        if let Some(answers) = self.mutant.handle(frame, &mut inner)? {
            for packet in answers {
                self.queue(now, packet);
            }
            return Ok(Duration::ZERO);
        }
        let Some(mut packet) = decode(frame) else {
            let kept = if frame.len() > 1 { self.mutant.on_unreadable_frame(frame) } else { Some(frame.to_vec()) };
            return kept.map_or(Ok(Duration::ZERO), |bytes| self.exchange_raw(now, &bytes));
        };
        match packet.message {
            // Late commands of the configuration before are not sent. Earlier answers are.
            Message::Configure(_) => self.outgoing.retain(|(due, _)| *due <= now),
            Message::Sample(_) => {
                if let Some(own) = self.mutant.before_sample(packet.sequence) {
                    self.exchange_raw(now, own.encode().as_bytes())?;
                }
            }
            _ => {}
        }
        self.mutant.on_receive(&mut packet);
        self.exchange_raw(now, packet.encode().as_bytes())
    }

    fn exchange_raw(&mut self, now: Duration, bytes: &[u8]) -> Result<Duration, LinkError> {
        let chunk = if self.mutant.reads_bytewise() { 1 } else { bytes.len().max(1) };
        let mut took = Duration::ZERO;
        for chunk in bytes.chunks(chunk) {
            took += self.inner.exchange(now, chunk, &mut self.scratch)?;
            self.queue_answers(now);
        }
        Ok(took)
    }

    fn queue_answers(&mut self, now: Duration) {
        let answers = std::mem::take(&mut self.scratch);
        for &byte in &answers {
            if let Some(Ok(packet)) = self.reader.push(byte) {
                self.queue(now, packet);
            }
        }
        self.scratch = answers;
        self.scratch.clear();
    }

    fn queue(&mut self, now: Duration, mut packet: Packet) {
        self.mutant.on_send(&mut packet);
        let acts = matches!(packet.message, Message::Command(Command { state: ControllerState::Running, .. }));
        let due = now + if acts { self.mutant.command_delay() } else { Duration::ZERO };
        let due = self.outgoing.back().map_or(due, |(before, _)| due.max(*before));
        self.outgoing.push_back((due, packet));
    }

    fn send_due(&mut self, now: Duration, answer: &mut Vec<u8>) {
        while let Some((_, packet)) = self.outgoing.pop_front_if(|(due, _)| *due <= now) {
            answer.extend_from_slice(packet.encode().as_bytes());
        }
    }
}

impl<L: Link> Link for MutantController<L> {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.now = now;
        let mut took = Duration::ZERO;
        for &byte in bytes {
            self.received.push(byte);
            if byte == 0 || self.received.len() >= MAX_UNDELIMITED_BYTES {
                let frame = std::mem::take(&mut self.received);
                took += self.deliver(now, &frame)?;
            }
        }
        self.send_due(now, answer);
        Ok(took)
    }

    fn advance_to(&mut self, now: Duration, answer: &mut Vec<u8>) -> Result<(), LinkError> {
        self.now = now;
        let mut inner = Inner { link: &mut self.inner, trial_start: self.trial_start, now };
        let packets = self.mutant.wait(&mut inner)?;
        for packet in packets {
            self.queue(now, packet);
        }
        self.send_due(now, answer);
        Ok(())
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        let restarted = self.inner.restart()?;
        self.mutant = (self.build)();
        self.received.clear();
        self.scratch.clear();
        self.outgoing.clear();
        self.reader = PacketReader::new();
        (self.trial_start, self.now) = (Duration::ZERO, Duration::ZERO);
        Ok(restarted)
    }

    fn continue_trial(&mut self) {
        self.inner.continue_trial();
        self.trial_start += self.now;
        self.now = Duration::ZERO;
    }

    fn chip(&mut self) -> Option<&mut dyn Chip> {
        self.inner.chip()
    }
}

fn decode(frame: &[u8]) -> Option<Packet> {
    PacketReader::new().packets(frame).next().and_then(Result::ok)
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_rig::HostedLink;
    use platebench_test_kit::CONFIGURE;
    use platebench_wire::Sample;

    /// Five rejected frames stop the controller, which reports it before the configuration.
    #[test]
    fn sends_the_report_of_a_stop_before_a_configuration_in_the_same_bytes() {
        let configure = Packet { sequence: 1, message: Message::Configure(CONFIGURE) };
        let sample = Sample { time_us: 0, setpoint_um: 2.0, wd_um: 0.0, wq_um: 0.0 };
        let sample = Packet { sequence: 2, message: Message::Sample(sample) };
        let noise = [[1, 1, 0]; 5].concat();
        let rejected_and_configure = [&noise[..], configure.encode().as_bytes()].concat();
        let answers = |link: &mut dyn Link| {
            let mut answer = Vec::new();
            for bytes in [configure.encode().as_bytes(), sample.encode().as_bytes(), &rejected_and_configure] {
                link.exchange(Duration::ZERO, bytes, &mut answer).unwrap();
            }
            PacketReader::new().packets(&answer).flatten().collect::<Vec<_>>()
        };
        let expected = answers(&mut HostedLink::new());
        assert_eq!(expected.len(), 4, "{expected:?}");
        let unchanged = || -> Box<dyn Mutant> { Box::new(|_: &mut Message| {}) };
        assert_eq!(answers(&mut MutantController::new(HostedLink::new(), unchanged)), expected);
    }
}
