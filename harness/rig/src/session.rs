//! Handshake, configuration, samples and a safe end over any link.

use crate::link::{Link, LinkError};
use platebench_wire::{
    Command, Configure, Configured, FaultReport, FrameReader, Gains, Identity, Message, Packet, Rejection, Sample,
    State,
};
use std::time::Duration;
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

/// A conversation with one controller. Dropping it drives the plate to 0 V.
#[derive(Debug)]
pub struct Session<L: Link> {
    link: L,
    reader: FrameReader,
    identity: Identity,
    sequence: u8,
    now: Duration,
    bytes: Vec<u8>,
}

impl<L: Link> Session<L> {
    /// Asks who is there.
    ///
    /// # Errors
    /// [`RigError`] where nobody answers as the protocol has it.
    pub fn open(link: L) -> Result<Self, RigError> {
        let identity = Identity { version: [0; 3], laws: 0, build: [0; 8], chip: 0, unique: [0; 12], name: [0; 16] };
        let bytes = Vec::with_capacity(256);
        let mut session = Self { link, reader: FrameReader::new(), identity, sequence: 0, now: Duration::ZERO, bytes };
        match session.ask(Message::Hello)? {
            Some((Message::Identity(identity), _)) => session.identity = identity,
            _ => return Err(RigError::NoAnswer { expected: "identity" }),
        }
        debug!(name = %session.firmware_name(), laws = session.identity.laws, "controller found");
        Ok(session)
    }

    /// The line, for what only its kind of rig can tell.
    pub fn link(&self) -> &L {
        &self.link
    }

    /// Who is there.
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// The firmware's name.
    pub fn firmware_name(&self) -> String {
        let name = self.identity.name.split(|&byte| byte == 0).next().unwrap_or_default();
        String::from_utf8_lossy(name).into_owned()
    }

    /// Starts a trial: time zero, 0 V, the design that `configure` asks for. A target that can be restarted is, so that no trial depends on those before it.
    ///
    /// # Errors
    /// [`RigError`] where the target refuses or does not answer.
    pub fn begin(&mut self, configure: &Configure) -> Result<Gains, RigError> {
        self.now = Duration::ZERO;
        if self.link.restart()? {
            self.sequence = 0;
            self.reader = FrameReader::new();
        }
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

    /// Lets time pass without a sample and returns the last thing that the target did about it, if it said so.
    ///
    /// # Errors
    /// [`RigError`] where the line is dead or the target trapped.
    pub fn pass(&mut self, now: Duration) -> Result<Option<Command>, RigError> {
        self.now = now;
        self.bytes.clear();
        self.link.pass(now, &mut self.bytes)?;
        let mut last = None;
        self.read_packets(|packet| {
            if let Message::Command(command) = packet.message {
                last = Some(command);
            }
        })?;
        Ok(last)
    }

    /// Asks for 0 V. True where the target confirmed it.
    pub fn safe(&mut self) -> bool {
        match self.ask(Message::Safe) {
            Ok(Some((Message::Command(command), _))) => command.state == State::Safe && command.drive_vpp == 0.0,
            Ok(_) => false,
            Err(error) => {
                debug!(%error, "0 V could not be asked for");
                false
            }
        }
    }

    /// Sends `message` and returns the answer that carries its number.
    fn ask(&mut self, message: Message) -> Result<Option<(Message, Duration)>, RigError> {
        self.sequence = self.sequence.wrapping_add(1);
        let sequence = self.sequence;
        self.bytes.clear();
        let frame = Packet { sequence, message }.encode();
        let delay = self.link.exchange(self.now, frame.as_bytes(), &mut self.bytes)?;
        let mut answer = None;
        self.read_packets(|packet| {
            if packet.sequence == sequence {
                answer = Some((packet.message, delay));
            }
        })?;
        Ok(answer)
    }

    fn read_packets(&mut self, mut take: impl FnMut(&Packet)) -> Result<(), RigError> {
        for &byte in &self.bytes {
            let Some(frame) = self.reader.push(byte) else { continue };
            let Ok(body) = frame else {
                warn!(error = ?frame.err(), "frame refused");
                continue;
            };
            match Packet::decode(body) {
                Ok(Packet { message: Message::Fault(report), .. }) => return Err(RigError::Trapped(report)),
                Ok(packet) => take(&packet),
                Err(error) => warn!(?error, "message refused"),
            }
        }
        Ok(())
    }
}

impl<L: Link> Drop for Session<L> {
    fn drop(&mut self) {
        if !self.safe() {
            warn!("0 V was not confirmed at the end of the session");
        }
    }
}

#[cfg(test)]
mod tests;
