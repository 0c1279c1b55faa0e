//! A link around a controller that makes one mistake.
//!
//! What comes for the controller is taken apart into frames; a mistake may change a message before the controller reads it, and its answer before the bench
//! does. The controller inside is the right one, whatever it runs on.

use platebench_rig::{Link, LinkError};
use platebench_wire::{Command, Configure, Configured, FrameReader, Gains, Message, Packet, Sample, State};
use std::collections::VecDeque;
use std::time::Duration;

/// One mistake with its state. Everything that is not overridden is done right.
pub trait Mistake: Send {
    /// A message on its way to the controller.
    fn take(&mut self, packet: &mut Packet) {
        match &mut packet.message {
            Message::Configure(configure) => self.configure(configure),
            Message::Sample(sample) => self.sample(sample),
            _ => {}
        }
    }

    /// A message on its way to the bench. A controller that has stopped makes no mistakes any more, unless this is overridden.
    fn give(&mut self, packet: &mut Packet) {
        match &mut packet.message {
            Message::Configured(Configured { outcome: Ok(gains) }) => self.configured(gains),
            Message::Command(command) if command.state == State::Running => self.command(command),
            _ => {}
        }
    }

    /// What the controller is configured with.
    fn configure(&mut self, _configure: &mut Configure) {}

    /// The gains that the controller designed.
    fn configured(&mut self, _gains: &Gains) {}

    /// What the controller is given.
    fn sample(&mut self, _sample: &mut Sample) {}

    /// What the plate is driven with.
    fn command(&mut self, _command: &mut Command) {}

    /// A frame with its delimiter that cannot be read: what the controller makes of it, `None` where it never notices.
    fn garbage(&mut self, frame: &[u8]) -> Option<Vec<u8>> {
        Some(frame.to_vec())
    }

    /// What the controller does of its own accord before it takes a sample with this number.
    fn before(&mut self, _sequence: u8) -> Option<Packet> {
        None
    }

    /// How much later than it should the next command leaves.
    fn delay(&mut self) -> Duration {
        Duration::ZERO
    }
}

/// Bytes without a delimiter that are handed on as they are.
const OVERLONG: usize = 4096;

/// The controller behind `inner`, making a mistake. In lockstep alone: it has no line in real time.
pub struct Mistaken<L> {
    inner: L,
    make: fn() -> Box<dyn Mistake>,
    mistake: Box<dyn Mistake>,
    arriving: Vec<u8>,
    reader: FrameReader,
    scratch: Vec<u8>,
    /// On their way to the bench, in order, and when they are there.
    held: VecDeque<(Duration, Packet)>,
}

impl<L: Link> Mistaken<L> {
    /// A controller that makes the mistake of `make`, anew in every trial.
    pub fn new(inner: L, make: fn() -> Box<dyn Mistake>) -> Self {
        Self {
            inner,
            make,
            mistake: make(),
            arriving: Vec::new(),
            reader: FrameReader::new(),
            scratch: Vec::new(),
            held: VecDeque::new(),
        }
    }

    /// One frame with its delimiter, on its way to the controller. Returns how long the controller took.
    fn deliver(&mut self, now: Duration, frame: &[u8]) -> Result<Duration, LinkError> {
        let Some(mut packet) = decode(frame) else {
            let kept = if frame.len() > 1 { self.mistake.garbage(frame) } else { Some(frame.to_vec()) };
            return kept.map_or(Ok(Duration::ZERO), |bytes| self.exchange_raw(now, &bytes));
        };
        match packet.message {
            Message::Configure(_) => self.held.clear(),
            Message::Sample(_) => {
                if let Some(own) = self.mistake.before(packet.sequence) {
                    self.exchange_raw(now, own.encode().as_bytes())?;
                }
            }
            _ => {}
        }
        self.mistake.take(&mut packet);
        self.exchange_raw(now, packet.encode().as_bytes())
    }

    fn exchange_raw(&mut self, now: Duration, bytes: &[u8]) -> Result<Duration, LinkError> {
        let took = self.inner.exchange(now, bytes, &mut self.scratch)?;
        self.hear(now);
        Ok(took)
    }

    /// What the controller said, in `scratch`, on its way to the bench.
    fn hear(&mut self, now: Duration) {
        for byte in self.scratch.drain(..) {
            let Some(body) = self.reader.push(byte) else { continue };
            let Some(mut packet) = body.ok().and_then(|body| Packet::decode(body).ok()) else { continue };
            self.mistake.give(&mut packet);
            let acts = matches!(packet.message, Message::Command(Command { state: State::Running, .. }));
            let due = now + if acts { self.mistake.delay() } else { Duration::ZERO };
            let due = self.held.back().map_or(due, |(before, _)| due.max(*before));
            self.held.push_back((due, packet));
        }
    }

    fn hand_over(&mut self, now: Duration, answer: &mut Vec<u8>) {
        while let Some((_, packet)) = self.held.pop_front_if(|(due, _)| *due <= now) {
            answer.extend_from_slice(packet.encode().as_bytes());
        }
    }
}

impl<L: Link> Link for Mistaken<L> {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let mut took = Duration::ZERO;
        for &byte in bytes {
            self.arriving.push(byte);
            if byte == 0 || self.arriving.len() >= OVERLONG {
                let frame = std::mem::take(&mut self.arriving);
                took += self.deliver(now, &frame)?;
            }
        }
        self.hand_over(now, answer);
        Ok(took)
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.pass(now, &mut self.scratch)?;
        self.hear(now);
        self.hand_over(now, said);
        Ok(())
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        let restarted = self.inner.restart()?;
        self.mistake = (self.make)();
        self.arriving.clear();
        self.scratch.clear();
        self.held.clear();
        self.reader = FrameReader::new();
        Ok(restarted)
    }

    fn cost(&self) -> Option<u64> {
        self.inner.cost()
    }
}

/// What a frame with its delimiter says.
fn decode(frame: &[u8]) -> Option<Packet> {
    let mut reader = FrameReader::new();
    let packets =
        frame.iter().find_map(|&byte| reader.push(byte).map(|body| body.ok().and_then(|it| Packet::decode(it).ok())));
    packets.flatten()
}
