//! Starts a controller program and exchanges messages with it over a pseudo-terminal. In the
//! command, `{port}` stands for the path of this terminal. The program runs in its own process
//! group, so that Ctrl-C reaches only the bench, which then requests 0 V. The program's output goes
//! to the bench's standard error, because the bench's standard output may be JSON. To end the
//! program, the bench hangs up the line, then sends SIGTERM, then SIGKILL. If the bench is killed,
//! the kernel hangs up the line and the program's own watchdog acts.

mod program;

use crate::cancel::CancelToken;
use crate::factory::{Argument, Capability, ConnectError, ConnectOptions, Rig, RigFactory, RigProperties};
use crate::link::{BoxedLink, Link, LinkError, LinkKind, RealTimeLine};
use crate::port::{Port, open_pseudo_terminal};
use platebench_wire::{FrameError, Message, Packet, PacketError, PacketReader};
use program::Program;
use rustix::fd::OwnedFd;
use std::time::{Duration, Instant};
use tracing::debug;

pub(super) const RIG: RigFactory = RigFactory {
    name: "exec",
    argument: Argument::Required("COMMAND"),
    help: "a program that the bench starts; {port} in COMMAND is the path of its serial port",
    // A program of the user may drive a plate, so it counts as hardware.
    capabilities: &[Capability::ParallelLinks, Capability::RealPlate],
    parse: |command| Ok(Box::new(ExecRig { command: command.unwrap_or_default().to_owned() })),
};

#[derive(Debug)]
struct ExecRig {
    command: String,
}

impl Rig for ExecRig {
    fn properties(&self) -> RigProperties {
        let command = shlex::split(&self.command).unwrap_or_default();
        RigProperties { command, ..RigProperties::default() }
    }

    fn check(&self) -> Result<(), ConnectError> {
        Ok(CommandLine::parse(&self.command).map(drop)?)
    }

    fn open(&self, options: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        Ok(Box::new(ExecLink::start_with(&self.command, options)?))
    }
}

const PORT_PLACEHOLDER: &str = "{port}";
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);
/// The hello is repeated, because a program that flushes its port at its start loses earlier ones.
const HANDSHAKE_INTERVAL: Duration = Duration::from_millis(100);
/// Longest wait for the program's exit status after its line hung up. A program may close its port
/// and take some time to end, above all on a busy computer.
const EXIT_DETECTION_TIMEOUT: Duration = Duration::from_secs(2);

#[derive(Debug, thiserror::Error)]
pub enum ExecError {
    #[error("`{0}` cannot be split into words; close its quotes and escape a backslash at its end")]
    Quoting(String),
    #[error("`{0}` contains no program, expected a program and its arguments")]
    Empty(String),
    #[error("`{0}` has no {{port}}, the placeholder for the path of the controller's serial port")]
    NoPortPlaceholder(String),
    #[error("cannot start `{program}`: {error}{}", folder_hint(program))]
    Start { program: String, error: std::io::Error },
    #[error("cannot open a pseudo-terminal: {0}")]
    Terminal(std::io::Error),
    #[error("`{program}` {how} before the handshake")]
    Exited { program: String, how: String },
    #[error(
        "`{program}` runs, but did not answer the handshake on {port} within {} s{}",
        HANDSHAKE_TIMEOUT.as_secs(),
        rejected_hint(*rejected)
    )]
    NoAnswer {
        program: String,
        port: String,
        /// Number of rejected frames that the program sent, and the error of the last one.
        rejected: Option<(u32, PacketError)>,
    },
    #[error("cancelled while waiting for the handshake of `{0}`")]
    Cancelled(String),
    #[error(transparent)]
    Link(#[from] LinkError),
}

fn rejected_hint(rejected: Option<(u32, PacketError)>) -> String {
    let Some((count, last)) = rejected else { return String::new() };
    let problem = match last {
        PacketError::Frame(FrameError::Checksum) => "a wrong CRC",
        PacketError::Frame(FrameError::InvalidCobs) => "invalid COBS",
        PacketError::Frame(FrameError::Overlong) => "no end within the length of a frame",
        PacketError::Frame(FrameError::Truncated) => "no room for a CRC",
        PacketError::Message(_) => "a message that the protocol does not have",
    };
    format!("; {count} of its frames were rejected, the last one has {problem}")
}

/// A program without a folder is searched in PATH only.
fn folder_hint(program: &str) -> String {
    let is_here = !program.contains('/') && std::path::Path::new(program).is_file();
    if is_here { format!("; a program in the working directory is `./{program}`") } else { String::new() }
}

impl From<ExecError> for ConnectError {
    fn from(error: ExecError) -> Self {
        let is_invalid = matches!(
            error,
            ExecError::Quoting(_) | ExecError::Empty(_) | ExecError::NoPortPlaceholder(_) | ExecError::Start { .. }
        );
        Self::new(error, is_invalid)
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct CommandLine(Vec<String>);

impl CommandLine {
    /// Splits `command` into words like a shell, but expands no variables or file name patterns.
    fn parse(command: &str) -> Result<Self, ExecError> {
        let words = shlex::split(command).ok_or_else(|| ExecError::Quoting(command.to_owned()))?;
        if words.first().is_none_or(String::is_empty) {
            return Err(ExecError::Empty(command.to_owned()));
        }
        if !words.iter().skip(1).any(|word| word.contains(PORT_PLACEHOLDER)) {
            return Err(ExecError::NoPortPlaceholder(command.to_owned()));
        }
        Ok(Self(words))
    }

    fn program(&self) -> &str {
        self.0.first().map_or("", String::as_str)
    }

    fn arguments(&self, port: &str) -> impl Iterator<Item = String> {
        self.0.iter().skip(1).map(move |word| word.replace(PORT_PLACEHOLDER, port))
    }
}

#[derive(Debug)]
pub struct ExecLink {
    // Declared, and so dropped, before `program`: the line must hang up before the program ends.
    port: Port<OwnedFd>,
    program: Program,
}

impl ExecLink {
    pub fn start(command: &str) -> Result<Self, ExecError> {
        Self::start_with(command, &ConnectOptions::default())
    }

    pub fn start_with(command: &str, options: &ConnectOptions) -> Result<Self, ExecError> {
        let words = CommandLine::parse(command)?;
        let (master, slave, name) = open_pseudo_terminal().map_err(|error| ExecError::Terminal(error.into()))?;
        let program = Program::start(words.program(), words.arguments(&name), &name)
            .map_err(|error| ExecError::Start { program: words.program().to_owned(), error })?;
        let mut exec = Self { port: master.with_reply_timeout(options.reply_timeout), program };
        exec.port.expect_silence();
        exec.wait_for_handshake(&name, &options.cancel)?;
        // Without this handle of the bench, the line hangs up when the program ends.
        drop(slave);
        Ok(exec)
    }

    pub fn process_id(&self) -> u32 {
        self.program.process_id()
    }

    fn wait_for_handshake(&mut self, name: &str, cancel: &CancelToken) -> Result<(), ExecError> {
        let hello = Packet { sequence: 0, message: Message::Hello }.encode();
        let deadline = Instant::now() + HANDSHAKE_TIMEOUT;
        let mut answer = Vec::new();
        let mut rejected = None;
        while Instant::now() < deadline {
            let asked = Instant::now();
            answer.clear();
            let delay = self.port.exchange(Duration::ZERO, hello.as_bytes(), &mut answer)?;
            for packet in PacketReader::new().packets(&answer) {
                match packet {
                    Ok(Packet { message: Message::Identity(_), .. }) => {
                        debug!(?delay, pid = self.program.process_id(), "program started");
                        return Ok(());
                    }
                    Ok(_) => {}
                    Err(error) => rejected = Some((rejected.map_or(1, |(count, _)| count + 1), error)),
                }
            }
            if cancel.is_cancelled() {
                return Err(ExecError::Cancelled(self.program.name().to_owned()));
            }
            if let Some(how) = self.program.wait_for_exit(Duration::ZERO) {
                return Err(ExecError::Exited { program: self.program.name().to_owned(), how });
            }
            // An echo of the hello ends the exchange before the interval is over.
            std::thread::sleep(HANDSHAKE_INTERVAL.saturating_sub(asked.elapsed()));
        }
        Err(ExecError::NoAnswer { program: self.program.name().to_owned(), port: name.to_owned(), rejected })
    }

    /// If the line is lost, the error says how the program ended.
    fn with_port<T>(&mut self, call: impl FnOnce(&mut Port<OwnedFd>) -> Result<T, LinkError>) -> Result<T, LinkError> {
        call(&mut self.port).map_err(|error| match (error, self.program.wait_for_exit(EXIT_DETECTION_TIMEOUT)) {
            (LinkError::Disconnected(_), Some(how)) => LinkError::Ended(format!("`{}` {how}", self.program.name())),
            (LinkError::Disconnected(_), None) => {
                LinkError::Disconnected(format!("`{}` still runs, but has closed its serial port", self.program.name()))
            }
            (error, _) => error,
        })
    }
}

impl Link for ExecLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.with_port(|port| port.exchange(now, bytes, answer))
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.with_port(|port| port.advance_to(now, received))
    }

    fn kind(&self) -> LinkKind {
        LinkKind::Lossless
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        Some(self)
    }
}

impl RealTimeLine for ExecLink {
    fn start(&mut self) -> Result<(), LinkError> {
        self.with_port(RealTimeLine::start)
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.with_port(|port| port.send(bytes))
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        self.with_port(|port| port.receive(until, bytes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splits_a_command_like_a_shell() {
        let words = CommandLine::parse("python3 'my controller.py' --port={port} \"{port}\" a\\ b").unwrap();
        assert_eq!(words.program(), "python3");
        let arguments: Vec<_> = words.arguments("/dev/pts/7").collect();
        assert_eq!(arguments, ["my controller.py", "--port=/dev/pts/7", "/dev/pts/7", "a b"]);
    }

    #[test]
    fn rejects_a_command_without_port_or_program() {
        assert!(matches!(CommandLine::parse("true"), Err(ExecError::NoPortPlaceholder(_))));
        assert!(matches!(CommandLine::parse("{port}"), Err(ExecError::NoPortPlaceholder(_))));
        assert!(matches!(CommandLine::parse("  "), Err(ExecError::Empty(_))));
        assert!(matches!(CommandLine::parse("'' {port}"), Err(ExecError::Empty(_))));
        assert!(matches!(CommandLine::parse("a '{port}"), Err(ExecError::Quoting(_))));
    }
}
