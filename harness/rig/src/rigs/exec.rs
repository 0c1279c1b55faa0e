//! Starts a controller program and exchanges messages with it over a pseudo-terminal. In the
//! command, `{port}` stands for the path of this terminal. The program runs in its own process
//! group, so that Ctrl-C reaches only the bench, which then requests 0 V. The program's output goes
//! escaped to the bench's standard error, because its standard output may be JSON. To end the
//! program, the bench hangs up the line, then sends SIGTERM, then SIGKILL. If the bench is killed,
//! the kernel hangs up the line and the program's own watchdog acts.

mod output;
mod program;

use crate::factory::{Argument, Capability, ConnectError, ConnectOptions, Rig, RigFactory, RigProperties};
use crate::handshake::{HANDSHAKE_TIMEOUT, handshake};
use crate::link::{BoxedLink, Link, LinkError, LinkKind, RealTimeLine};
use crate::port::{Port, open_pseudo_terminal};
use crate::rejected_bytes::RejectedBytes;
use crate::rig_error::RigError;
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
/// After this time without a byte, the bench asks whether the program has ended, because the line
/// does not hang up while another process holds it.
const SILENCE: Duration = Duration::from_millis(50);
/// Longest wait for the program's exit status after its line hung up. A program may close its port
/// and take some time to end, above all on a busy computer.
const EXIT_DETECTION_TIMEOUT: Duration = Duration::from_secs(2);

#[derive(Debug, thiserror::Error)]
pub enum ExecError {
    #[error("`{0}` cannot be split into words; close its quotes and escape a backslash at its end")]
    Quoting(String),
    #[error("`{0}` contains no program, expected a program and its arguments")]
    Empty(String),
    #[error("`{0}` has no argument with {{port}}, the placeholder for the path of the controller's serial port")]
    NoPortPlaceholder(String),
    #[error("cannot start `{program}`: {error}{}", folder_hint(program))]
    Start { program: String, error: std::io::Error },
    #[error("cannot open a pseudo-terminal: {0}")]
    Terminal(std::io::Error),
    #[error("`{program}` {how} before the handshake")]
    Exited { program: String, how: String },
    #[error(
        "`{program}` runs, but did not answer the handshake on {port} within {} s{rejected}",
        HANDSHAKE_TIMEOUT.as_secs()
    )]
    NoAnswer { program: String, port: String, rejected: RejectedBytes },
    #[error("cancelled while waiting for the handshake of `{0}`")]
    Cancelled(String),
    #[error("`{program}`: {error}")]
    Handshake { program: String, error: RigError },
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
    last_byte: Instant,
}

impl ExecLink {
    pub fn start(command: &str) -> Result<Self, ExecError> {
        Self::start_with(command, &ConnectOptions::default())
    }

    pub fn start_with(command: &str, options: &ConnectOptions) -> Result<Self, ExecError> {
        let words = CommandLine::parse(command)?;
        let (master, slave, name) = open_pseudo_terminal().map_err(|error| ExecError::Terminal(error.into()))?;
        let program = Program::start(words.program(), words.arguments(&name), &name, options.cancel.clone())
            .map_err(|error| ExecError::Start { program: words.program().to_owned(), error })?;
        let mut exec = Self { port: master.with_options(options), program, last_byte: Instant::now() };
        exec.port.expect_silence();
        exec.wait_for_handshake(&name)?;
        // Without this handle of the bench, the line hangs up when the program ends.
        drop(slave);
        Ok(exec)
    }

    pub fn process_id(&self) -> u32 {
        self.program.process_id()
    }

    fn wait_for_handshake(&mut self, name: &str) -> Result<(), ExecError> {
        let Self { port, program, .. } = self;
        let name_of = |program: &Program| program.name().to_owned();
        match handshake(port, HANDSHAKE_TIMEOUT, program.cancel(), || program.exit()) {
            Ok(_) => {
                debug!(pid = program.process_id(), "program started");
                Ok(())
            }
            Err(RigError::Cancelled) => Err(ExecError::Cancelled(name_of(program))),
            Err(RigError::Link(LinkError::Ended(how))) => Err(ExecError::Exited { program: name_of(program), how }),
            Err(RigError::NoIdentity { rejected, .. }) => {
                Err(ExecError::NoAnswer { program: name_of(program), port: name.to_owned(), rejected })
            }
            Err(error) => Err(ExecError::Handshake { program: name_of(program), error }),
        }
    }

    /// If the line is lost, the error says how the program ended.
    fn with_port<T>(&mut self, call: impl FnOnce(&mut Port<OwnedFd>) -> Result<T, LinkError>) -> Result<T, LinkError> {
        call(&mut self.port).map_err(|error| match error {
            LinkError::Disconnected(_) => match self.program.wait_for_exit(EXIT_DETECTION_TIMEOUT) {
                Some(how) => ended(&self.program, &how),
                None => LinkError::Disconnected(format!(
                    "`{}` still runs, but has closed its serial port",
                    self.program.name()
                )),
            },
            error => error,
        })
    }

    /// Fails if the program has ended. Call it if no answer came.
    fn check_exit(&self) -> Result<(), LinkError> {
        self.program.exit().map_or(Ok(()), |how| Err(ended(&self.program, &how)))
    }
}

fn ended(program: &Program, how: &str) -> LinkError {
    LinkError::Ended(format!("`{}` {how}", program.name()))
}

impl Link for ExecLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let delay = self.with_port(|port| port.exchange(now, bytes, answer))?;
        if self.port.is_silent() {
            self.check_exit()?;
        }
        Ok(delay)
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
        self.last_byte = Instant::now();
        self.with_port(RealTimeLine::start)
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.with_port(|port| port.send(bytes))
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        let received = self.with_port(|port| port.receive(until, bytes))?;
        if received.is_some() {
            self.last_byte = Instant::now();
        } else if self.last_byte.elapsed() > SILENCE {
            self.check_exit()?;
        }
        Ok(received)
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
