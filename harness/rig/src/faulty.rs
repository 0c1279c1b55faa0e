//! Faults of a line, on purpose: a link around a link that loses, garbles, doubles, delays and drowns messages.
//!
//! ```text
//!   Faulty ─ the two directions in order of time, over a link in lockstep      this file
//!      ├ Line ─ the same over a line in real time                              line.rs
//!      └ Harm ─ what the faults make of one message                            harm.rs, parcel.rs
//! ```
//!
//! Faults strike samples and commands and nothing else: handshake, configuration and `safe` pass unharmed, so that a fault never stands between the bench and
//! 0 V. They go by the instants of the trial that they are given and by seeds, so that equal trials are harmed equally. In lockstep a lost sample still lets the
//! target's time pass: its own time-out acts, and what it says of its own accord comes back. A line does not reorder: what comes behind a delayed message waits.
//!
//! What each kind does, for users: `docs/scenarios.md`.

mod harm;
mod line;
mod parcel;

use crate::link::{Line, Link, LinkError};
use harm::Harm;
use line::Clock;
use parcel::{Frames, Parcel};
use platebench_wire::{FrameReader, Message, Packet, State};
use std::collections::VecDeque;
use std::time::Duration;

/// What a fault does to a message that it strikes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum WireFaultKind {
    /// It is lost.
    Drop,
    /// One of its bits, the delimiter's included, is flipped.
    Flip,
    /// It comes twice in a row.
    Duplicate,
    /// It comes so much later.
    Delay(Duration),
    /// Its second half is lost, and the delimiter with it.
    Truncate,
    /// 64 bytes of noise stand before it: four pieces that end in a delimiter, each a frame to be refused.
    Babble,
    /// It is lost, as everything in the window is.
    Disconnect,
    /// The sample's components stay what they were before the window.
    Freeze,
    /// The sample's components are multiplied.
    Scale(f32),
}

impl WireFaultKind {
    const COUNT: usize = 9;

    /// The kind's name in scenario files and records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Drop => "drop",
            Self::Flip => "flip",
            Self::Duplicate => "duplicate",
            Self::Delay(_) => "delay",
            Self::Truncate => "truncate",
            Self::Babble => "babble",
            Self::Disconnect => "disconnect",
            Self::Freeze => "freeze",
            Self::Scale(_) => "scale",
        }
    }
}

/// Which messages a fault strikes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// Samples.
    ToController,
    /// Commands.
    FromController,
    /// Both, each counted by themselves.
    Both,
}

/// One fault. Instants are counted from the start of the trial.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WireFault {
    /// What it does.
    pub kind: WireFaultKind,
    /// Start of its window.
    pub from: Duration,
    /// End of its window, no longer inside; `None` for one that stays.
    pub until: Option<Duration>,
    /// Which messages it strikes.
    pub direction: Direction,
    /// The n-th, 2n-th, … message of a direction in the window; 0 strikes none.
    pub every: u32,
    /// Of what is left to chance.
    pub seed: u64,
}

impl WireFault {
    fn covers(&self, now: Duration) -> bool {
        self.from <= now && self.until.is_none_or(|until| now < until)
    }
}

/// Messages that may be on their way in one direction at once; what comes on top of them is lost.
const MOST_HELD: usize = 256;

/// Stands before what must pass unharmed: half a frame that is still on the line ends here. On a clean line it says nothing.
const DELIMITER: u8 = 0;

/// A link with faults, none to begin with.
#[derive(Debug)]
pub struct Faulty<L> {
    inner: L,
    harm: Harm,
    /// In order of their instants, and what was sent first comes first.
    to_controller: VecDeque<Parcel>,
    from_controller: VecDeque<Parcel>,
    frames: Frames,
    /// In-phase and quadrature component of the last sample that reached the controller whole, µm.
    given: [f32; 2],
    overflowed: u64,
    scratch: Vec<u8>,
    clock: Option<Clock>,
}

impl<L: Link> Faulty<L> {
    /// The link `inner`, unharmed for now.
    pub fn new(inner: L) -> Self {
        Self {
            inner,
            harm: Harm::default(),
            to_controller: VecDeque::with_capacity(MOST_HELD),
            from_controller: VecDeque::with_capacity(MOST_HELD),
            frames: Frames::default(),
            given: [0.0; 2],
            overflowed: 0,
            scratch: Vec::with_capacity(MOST_HELD),
            clock: None,
        }
    }

    /// The faults of the next trial; those of the last one and their counts are forgotten. To be called before the trial's configuration.
    pub fn arm(&mut self, faults: &[WireFault]) {
        self.harm = Harm::new(faults);
        self.overflowed = 0;
        self.given = [0.0; 2];
        self.clock = None;
        self.forget();
    }

    /// The next instant at which something held up is due: a message for the controller, or one from it that [`Link::pass`] would hand over.
    pub fn due(&self) -> Option<Duration> {
        let fronts = [&self.to_controller, &self.from_controller].map(VecDeque::front);
        fronts.into_iter().flatten().map(|parcel| parcel.due).min()
    }

    /// In-phase and quadrature component that the controller was last given, µm; `None` where nothing can have harmed them.
    pub fn given(&self) -> Option<[f32; 2]> {
        self.harm.is_armed().then_some(self.given)
    }

    /// How many messages were struck, by the kind of fault, of the trial so far; kinds that struck none are left out. `overflow` counts messages that were
    /// lost because too many were on their way.
    pub fn counts(&self) -> impl Iterator<Item = (&'static str, u64)> + use<L> {
        let overflow = Some(("overflow", self.overflowed));
        self.harm.counts().into_iter().flatten().chain(overflow).filter(|(_, count)| *count > 0)
    }

    /// What is still on its way belongs to a trial that is over, or that begins anew.
    fn forget(&mut self) {
        self.to_controller.clear();
        self.from_controller.clear();
        self.frames = Frames::default();
    }

    /// Sends a sample on its way.
    fn post(&mut self, now: Duration, bytes: &[u8]) {
        if let Some(parcel) = self.harm.strike(Direction::ToController, now, bytes) {
            self.overflowed += u64::from(!enqueue(&mut self.to_controller, parcel));
        }
    }

    /// Sends what came from the controller at `now`, in `scratch`, on its way to the bench.
    fn return_scratch(&mut self, now: Duration) {
        for &byte in &self.scratch {
            let Some(frame) = self.frames.push(byte) else { continue };
            let parcel = match decode(frame).map(|packet| packet.message) {
                Some(Message::Command(command)) if command.state != State::Safe => {
                    self.harm.strike(Direction::FromController, now, frame)
                }
                _ => Parcel::new(now, frame),
            };
            if let Some(parcel) = parcel {
                self.overflowed += u64::from(!enqueue(&mut self.from_controller, parcel));
            }
        }
        self.scratch.clear();
    }

    fn take_given(&mut self, parcel: &Parcel) {
        if let Some(Packet { message: Message::Sample(sample), .. }) = decode(parcel.bytes()) {
            self.given = [sample.wd_um, sample.wq_um];
        }
    }

    /// Everything that happens up to `now`, the target's time included. How long the target took for the last message that was given to it.
    fn advance(&mut self, now: Duration, answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let mut last = None;
        while let Some(parcel) = pop_due(&mut self.to_controller, now) {
            self.take_given(&parcel);
            let delay = self.inner.exchange(parcel.due, parcel.bytes(), &mut self.scratch)?;
            last = Some((parcel.due, delay));
            self.return_scratch(parcel.due);
        }
        if last.is_none_or(|(at, _)| at < now) {
            self.inner.pass(now, &mut self.scratch)?;
            self.return_scratch(now);
        }
        while let Some(parcel) = pop_due(&mut self.from_controller, now) {
            answer.extend_from_slice(parcel.bytes());
        }
        Ok(last.map_or(Duration::ZERO, |(_, delay)| delay))
    }
}

impl<L: Link> Link for Faulty<L> {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        if !self.harm.is_armed() {
            return self.inner.exchange(now, bytes, answer);
        }
        if !is_sample(bytes) {
            self.forget();
            answer.push(DELIMITER);
            return self.inner.exchange(now, &[&[DELIMITER], bytes].concat(), answer);
        }
        self.post(now, bytes);
        self.advance(now, answer)
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        if self.harm.is_armed() { self.advance(now, said).map(|_| ()) } else { self.inner.pass(now, said) }
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.forget();
        self.inner.restart()
    }

    fn cost(&self) -> Option<u64> {
        self.inner.cost()
    }

    fn line(&mut self) -> Option<&mut dyn Line> {
        if self.inner.line().is_some() { Some(self) } else { None }
    }
}

/// Puts a parcel behind those that are on their way already; false where there is no room.
fn enqueue(queue: &mut VecDeque<Parcel>, mut parcel: Parcel) -> bool {
    if queue.len() >= MOST_HELD {
        return false;
    }
    if let Some(before) = queue.back() {
        parcel.due = parcel.due.max(before.due);
    }
    queue.push_back(parcel);
    true
}

fn pop_due(queue: &mut VecDeque<Parcel>, now: Duration) -> Option<Parcel> {
    queue.pop_front_if(|parcel| parcel.due <= now)
}

/// What the first frame in `bytes` says.
fn decode(bytes: &[u8]) -> Option<Packet> {
    let mut reader = FrameReader::new();
    let mut bytes = bytes.iter();
    let packet =
        bytes.find_map(|&byte| reader.push(byte).map(|frame| frame.ok().and_then(|it| Packet::decode(it).ok())));
    packet.flatten()
}

fn is_sample(bytes: &[u8]) -> bool {
    matches!(decode(bytes), Some(Packet { message: Message::Sample(_), .. }))
}

#[cfg(test)]
mod tests;
