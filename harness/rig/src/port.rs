//! Exchanges messages over an open terminal and waits for answers. Opens pseudo-terminals, for a
//! program or for a controller that is started by hand.

use crate::cancel::{CANCEL_POLL_INTERVAL, CancelToken};
use crate::factory::ConnectOptions;
use crate::link::{Link, LinkError, LinkKind, RealTimeLine};
use crate::tty::{LineReader, Tty, disconnected};
use crate::wait_budget::WaitBudget;
use platebench_wire::{ControllerState, Message, PacketReader};
use rustix::fd::OwnedFd;
use rustix::fs::{Mode, OFlags};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use std::io;
use std::time::{Duration, Instant};

/// Longest time from a hello, a configuration or a sample to the answer. Answers usually arrive
/// earlier, even on a busy computer.
pub const DEFAULT_REPLY_TIMEOUT: Duration = Duration::from_millis(500);
/// Longest wait for the answer to another request, and for any answer while the line is silent.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(100);
/// Longest wait for the confirmation of 0 V after a cancellation. Other waits then end at once.
const CANCELLED_SAFE_TIMEOUT: Duration = Duration::from_secs(1);
/// Longest wait after a message that needs no answer.
const OPTIONAL_ANSWER_TIMEOUT: Duration = Duration::from_millis(1);
/// Smallest number of parts of a wait for an answer.
const WAIT_PARTS: u32 = 10;
const WRITE_TIMEOUT: Duration = Duration::from_millis(100);
const READ_CHUNK_BYTES: usize = 512;

#[derive(Debug)]
pub struct Port<T> {
    // Declared, and so dropped, before `terminal`: the line hangs up with its last handle.
    reader: Option<LineReader>,
    terminal: T,
    pending_requests: PendingRequests,
    reply_timeout: Duration,
    cancel: CancelToken,
    /// True from a missing answer to the next answer.
    is_silent: bool,
    kind: LinkKind,
}

impl Port<OwnedFd> {
    pub(crate) fn from_fd(file: OwnedFd) -> rustix::io::Result<Self> {
        rustix::io::ioctl_fionbio(&file, true)?;
        Ok(Self::new(file))
    }
}

impl<T: Tty> Port<T> {
    pub(crate) fn new(terminal: T) -> Self {
        Self {
            reader: None,
            terminal,
            pending_requests: PendingRequests::default(),
            reply_timeout: DEFAULT_REPLY_TIMEOUT,
            cancel: CancelToken::never(),
            is_silent: false,
            kind: LinkKind::Lossy,
        }
    }

    pub(crate) fn on_network(terminal: T) -> Self {
        Self { kind: LinkKind::Network, ..Self::new(terminal) }
    }

    /// A cancellation shortens the waits for answers.
    #[must_use]
    pub fn with_options(self, options: &ConnectOptions) -> Self {
        Self { reply_timeout: options.reply_timeout, cancel: options.cancel.clone(), ..self }
    }

    /// True if the last request had no answer.
    pub(crate) fn is_silent(&self) -> bool {
        self.is_silent
    }

    /// Uses `ANSWER_TIMEOUT` until the first answer, because the controller is still starting.
    pub(crate) fn expect_silence(&mut self) {
        self.is_silent = true;
    }

    /// After a missing answer, uses the shorter `ANSWER_TIMEOUT` until the next answer.
    fn answer_timeout(&self, request: Request) -> Duration {
        match request {
            Request::None => OPTIONAL_ANSWER_TIMEOUT,
            Request::Other => self.reply_timeout.min(ANSWER_TIMEOUT),
            Request::Sample | Request::Setup | Request::Safe if self.is_silent => {
                self.reply_timeout.min(ANSWER_TIMEOUT)
            }
            Request::Sample | Request::Setup | Request::Safe => self.reply_timeout,
        }
    }

    fn write(&mut self, mut bytes: &[u8], deadline: Instant) -> Result<(), LinkError> {
        while !bytes.is_empty() {
            match self.terminal.write(bytes, deadline)? {
                Some(written) => bytes = bytes.get(written..).unwrap_or_default(),
                None => return Ok(()),
            }
        }
        Ok(())
    }

    fn read(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        if let Some(reader) = &mut self.reader {
            return reader.read(until, bytes);
        }
        let mut chunk = [0; READ_CHUNK_BYTES];
        let Some(count) = self.terminal.read(&mut chunk, until)? else { return Ok(None) };
        let at = Instant::now();
        bytes.extend_from_slice(chunk.get(..count).unwrap_or_default());
        Ok(Some(at))
    }
}

impl<T: Tty> Link for Port<T> {
    fn exchange(&mut self, _now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let request = self.pending_requests.send(bytes);
        let start = Instant::now();
        self.write(bytes, start + WRITE_TIMEOUT)?;
        let timeout = self.answer_timeout(request);
        let mut budget = WaitBudget::with_parts(timeout, (timeout / WAIT_PARTS).min(CANCEL_POLL_INTERVAL));
        let mut read = answer.len();
        while let Some(until) = budget.next_part(Instant::now()) {
            if self.cancel.is_cancelled() {
                if request != Request::Safe {
                    return Ok(Duration::ZERO);
                }
                budget.shorten(CANCELLED_SAFE_TIMEOUT);
            }
            let arrived = self.read(until, answer)?;
            let Some(at) = arrived else { continue };
            let mut is_answered = false;
            for &byte in answer.get(read..).unwrap_or_default() {
                is_answered |= self.pending_requests.ends_wait(byte);
            }
            if is_answered {
                self.is_silent = false;
                return Ok(at.saturating_duration_since(start));
            }
            read = answer.len();
        }
        self.is_silent |= request != Request::None;
        Ok(Duration::ZERO)
    }

    fn advance_to(&mut self, _now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        let now = Instant::now();
        while self.read(now, received)?.is_some_and(|at| at < now + OPTIONAL_ANSWER_TIMEOUT) {}
        Ok(())
    }

    fn kind(&self) -> LinkKind {
        self.kind
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        Some(self)
    }
}

impl<T: Tty> RealTimeLine for Port<T> {
    fn start(&mut self) -> Result<(), LinkError> {
        if self.reader.is_none()
            && let Some(line) = self.terminal.for_reading()
        {
            self.reader = Some(LineReader::start(line).map_err(disconnected)?);
        }
        Ok(())
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.write(bytes, Instant::now())
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        self.read(until, bytes)
    }
}

/// Finds the answer that ends an exchange.
#[derive(Debug, Default)]
pub(crate) struct PendingRequests {
    requests: PacketReader,
    answers: PacketReader,
    /// Sequence number of the awaited answer; `None` if the last message needs no answer.
    expected: Option<u8>,
    request: Request,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum Request {
    #[default]
    None,
    Sample,
    Setup,
    Safe,
    Other,
}

impl PendingRequests {
    /// Returns the request in the last complete message of `bytes`.
    pub(crate) fn send(&mut self, bytes: &[u8]) -> Request {
        (self.expected, self.request) = (None, Request::None);
        for packet in self.requests.packets(bytes).flatten() {
            let request = match packet.message {
                Message::Sample(_) => Request::Sample,
                Message::Hello | Message::Configure(_) => Request::Setup,
                Message::Safe => Request::Safe,
                Message::Setpoint(_) => Request::Other,
                _ => continue,
            };
            (self.expected, self.request) = (Some(packet.sequence), request);
        }
        self.request
    }

    /// True if `byte` completes the expected answer, or a message after which no answer will come:
    /// a fault report, or a command in the state *running* with a number that was not sent yet.
    /// Ticks and telemetry do not count, because they have their own numbers.
    pub(crate) fn ends_wait(&mut self, byte: u8) -> bool {
        let (Some(Ok(packet)), Some(expected)) = (self.answers.push(byte), self.expected) else { return false };
        // Numbers wrap: 127 numbers after the expected one are ahead, the others are late.
        let is_ahead = (1..=u8::MAX / 2).contains(&packet.sequence.wrapping_sub(expected));
        match packet.message {
            Message::Fault(_) => true,
            Message::Command(command)
                if self.request == Request::Sample && command.state == ControllerState::Running && is_ahead =>
            {
                true
            }
            message => packet.sequence == expected && !message.is_unsolicited(),
        }
    }
}

/// Returns the bench's end in raw mode, the controller's end and its path.
pub(crate) fn open_pseudo_terminal() -> rustix::io::Result<(Port<OwnedFd>, OwnedFd, String)> {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
    grantpt(&master)?;
    unlockpt(&master)?;
    let name = ptsname(&master, Vec::new())?;
    // The bench opens this end itself, because the kernel reports a hang-up if the other end of a
    // line was never opened.
    let slave = rustix::fs::open(&name, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())?;
    let mut settings = tcgetattr(&slave)?;
    settings.make_raw();
    tcsetattr(&slave, OptionalActions::Now, &settings)?;
    Ok((Port::from_fd(master)?, slave, name.to_string_lossy().into_owned()))
}

/// Link to a controller that the user starts. Before that, the line is silent, not lost.
#[derive(Debug)]
pub struct PtyLink {
    port: Port<OwnedFd>,
    path: String,
    _other_end: OwnedFd,
}

impl PtyLink {
    pub fn open() -> io::Result<Self> {
        let (port, other_end, path) = open_pseudo_terminal()?;
        Ok(Self { port, path, _other_end: other_end })
    }

    pub fn path(&self) -> &str {
        &self.path
    }
}

impl Link for PtyLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.port.exchange(now, bytes, answer)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.port.advance_to(now, received)
    }

    fn kind(&self) -> LinkKind {
        LinkKind::Lossless
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        Some(&mut self.port)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_wire::{Command, Packet, Sample, StateCause};
    use rstest::rstest;

    const SAMPLE: Message = Message::Sample(Sample { time_us: 0, setpoint_um: 2.0, wd_um: 0.0, wq_um: 0.0 });

    const COMMAND: Command = Command {
        target_time_us: 0,
        drive_vpp: 1.0,
        frequency_mhz: 32_307_600,
        state: ControllerState::Running,
        cause: StateCause::None,
        flags: 0,
        compute_us: 0,
    };

    fn is_answered(request: Packet, answer: Packet) -> bool {
        let mut pending = PendingRequests::default();
        assert_ne!(pending.send(request.encode().as_bytes()), Request::None);
        answer.encode().as_bytes().iter().any(|&byte| pending.ends_wait(byte))
    }

    /// Answers the second read. Before that, the computer stands still until after the time-out.
    struct StalledTerminal {
        stall: Duration,
        answer: Vec<u8>,
        reads: u32,
    }

    impl Tty for StalledTerminal {
        fn read(&mut self, buffer: &mut [u8], until: Instant) -> Result<Option<usize>, LinkError> {
            self.reads += 1;
            if self.reads == 1 {
                std::thread::sleep(until.saturating_duration_since(Instant::now()) + self.stall);
                return Ok(None);
            }
            let answer = std::mem::take(&mut self.answer);
            buffer[..answer.len()].copy_from_slice(&answer);
            Ok((!answer.is_empty()).then_some(answer.len()))
        }

        fn write(&mut self, bytes: &[u8], _until: Instant) -> Result<Option<usize>, LinkError> {
            Ok(Some(bytes.len()))
        }
    }

    #[rstest]
    #[case::late_answer(Some(Message::Command(COMMAND)))]
    #[case::silence(None)]
    fn a_stall_of_the_computer_does_not_count(#[case] answer: Option<Message>) {
        let timeout = Duration::from_millis(20);
        let answer = answer.map(|message| Packet { sequence: 7, message }.encode().as_bytes().to_vec());
        let answer = answer.unwrap_or_default();
        let terminal = StalledTerminal { stall: 2 * timeout, answer: answer.clone(), reads: 0 };
        let options = ConnectOptions { reply_timeout: timeout, ..ConnectOptions::default() };
        let mut port = Port::new(terminal).with_options(&options);
        let sample = Packet { sequence: 7, message: SAMPLE }.encode();
        let mut received = Vec::new();
        port.exchange(Duration::ZERO, sample.as_bytes(), &mut received).unwrap();
        assert_eq!((&received, port.is_silent), (&answer, answer.is_empty()));
    }

    /// Terminal of a controller that never answers.
    struct SilentTerminal;

    impl Tty for SilentTerminal {
        fn read(&mut self, _: &mut [u8], until: Instant) -> Result<Option<usize>, LinkError> {
            std::thread::sleep(until.saturating_duration_since(Instant::now()));
            Ok(None)
        }

        fn write(&mut self, bytes: &[u8], _: Instant) -> Result<Option<usize>, LinkError> {
            Ok(Some(bytes.len()))
        }
    }

    /// Without the cancellation, the wait for the answer takes an hour.
    #[rstest]
    #[case::sample(SAMPLE)]
    #[case::hello(Message::Hello)]
    #[case::safe(Message::Safe)]
    fn a_cancellation_ends_the_wait_for_an_answer(#[case] message: Message) {
        let options = ConnectOptions { reply_timeout: Duration::from_hours(1), ..ConnectOptions::default() };
        let cancel = options.cancel.clone();
        let (sender, ended) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            let mut port = Port::new(SilentTerminal).with_options(&options);
            let frame = Packet { sequence: 1, message }.encode();
            sender.send(port.exchange(Duration::ZERO, frame.as_bytes(), &mut Vec::new()).is_ok())
        });
        cancel.cancel();
        assert_eq!(ended.recv_timeout(Duration::from_mins(1)), Ok(true), "the wait does not end");
    }

    #[rstest]
    #[case::equal(7, true)]
    #[case::next(8, true)]
    #[case::last_one_ahead(7 + 127, true)]
    #[case::first_one_behind(7 + 128, false)]
    #[case::previous(6, false)]
    fn a_number_ahead_ends_the_wait_for_a_command(#[case] sequence: u8, #[case] expected: bool) {
        let answer = Packet { sequence, message: Message::Command(COMMAND) };
        assert_eq!(is_answered(Packet { sequence: 7, message: SAMPLE }, answer), expected);
        // The confirmation of 0 V has the number of its request.
        assert_eq!(is_answered(Packet { sequence: 7, message: Message::Safe }, answer), sequence == 7);
        // A stopped controller may use any number, and only the expected one ends the wait.
        let stopped = Command { state: ControllerState::Safe, ..COMMAND };
        let answer = Packet { sequence, message: Message::Command(stopped) };
        assert_eq!(is_answered(Packet { sequence: 7, message: SAMPLE }, answer), sequence == 7);
    }
}
