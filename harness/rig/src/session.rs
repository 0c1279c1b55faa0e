//! Handshake, configuration, samples and a safe end over any link.

use crate::link::{Link, LinkError};
use platebench_wire::{
    Command, Configure, Configured, FaultReport, FrameReader, Gains, Identity, Message, Packet, Rejection, Sample,
    State,
};
use std::time::{Duration, Instant};
use tracing::{debug, trace, warn};

/// Why a controller cannot be worked with.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// The line or what is behind it is dead.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The target does not answer as the protocol has it.
    #[error(
        "no {expected} from the controller; is it running, and does it speak version {} of the protocol?",
        platebench_wire::VERSION
    )]
    NoAnswer {
        /// What should have come.
        expected: &'static str,
    },
    /// The rig knows virtual time alone.
    #[error("this rig cannot be used in real time")]
    NotLive,
    /// The target has forgotten its configuration in the middle of a trial.
    #[error("the controller was restarted in the middle of a trial")]
    Restarted,
    /// The target refused its configuration.
    #[error("the controller refused its configuration: {}", match .0 {
        Rejection::Value => "a value that it cannot work with",
        Rejection::Law => "it does not have this law",
    })]
    Refused(Rejection),
    /// The target's processor trapped.
    #[error("the controller trapped: code {}, pc {:#010x}, lr {:#010x}, cfsr {:#010x}, address {:#010x}", .0.code, .0.pc, .0.lr, .0.cfsr, .0.address)]
    Trapped(FaultReport),
}

/// A controller's answer to a sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reply {
    /// What the plate is to be driven with.
    pub command: Command,
    /// How long it took, as the link counts it.
    pub delay: Duration,
    /// Instructions that the target executed for it, where the link can count them.
    pub instructions: Option<u64>,
}

/// Something that a target said in real time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Heard {
    /// When its last byte was there.
    pub at: Instant,
    /// The number that it carries.
    pub sequence: u8,
    /// What it is.
    pub message: Message,
}

/// Room for what arrives at once: more than a pseudo-terminal holds, so that listening never allocates.
const ROOM: usize = 8 * 1024;
/// A line that loses a frame now and then must not cost the confirmation of 0 V.
const ATTEMPTS_AT_SAFE: u32 = 3;

/// A conversation with one controller. Dropping it drives the plate to 0 V.
#[derive(Debug)]
pub struct Session<L: Link> {
    link: L,
    reader: FrameReader,
    identity: Identity,
    sequence: u8,
    /// Number of the last command that was handed over.
    heard: u8,
    /// A command that came beside the answer that was waited for, and has not been handed over yet.
    said: Option<(u8, Command)>,
    now: Duration,
    bytes: Vec<u8>,
    /// How many of `bytes` were read.
    read: usize,
    /// When the last of `bytes` was there, where they were heard in real time.
    arrived: Instant,
    /// True once the controller said who it is.
    introduced: bool,
    /// True once 0 V has been asked for at its end.
    closed: bool,
    refused: u64,
    /// By sequence number: drive (as bits, so that what is no number equals itself) and frequency that the sample of that number was answered with.
    answers: [Option<(u32, u32)>; 256],
    contradictions: u64,
}

impl<L: Link> Session<L> {
    /// Asks who is there.
    ///
    /// # Errors
    /// [`RigError`] where nobody answers as the protocol has it.
    pub fn open(link: L) -> Result<Self, RigError> {
        let identity = Identity {
            version: [0; 3],
            capabilities: 0,
            laws: 0,
            build: [0; 8],
            chip: 0,
            unique: [0; 12],
            name: [0; 16],
        };
        let mut session = Self {
            link,
            reader: FrameReader::new(),
            identity,
            sequence: 0,
            heard: 0,
            said: None,
            now: Duration::ZERO,
            bytes: Vec::with_capacity(ROOM),
            read: 0,
            arrived: Instant::now(),
            introduced: false,
            closed: false,
            refused: 0,
            answers: [None; 256],
            contradictions: 0,
        };
        match session.ask(Message::Hello)? {
            Some((Message::Identity(identity), _)) => {
                session.identity = identity;
                session.introduced = true;
            }
            _ => return Err(RigError::NoAnswer { expected: "identity" }),
        }
        debug!(name = %session.firmware_name(), laws = session.identity.laws, "controller found");
        Ok(session)
    }

    /// The line, for what only its kind of rig can tell.
    pub fn link(&self) -> &L {
        &self.link
    }

    /// The line, for what only its kind takes.
    pub fn link_mut(&mut self) -> &mut L {
        &mut self.link
    }

    /// Who is there.
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// The firmware's name, as [`printable_name`] has it.
    pub fn firmware_name(&self) -> String {
        printable_name(&self.identity)
    }

    /// Starts a trial: time zero, 0 V, the design that `configure` asks for. A target that can be restarted is, so that no trial depends on those before it.
    ///
    /// # Errors
    /// [`RigError`] where the target refuses or does not answer.
    pub fn begin(&mut self, configure: &Configure) -> Result<Gains, RigError> {
        if self.link.restart()? {
            self.sequence = 0;
            self.reader = FrameReader::new();
            self.bytes.clear();
            self.read = 0;
        }
        let gains = self.configure(Duration::ZERO, configure)?;
        self.refused = 0;
        self.answers = [None; 256];
        self.contradictions = 0;
        Ok(gains)
    }

    /// Within a trial, at `now`: 0 V, and the design that `configure` asks for from the next sample on. Leaves the states of a controller that has stopped.
    ///
    /// # Errors
    /// [`RigError`] where the target refuses or does not answer.
    pub fn configure(&mut self, now: Duration, configure: &Configure) -> Result<Gains, RigError> {
        self.now = now;
        self.said = None;
        match self.ask(Message::Configure(*configure))? {
            Some((Message::Configured(Configured { outcome }), _)) => {
                debug!(law = configure.law.name(), gains = ?outcome, "controller configured");
                outcome.map_err(RigError::Refused)
            }
            _ => Err(RigError::NoAnswer { expected: "answer to its configuration" }),
        }
    }

    /// Gives the target a sample at `now`. `None` where no answer came: the last command holds.
    ///
    /// # Errors
    /// [`RigError`] where the line is dead or the target trapped.
    pub fn sample(&mut self, now: Duration, sample: &Sample) -> Result<Option<Reply>, RigError> {
        self.now = now;
        match self.ask(Message::Sample(*sample))? {
            Some((Message::Command(command), delay)) => {
                trace!(?now, ?sample, ?command, ?delay, "control step");
                Ok(Some(Reply { command, delay, instructions: self.link.cost() }))
            }
            _ => Ok(None),
        }
    }

    /// True where the last sample was answered, in time or late.
    pub fn is_answered(&self) -> bool {
        self.heard == self.sequence
    }

    /// Lets time pass without a sample and returns the last command that came meanwhile or beside an answer: one that is late, or one that the target gave
    /// of its own accord because it stopped. One that is older than what was handed over before is none.
    ///
    /// # Errors
    /// [`RigError`] where the line is dead or the target trapped.
    pub fn pass(&mut self, now: Duration) -> Result<Option<Command>, RigError> {
        self.now = now;
        self.forget_read();
        self.link.pass(now, &mut self.bytes)?;
        let mut last = self.said.take();
        let news = self.news();
        self.read_packets(|packet| last = news.of(packet).or(last))?;
        if let Some((sequence, _)) = last {
            self.heard = sequence;
        }
        Ok(last.map(|(_, command)| command))
    }

    /// Asks for 0 V, again where no answer comes. True where the target confirmed it.
    pub fn safe(&mut self) -> bool {
        for _ in 0..ATTEMPTS_AT_SAFE {
            match self.ask(Message::Safe) {
                Ok(Some((Message::Command(command), _))) => {
                    return command.state == State::Safe && command.drive_vpp == 0.0;
                }
                Ok(_) => {}
                Err(error) => {
                    debug!(%error, "0 V could not be asked for");
                    return false;
                }
            }
        }
        false
    }

    /// Ends the session and asks for 0 V, as dropping it does. True where the target confirmed it.
    pub fn close(mut self) -> bool {
        self.closed = true;
        self.safe()
    }

    /// True where [`Session::post`] and [`Session::listen`] can be used.
    pub fn is_live(&mut self) -> bool {
        self.link.line().is_some()
    }

    /// Sends `message` without waiting for its answer and returns the number that it was sent under. Neither allocates nor logs.
    ///
    /// # Errors
    /// [`RigError`] where the line is dead or knows virtual time alone.
    pub fn post(&mut self, message: Message) -> Result<u8, RigError> {
        let frame = Packet { sequence: self.sequence.wrapping_add(1), message }.encode();
        self.link.line().ok_or(RigError::NotLive)?.send(frame.as_bytes())?;
        Ok(self.next_sequence())
    }

    /// Waits for the next thing that the target says, at most until `until`; one packet a call, those that came with it are kept for the next calls.
    /// What cannot be read is counted by [`Session::refused`]. Neither allocates nor logs.
    ///
    /// # Errors
    /// [`RigError`] where the line is dead or knows virtual time alone, or the target trapped.
    pub fn listen(&mut self, until: Instant) -> Result<Option<Heard>, RigError> {
        let mut over = false;
        loop {
            if let Some(Packet { sequence, message }) = self.next_packet()? {
                return Ok(Some(Heard { at: self.arrived, sequence, message }));
            }
            if over {
                return Ok(None);
            }
            self.forget_read();
            let line = self.link.line().ok_or(RigError::NotLive)?;
            let Some(arrived) = line.receive(until, &mut self.bytes)? else { return Ok(None) };
            self.arrived = arrived;
            // A line that babbles without end does not hold anybody up.
            over = arrived >= until;
        }
    }

    /// Frames that came in and could not be read since [`Session::begin`].
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Commands since [`Session::begin`] that wanted another drive or frequency than an earlier one did in answer to the same sample. A frame that the line
    /// doubled wants the same, and a controller that stopped takes its last command back: neither is one.
    pub fn contradictions(&self) -> u64 {
        self.contradictions
    }

    fn note_answer(&mut self, sequence: u8, command: &Command) {
        let Some(answer) = self.answers.get_mut(usize::from(sequence)).filter(|_| command.state == State::Running)
        else {
            return;
        };
        let wanted = (command.drive_vpp.to_bits(), command.frequency_mhz);
        self.contradictions += u64::from(answer.replace(wanted).is_some_and(|before| before != wanted));
    }

    /// The number of the next message, which nothing has answered yet.
    fn next_sequence(&mut self) -> u8 {
        self.sequence = self.sequence.wrapping_add(1);
        if let Some(answer) = self.answers.get_mut(usize::from(self.sequence)) {
            *answer = None;
        }
        self.sequence
    }

    /// Sends `message` and returns the answer that carries its number.
    fn ask(&mut self, message: Message) -> Result<Option<(Message, Duration)>, RigError> {
        let sequence = self.next_sequence();
        self.forget_read();
        let frame = Packet { sequence, message }.encode();
        let delay = self.link.exchange(self.now, frame.as_bytes(), &mut self.bytes)?;
        let (mut answer, mut said) = (None, self.said.take());
        let news = self.news();
        self.read_packets(|packet| {
            if packet.sequence == sequence && !packet.message.counts_by_itself() {
                answer = Some((packet.message, delay));
            } else {
                said = news.of(packet).or(said);
            }
        })?;
        if answer.is_some() {
            self.heard = sequence;
        } else {
            self.said = said;
        }
        Ok(answer)
    }

    fn news(&self) -> News {
        News { sent: self.sequence, heard: self.heard }
    }

    fn read_packets(&mut self, mut take: impl FnMut(&Packet)) -> Result<(), RigError> {
        let refused = self.refused;
        while let Some(packet) = self.next_packet()? {
            take(&packet);
        }
        if self.refused > refused {
            warn!(frames = self.refused - refused, "frames refused");
        }
        Ok(())
    }

    /// The next packet among what arrived; frames that cannot be read are counted.
    fn next_packet(&mut self) -> Result<Option<Packet>, RigError> {
        while let Some(&byte) = self.bytes.get(self.read) {
            self.read += 1;
            let Some(frame) = self.reader.push(byte) else { continue };
            match frame.ok().and_then(|body| Packet::decode(body).ok()) {
                Some(Packet { message: Message::Fault(report), .. }) => return Err(RigError::Trapped(report)),
                Some(packet) => {
                    if let Message::Command(command) = &packet.message {
                        self.note_answer(packet.sequence, command);
                    }
                    return Ok(Some(packet));
                }
                None => self.refused += 1,
            }
        }
        Ok(None)
    }

    /// Makes room; what was heard but not asked for yet stays.
    fn forget_read(&mut self) {
        if self.read >= self.bytes.len() {
            self.bytes.clear();
            self.read = 0;
        }
    }
}

/// The firmware's name, which is printable ASCII; what is not, a terminal might take for an order, is replaced.
pub fn printable_name(identity: &Identity) -> String {
    let name = identity.name.split(|&byte| byte == 0).next().unwrap_or_default();
    let printable = |&byte: &u8| matches!(byte, b' '..=b'~');
    name.iter().map(|byte| if printable(byte) { char::from(*byte) } else { char::REPLACEMENT_CHARACTER }).collect()
}

/// Tells commands that are still to be heard from those that came too late to matter.
#[derive(Clone, Copy)]
struct News {
    sent: u8,
    heard: u8,
}

impl News {
    /// The command of `packet`, where it answers a later message than the last command did, or takes that one back because the target stopped.
    fn of(self, packet: &Packet) -> Option<(u8, Command)> {
        let Message::Command(command) = packet.message else { return None };
        let [age, known] = [packet.sequence, self.heard].map(|number| self.sent.wrapping_sub(number));
        let is_news = age < known || (age == known && command.state != State::Running);
        is_news.then_some((packet.sequence, command))
    }
}

impl<L: Link> Drop for Session<L> {
    fn drop(&mut self) {
        if !self.closed && !self.safe() && self.introduced {
            warn!("0 V was not confirmed at the end of the session");
        }
    }
}

#[cfg(test)]
mod tests;
