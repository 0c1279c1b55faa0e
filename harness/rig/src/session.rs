//! Runs the protocol with one controller: handshake, configuration, samples and 0 V over any link.

use crate::cancel::CancelToken;
use crate::command_audit::{CommandAudit, DrivesAfterSafe};
use crate::handshake::{HANDSHAKE_TIMEOUT, handshake};
use crate::link::{Link, LinkError, LinkKind, RealTimeLine};
use crate::rejected_frame::{FrameMeter, RejectedFrame};
use crate::rig_error::RigError;
use platebench_model::record::Transport;
use platebench_wire::{
    Command, Configure, Configured, ControllerState, Gains, Identity, Message, Packet, PacketReader, Sample,
};
use std::thread;
use std::time::{Duration, Instant};
use tracing::{debug, trace, warn};

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reply {
    pub command: Command,
    /// Time from the request to the answer, see [`Link::exchange`].
    pub delay: Duration,
    pub instructions: Option<u64>,
    pub computing_time: Option<Duration>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReceivedMessage {
    pub received_at: Instant,
    pub sequence: u8,
    pub message: Message,
}

/// The first request of a session has the next number. Every hello before has the number 0.
const NUMBER_BEFORE_FIRST: u8 = 1;
/// Larger than a pseudo-terminal's buffer, so that receiving never allocates.
const RECEIVE_CAPACITY: usize = 8 * 1024;
/// Largest number of requests for 0 V, because a frame may be lost.
const SAFE_ATTEMPTS: u32 = 3;
/// The session reads the line for the longer of these times after the controller confirmed 0 V.
const MIN_OBSERVATION: Duration = Duration::from_millis(20);
const OBSERVED_PERIODS: u32 = 10;
/// Number of reads of an observation in simulated time.
const OBSERVATION_STEPS: u32 = 20;
const OBSERVATION_POLL_INTERVAL: Duration = Duration::from_millis(1);

/// State of the controller at the end of a session.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SafeEnd {
    Confirmed,
    Unconfirmed,
    /// The controller commanded a drive after it had confirmed 0 V.
    Driven(DrivesAfterSafe),
}

/// Dropping the session requests 0 V.
#[derive(Debug)]
pub struct Session<L: Link> {
    link: L,
    reader: PacketReader,
    identity: Identity,
    sequence: u8,
    last_command_sequence: u8,
    /// Command that arrived during another request and that the caller has not received yet.
    pending_command: Option<(u8, Command)>,
    now: Duration,
    /// Control period of the last configuration.
    period: Duration,
    bytes: Vec<u8>,
    consumed: usize,
    /// Arrival of the last byte of `bytes`; used only in real time.
    received_at: Instant,
    /// Shortens the observation after 0 V.
    cancel: CancelToken,
    has_identity: bool,
    /// True from the configuration of a trial to the request for 0 V, until another client is found.
    detects_clients: bool,
    is_closed: bool,
    /// True if the controller is a program that has ended.
    has_ended: bool,
    /// How the program ended before it confirmed 0 V.
    ended_before_safe: Option<String>,
    rejected_frames: u64,
    frames: FrameMeter,
    audit: CommandAudit,
    transport: Transport,
}

impl<L: Link> Session<L> {
    pub fn open(link: L) -> Result<Self, RigError> {
        Self::open_cancellable(link, &CancelToken::never())
    }

    /// Repeats the hello until the controller sends its identity, for at most 5 s. A failure
    /// requests 0 V, because a controller that does not answer may still receive.
    pub fn open_cancellable(link: L, cancel: &CancelToken) -> Result<Self, RigError> {
        let mut session = Self {
            link,
            reader: PacketReader::new(),
            identity: Identity {
                version: [0; 3],
                capabilities: 0,
                laws: 0,
                build: [0; 8],
                chip: 0,
                unique: [0; 12],
                name: [0; 16],
            },
            sequence: NUMBER_BEFORE_FIRST,
            last_command_sequence: NUMBER_BEFORE_FIRST,
            pending_command: None,
            now: Duration::ZERO,
            period: Duration::ZERO,
            bytes: Vec::with_capacity(RECEIVE_CAPACITY),
            consumed: 0,
            received_at: Instant::now(),
            cancel: cancel.with_deadline(None),
            has_identity: false,
            detects_clients: false,
            is_closed: false,
            has_ended: false,
            ended_before_safe: None,
            rejected_frames: 0,
            frames: FrameMeter::default(),
            audit: CommandAudit::new(),
            transport: Transport::Words,
        };
        session.identity = handshake(&mut session.link, HANDSHAKE_TIMEOUT, cancel, || None)?;
        session.has_identity = true;
        debug!(name = %session.firmware_name(), laws = session.identity.laws, "controller found");
        Ok(session)
    }

    pub fn link(&self) -> &L {
        &self.link
    }

    pub fn link_mut(&mut self) -> &mut L {
        &mut self.link
    }

    /// Sets how messages pass from the next trial on, on a rig with more than one transport. Call it
    /// before the trial's configuration. A session starts with [`Transport::Words`].
    pub fn set_transport(&mut self, transport: Transport) {
        self.transport = transport;
        if let Some(chip) = self.link.chip() {
            chip.set_transport(transport);
        }
    }

    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    pub fn firmware_name(&self) -> String {
        printable_name(&self.identity)
    }

    /// True if the controller is a program that has ended, so that it needs a new session.
    pub fn has_ended(&self) -> bool {
        self.has_ended
    }

    /// The failure of a program that ended before it confirmed 0 V.
    pub fn end_before_safe(&self) -> Option<RigError> {
        self.ended_before_safe.clone().map(|how| LinkError::Ended(how).into())
    }

    /// Restarts the target if the link can, so that no trial depends on earlier ones.
    pub fn start_trial(&mut self, configure: &Configure) -> Result<Gains, RigError> {
        self.read_idle_line()?;
        if self.link.restart()? {
            self.sequence = 0;
            self.reader = PacketReader::new();
            self.bytes.clear();
            self.consumed = 0;
            self.audit.forget_messages();
        }
        self.configure_trial(configure)
    }

    /// Starts a trial. If `continues` is true, the target is not restarted and keeps its history.
    pub fn begin_trial(&mut self, configure: &Configure, continues: bool) -> Result<Gains, RigError> {
        if !continues {
            return self.start_trial(configure);
        }
        self.read_idle_line()?;
        self.link.continue_trial();
        self.configure_trial(configure)
    }

    /// Checks the messages since the last observation. Simulated time stood still since then.
    fn read_idle_line(&mut self) -> Result<(), RigError> {
        if self.link.kind() != LinkKind::Simulated {
            self.advance_to(self.now)?;
        }
        Ok(())
    }

    fn configure_trial(&mut self, configure: &Configure) -> Result<Gains, RigError> {
        // What arrives with the answer to the configuration belongs to the trial.
        self.audit.reset();
        self.frames.reset();
        let gains = self.reconfigure(Duration::ZERO, configure)?;
        self.frames.reset();
        self.rejected_frames = 0;
        self.detects_clients = self.link.kind() == LinkKind::Network;
        Ok(gains)
    }

    /// The controller goes to 0 V and uses the new configuration from the next sample on, also if
    /// it had stopped.
    pub fn reconfigure(&mut self, now: Duration, configure: &Configure) -> Result<Gains, RigError> {
        self.now = now;
        self.period = Duration::from_micros(configure.period_us.into());
        self.pending_command = None;
        match self.request(Message::Configure(*configure))? {
            Some((Message::Configured(Configured { outcome }), _)) => {
                debug!(law = configure.law.name(), gains = ?outcome, "controller configured");
                outcome.map_err(RigError::ConfigurationRejected)
            }
            _ => Err(self.no_answer("answer to its configuration")),
        }
    }

    /// `None` if no answer arrives. The plate then keeps the last command.
    pub fn send_sample(&mut self, now: Duration, sample: &Sample) -> Result<Option<Reply>, RigError> {
        self.now = now;
        match self.request(Message::Sample(*sample))? {
            Some((Message::Command(command), delay)) => {
                trace!(?now, ?sample, ?command, ?delay, "control step");
                let chip = self.link.chip();
                let (instructions, computing_time) =
                    chip.map_or((None, None), |chip| (chip.instruction_count(), chip.computing_time()));
                Ok(Some(Reply { command, delay, instructions, computing_time }))
            }
            _ => Ok(None),
        }
    }

    /// Number of messages sent after the one that the last command answered.
    pub fn newer_messages(&self) -> u8 {
        self.sequence.wrapping_sub(self.last_command_sequence)
    }

    /// True also if the answer arrived late.
    pub fn last_sample_answered(&self) -> bool {
        self.newer_messages() == 0
    }

    /// Advances the target's time without a sample. Returns the newest command since the previous
    /// call: a late answer or the report of a stop. Ignores commands older than those returned
    /// before.
    pub fn advance_to(&mut self, now: Duration) -> Result<Option<Command>, RigError> {
        self.now = now;
        self.discard_consumed();
        let advanced = self.link.advance_to(now, &mut self.bytes);
        self.check_link(advanced)?;
        let mut last = self.pending_command.take();
        let filter = self.command_filter();
        self.read_packets(|packet| last = filter.new_command(packet).or(last))?;
        if let Some((sequence, _)) = last {
            self.last_command_sequence = sequence;
        }
        Ok(last.map(|(_, command)| command))
    }

    /// Returns true if the controller confirmed 0 V under the number of the request.
    pub fn request_safe_state(&mut self) -> bool {
        self.detects_clients = false;
        // A line that cannot be read may still carry the request.
        if let Err(error) = self.receive_before_request() {
            debug!(%error, "nothing was received before the request for 0 V");
        }
        for _ in 0..SAFE_ATTEMPTS {
            let drives = self.audit.drives_after_safe();
            match self.request(Message::Safe) {
                // A second answer with a drive contradicts the confirmation.
                Ok(Some((Message::Command(_), _))) => {
                    return self.audit.is_safe() && self.audit.drives_after_safe() == drives;
                }
                Ok(_) => {}
                Err(error) => {
                    debug!(%error, "the request for 0 V failed");
                    return false;
                }
            }
        }
        false
    }

    /// True if the controller commanded a drive after it confirmed 0 V, even in the same read.
    pub fn has_driven_after_safe(&self) -> bool {
        self.audit.drives_after_safe().is_some()
    }

    /// Reads the line after the controller confirmed 0 V, for at least 20 ms and 10 control periods
    /// of the target's time, or for 20 ms after a cancellation. Requests 0 V again if the controller
    /// commanded a drive. Returns the commands with a drive since the last call.
    pub fn observe_safe_state(&mut self) -> Option<DrivesAfterSafe> {
        let duration = MIN_OBSERVATION.max(self.period * OBSERVED_PERIODS);
        let is_simulated = self.link.kind() == LinkKind::Simulated;
        let (start, started) = (self.now, Instant::now());
        let mut elapsed = Duration::ZERO;
        while elapsed < if self.cancel.is_cancelled() { MIN_OBSERVATION } else { duration } {
            if is_simulated {
                elapsed += duration / OBSERVATION_STEPS + Duration::from_nanos(1);
            } else {
                thread::sleep(OBSERVATION_POLL_INTERVAL);
                elapsed = started.elapsed();
            }
            if self.advance_to(start + elapsed).is_err() {
                break;
            }
        }
        let drives = self.audit.take_drives_after_safe();
        if drives.is_some() {
            self.request_safe_state();
        }
        drives
    }

    /// Requests 0 V and observes whether the controller stays there.
    pub fn close(mut self) -> SafeEnd {
        self.is_closed = true;
        self.rest()
    }

    /// As [`Session::close`], for a session that continues.
    pub fn rest(&mut self) -> SafeEnd {
        let was_safe = self.audit.is_safe();
        // A program that ended after it confirmed 0 V cannot confirm it again.
        let confirmed = self.request_safe_state() || (was_safe && self.has_ended);
        let drives = if confirmed { self.observe_safe_state() } else { self.audit.take_drives_after_safe() };
        match (drives, confirmed) {
            (Some(drives), _) => SafeEnd::Driven(drives),
            (None, true) => SafeEnd::Confirmed,
            (None, false) => SafeEnd::Unconfirmed,
        }
    }

    pub fn supports_real_time(&mut self) -> bool {
        self.link.real_time_line().is_some()
    }

    /// Call it before a trial in real time, on the thread of the trial loop.
    pub fn start_line(&mut self) -> Result<(), RigError> {
        let started = self.link.real_time_line().ok_or(RigError::NoRealTime)?.start();
        self.check_link(started)
    }

    /// Returns the time of the line's clock.
    pub fn line_time(&mut self) -> Instant {
        self.link.real_time_line().map_or_else(Instant::now, RealTimeLine::now)
    }

    /// Does not wait for the answer. Returns the sequence number. Neither allocates nor logs.
    pub fn send(&mut self, message: Message) -> Result<u8, RigError> {
        let frame = Packet { sequence: self.sequence.wrapping_add(1), message }.encode();
        let sent = self.link.real_time_line().ok_or(RigError::NoRealTime)?.send(frame.as_bytes());
        self.check_link(sent)?;
        Ok(self.next_sequence(&message))
    }

    /// Waits for one message in real time. Counts invalid frames. Neither allocates nor logs.
    pub fn receive(&mut self, until: Instant) -> Result<Option<ReceivedMessage>, RigError> {
        let mut is_over = false;
        loop {
            if let Some(Packet { sequence, message }) = self.next_packet()? {
                return Ok(Some(ReceivedMessage { received_at: self.received_at, sequence, message }));
            }
            if is_over {
                return Ok(None);
            }
            self.discard_consumed();
            let line = self.link.real_time_line().ok_or(RigError::NoRealTime)?;
            let received = line.receive(until, &mut self.bytes);
            let Some(arrived) = self.check_link(received)? else { return Ok(None) };
            self.received_at = arrived;
            // Ends the wait even if bytes arrive without a pause.
            is_over = arrived >= until;
        }
    }

    pub fn rejected_frames(&self) -> u64 {
        self.rejected_frames
    }

    /// The error of a silent controller. It names the first rejected frame, because a controller
    /// whose messages have a wrong layout looks silent.
    pub fn no_answer(&self, expected: &'static str) -> RigError {
        match self.frames.first() {
            Some(frame) => RigError::RejectedAnswer { expected, frame },
            None => RigError::NoAnswer { expected },
        }
    }

    pub fn first_rejected_frame(&self) -> Option<RejectedFrame> {
        self.frames.first()
    }

    /// Number of commands that differ from an earlier answer to the same message. Repeated frames
    /// do not count. Reports of a stop do not count either, although they have the number of the
    /// last command, and confirmations of 0 V without a request have their own count.
    pub fn contradictions(&self) -> u64 {
        self.audit.contradictions
    }

    pub fn second_replies(&self) -> u64 {
        self.audit.second_replies
    }

    /// Number of replies with a sequence number that was not sent yet.
    pub fn wrong_sequences(&self) -> u64 {
        self.audit.wrong_sequences
    }

    /// Number of requests for 0 V that were answered with the state *running* or with a drive.
    pub fn ignored_safe_requests(&self) -> u64 {
        self.audit.ignored_safe_requests
    }

    /// Number of commands in the state *safe* without a request for 0 V, or under the number of a
    /// sample that has another answer.
    pub fn unrequested_confirmations(&self) -> u64 {
        self.audit.unrequested_confirmations
    }

    /// Number of messages that no request caused, besides reports of a stop and the ticks and telemetry
    /// that the configuration allows.
    pub fn unrequested_messages(&self) -> u64 {
        self.audit.unrequested_messages
    }

    /// Numbers wrap, so the audit forgets the answer to the earlier message with this number.
    fn next_sequence(&mut self, message: &Message) -> u8 {
        self.sequence = self.sequence.wrapping_add(1);
        self.audit.record_sent(self.sequence, message);
        self.frames.record_request(message);
        self.sequence
    }

    fn request(&mut self, message: Message) -> Result<Option<(Message, Duration)>, RigError> {
        let sequence = self.next_sequence(&message);
        self.discard_consumed();
        let packet = Packet { sequence, message };
        let answer = match self.answer_without_bytes(&packet) {
            Some(answer) => Some((self.check_link(answer)?, Duration::ZERO)),
            None => self.exchange_bytes(&packet)?,
        };
        if answer.is_some() {
            self.last_command_sequence = sequence;
        }
        Ok(answer)
    }

    /// `None` if the sample must pass as bytes.
    fn answer_without_bytes(&mut self, packet: &Packet) -> Option<Result<Message, LinkError>> {
        if !matches!(packet.message, Message::Sample(_)) || self.transport == Transport::Words {
            return None;
        }
        let is_checked = self.transport == Transport::BlocksAndWords;
        let answer = self.link.answer_sample(self.now, packet, is_checked)?;
        Some(answer.map(|answer| {
            self.audit.record(packet.sequence, &answer);
            self.pending_command = None;
            answer.message
        }))
    }

    fn exchange_bytes(&mut self, packet: &Packet) -> Result<Option<(Message, Duration)>, RigError> {
        let sequence = packet.sequence;
        let frame = packet.encode();
        let exchanged = self.link.exchange(self.now, frame.as_bytes(), &mut self.bytes);
        let delay = self.check_link(exchanged)?;
        let (mut answer, mut other) = (None, self.pending_command.take());
        let filter = self.command_filter();
        self.read_packets(|packet| {
            if packet.sequence == sequence && !packet.message.is_unsolicited() {
                // The first answer counts, as in real time, but a stop after it takes its place.
                if answer.is_none() || is_stop(&packet.message) {
                    answer = Some((packet.message, delay));
                }
            } else {
                other = filter.new_command(packet).or(other);
            }
        })?;
        self.pending_command = other.filter(|_| answer.is_none());
        Ok(answer)
    }

    /// Reads what arrived before a request, so that it cannot count as the answer.
    fn receive_before_request(&mut self) -> Result<(), RigError> {
        self.discard_consumed();
        let advanced = self.link.advance_to(self.now, &mut self.bytes);
        self.check_link(advanced)?;
        let (mut last, filter) = (self.pending_command.take(), self.command_filter());
        self.read_packets(|packet| last = filter.new_command(packet).or(last))?;
        self.pending_command = last;
        Ok(())
    }

    /// The end of a program after it confirmed 0 V is not its failure.
    fn check_link<T>(&mut self, result: Result<T, LinkError>) -> Result<T, RigError> {
        result.map_err(|error| match error {
            LinkError::Ended(how) => {
                self.has_ended = true;
                if self.audit.is_safe() {
                    return LinkError::Disconnected(how).into();
                }
                self.ended_before_safe = Some(how.clone());
                LinkError::Ended(how).into()
            }
            error => error.into(),
        })
    }

    fn command_filter(&self) -> CommandFilter {
        CommandFilter { last_sent: self.sequence, last_command: self.last_command_sequence }
    }

    fn read_packets(&mut self, mut handle: impl FnMut(&Packet)) -> Result<(), RigError> {
        let before = self.rejected_frames;
        while let Some(packet) = self.next_packet()? {
            handle(&packet);
        }
        if self.rejected_frames > before {
            debug!(frames = self.rejected_frames - before, "frames from the controller rejected");
        }
        Ok(())
    }

    fn next_packet(&mut self) -> Result<Option<Packet>, RigError> {
        while let Some(mut rest) = self.bytes.get(self.consumed..).filter(|rest| !rest.is_empty()) {
            let packet = self.reader.read(&mut rest);
            let start = std::mem::replace(&mut self.consumed, self.bytes.len() - rest.len());
            self.frames.record_part(self.bytes.get(start..self.consumed).unwrap_or_default());
            if let Some(read) = &packet {
                self.frames.end_frame(read.is_err());
            }
            match packet {
                None => {}
                Some(Err(_)) => self.rejected_frames += 1,
                Some(Ok(Packet { message: Message::Fault(report), .. })) => return Err(RigError::Trapped(report)),
                Some(Ok(packet)) if self.detects_clients && self.audit.is_unrequested_setup(&packet) => {
                    self.detects_clients = false;
                    return Err(RigError::OtherClient);
                }
                Some(Ok(packet)) => {
                    self.audit.record(self.sequence, &packet);
                    return Ok(Some(packet));
                }
            }
        }
        Ok(None)
    }

    fn discard_consumed(&mut self) {
        if self.consumed >= self.bytes.len() {
            self.bytes.clear();
            self.consumed = 0;
        }
    }
}

fn is_stop(message: &Message) -> bool {
    matches!(message, Message::Command(Command { state: ControllerState::Fault, .. }))
}

/// Replaces all but printable ASCII, because a terminal might interpret other bytes.
pub fn printable_name(identity: &Identity) -> String {
    let name = identity.name.split(|&byte| byte == 0).next().unwrap_or_default();
    let printable = |&byte: &u8| matches!(byte, b' '..=b'~');
    name.iter().map(|byte| if printable(byte) { char::from(*byte) } else { char::REPLACEMENT_CHARACTER }).collect()
}

#[derive(Clone, Copy)]
struct CommandFilter {
    last_sent: u8,
    last_command: u8,
}

impl CommandFilter {
    /// Returns the packet's command if it is newer than the last command, or reports a stop under
    /// the same number.
    fn new_command(self, packet: &Packet) -> Option<(u8, Command)> {
        let Message::Command(command) = packet.message else { return None };
        let [age, known] = [packet.sequence, self.last_command].map(|number| self.last_sent.wrapping_sub(number));
        let is_new = age < known || (age == known && command.state != ControllerState::Running);
        is_new.then_some((packet.sequence, command))
    }
}

impl<L: Link> Drop for Session<L> {
    fn drop(&mut self) {
        if !self.is_closed && !self.request_safe_state() && self.has_identity {
            warn!("the controller did not confirm 0 V at the end of the session");
        }
    }
}

#[cfg(test)]
mod tests;
