//! Any controller program, with its serial line on a pseudo-terminal.
//!
//! ```text
//!   bench ── master ═ pseudo-terminal ═ slave ── program, which opens {port} as it would /dev/ttyUSB0
//! ```
//!
//! The program gets a process group of its own, so that Ctrl-C reaches the bench alone, which then sees to 0 V; nothing on its standard input; and its
//! standard output goes to the bench's standard error, because the bench's own output is somebody's JSON. It is ended in three steps, each bounded: the line hangs up, SIGTERM,
//! SIGKILL. A bench that is killed leaves a line that hung up, and the program's own watchdog does the rest.

use crate::link::{Line, Link, LinkError};
use crate::port::Port;
use platebench_wire::{Message, Packet};
use rustix::fd::{AsFd, OwnedFd};
use rustix::fs::{Mode, OFlags};
use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, WaitIdStatus, kill_process_group, waitid};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tracing::{debug, warn};

/// What stands for the port's path in a command.
const PLACE: &str = "{port}";
/// A program that has not introduced itself by then is not going to.
const HANDSHAKE_WITHIN: Duration = Duration::from_secs(5);
/// A program that flushes its port when it opens it loses what was said before.
const HANDSHAKE_EVERY: Duration = Duration::from_millis(100);
/// How long a program has to end once its line has hung up, and again after SIGTERM.
const GRACE: Duration = Duration::from_millis(500);
/// Between two looks at whether it has ended.
const LOOK_EVERY: Duration = Duration::from_millis(5);
/// A line can hang up a moment before its program is seen to have ended.
const ENDED_WITHIN: Duration = Duration::from_millis(50);

/// Why there is no program to work with.
#[derive(Debug, thiserror::Error)]
pub enum ExecError {
    /// The command is not one.
    #[error("`{0}` cannot be split into words: a quote or a backslash is left open")]
    Quoting(String),
    /// There is nothing to start.
    #[error("`{0}` names no program")]
    Empty(String),
    /// The program would not know where its line is.
    #[error("`{0}` has no {{port}}, which is where the path of the controller's serial port goes")]
    NoPlace(String),
    /// The program could not be started.
    #[error("cannot start `{program}`: {error}")]
    Start {
        /// Its name or path.
        program: String,
        /// Why not.
        error: std::io::Error,
    },
    /// There is no pseudo-terminal to be had.
    #[error("no pseudo-terminal: {0}")]
    Terminal(std::io::Error),
    /// It ended instead of introducing itself.
    #[error("`{program}` {how} before it introduced itself")]
    Ended {
        /// Its name or path.
        program: String,
        /// Exit status or signal.
        how: String,
    },
    /// It runs but says nothing.
    #[error("`{program}` runs, but did not introduce itself on {port} within {} s", HANDSHAKE_WITHIN.as_secs())]
    Silent {
        /// Its name or path.
        program: String,
        /// Where it should have been heard.
        port: String,
    },
    /// The line failed.
    #[error(transparent)]
    Link(#[from] LinkError),
}

/// The words of a command, not filled in yet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Words(Vec<String>);

impl Words {
    /// Splits `command` as a shell would, without being one.
    pub(crate) fn of(command: &str) -> Result<Self, ExecError> {
        let words = shlex::split(command).ok_or_else(|| ExecError::Quoting(command.to_owned()))?;
        if words.first().is_none_or(String::is_empty) {
            return Err(ExecError::Empty(command.to_owned()));
        }
        if !words.iter().skip(1).any(|word| word.contains(PLACE)) {
            return Err(ExecError::NoPlace(command.to_owned()));
        }
        Ok(Self(words))
    }

    fn program(&self) -> &str {
        self.0.first().map_or("", String::as_str)
    }

    fn arguments(&self, port: &str) -> impl Iterator<Item = String> {
        self.0.iter().skip(1).map(move |word| word.replace(PLACE, port))
    }
}

/// A controller program that has introduced itself.
#[derive(Debug)]
pub struct Exec {
    // Declared before `program`: fields are dropped in this order, so the line hangs up first.
    port: Port<OwnedFd>,
    program: Program,
}

impl Exec {
    /// Starts `command`, in which `{port}` stands for the path of the controller's serial port, and waits until the program introduces itself.
    ///
    /// # Errors
    /// [`ExecError`].
    pub fn start(command: &str) -> Result<Self, ExecError> {
        let words = Words::of(command)?;
        let (master, slave, name) = pseudo_terminal().map_err(|error| ExecError::Terminal(error.into()))?;
        let program = Program::start(&words, &name)?;
        let mut exec = Self { port: master, program };
        exec.come_up(&name)?;
        // From here on the line hangs up with the program.
        drop(slave);
        Ok(exec)
    }

    /// The program's process.
    pub fn process_id(&self) -> u32 {
        self.program.child.id()
    }

    fn come_up(&mut self, name: &str) -> Result<(), ExecError> {
        let hello = Packet { sequence: 0, message: Message::Hello }.encode();
        let deadline = Instant::now() + HANDSHAKE_WITHIN;
        let mut answer = Vec::new();
        while Instant::now() < deadline {
            let since = Instant::now();
            answer.clear();
            let waited = self.port.exchange(hello.as_bytes(), &mut answer)?;
            let mut reader = platebench_wire::FrameReader::new();
            let said = answer.iter().any(|&byte| {
                matches!(reader.push(byte), Some(Ok(body)) if matches!(Packet::decode(body), Ok(Packet { message: Message::Identity(_), .. })))
            });
            if said {
                debug!(?waited, pid = self.program.child.id(), "program came up");
                return Ok(());
            }
            if let Some(how) = self.program.ended(Duration::ZERO) {
                return Err(ExecError::Ended { program: self.program.name.clone(), how });
            }
            // An echo or babble came at once.
            std::thread::sleep(HANDSHAKE_EVERY.saturating_sub(since.elapsed()));
        }
        Err(ExecError::Silent { program: self.program.name.clone(), port: name.to_owned() })
    }

    /// Does `what` with the line; where that is gone, says what became of the program.
    fn with_port<T>(&mut self, what: impl FnOnce(&mut Port<OwnedFd>) -> Result<T, LinkError>) -> Result<T, LinkError> {
        what(&mut self.port).map_err(|error| match (error, self.program.ended(ENDED_WITHIN)) {
            (LinkError::Disconnected(_), Some(how)) => {
                LinkError::Disconnected(format!("`{}` {how}", self.program.name))
            }
            (LinkError::Disconnected(_), None) => {
                LinkError::Disconnected(format!("`{}` runs, but has closed its port", self.program.name))
            }
            (error, _) => error,
        })
    }
}

/// Our end, the program's end, and its path.
pub(crate) fn pseudo_terminal() -> rustix::io::Result<(Port<OwnedFd>, OwnedFd, String)> {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
    grantpt(&master)?;
    unlockpt(&master)?;
    let name = ptsname(&master, Vec::new())?;
    // Kept open until the program has it open, since a line without anybody at its other end counts as hung up.
    let slave = rustix::fs::open(&name, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())?;
    let mut settings = tcgetattr(&slave)?;
    settings.make_raw();
    tcsetattr(&slave, OptionalActions::Now, &settings)?;
    Ok((Port::of_file(master)?, slave, name.to_string_lossy().into_owned()))
}

/// A started program; dropping it ends its whole process group.
#[derive(Debug)]
struct Program {
    name: String,
    child: Child,
}

impl Program {
    fn start(words: &Words, port: &str) -> Result<Self, ExecError> {
        let refused = |error| ExecError::Start { program: words.program().to_owned(), error };
        let output = std::io::stderr().as_fd().try_clone_to_owned().map_err(refused)?;
        let mut command = Command::new(words.program());
        command.args(words.arguments(port)).process_group(0).stdin(Stdio::null()).stdout(output);
        let child = command.spawn().map_err(refused)?;
        Ok(Self { name: words.program().to_owned(), child })
    }

    fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    /// How it ended, where it does within `patience`. It stays a zombie, so that its number and its group's stay its own.
    fn ended(&self, patience: Duration) -> Option<String> {
        let deadline = Instant::now() + patience;
        let options = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
        loop {
            match waitid(WaitId::Pid(self.pid()), options) {
                Ok(Some(status)) => return Some(how(&status)),
                Ok(None) if Instant::now() < deadline => std::thread::sleep(LOOK_EVERY),
                Ok(None) => return None,
                Err(error) => return Some(format!("is gone ({error})")),
            }
        }
    }

    fn signal(&self, signal: Signal) {
        if let Err(error) = kill_process_group(self.pid(), signal) {
            debug!(?signal, %error, "the program's group was not signalled");
        }
    }
}

fn how(status: &WaitIdStatus) -> String {
    match (status.exit_status(), status.terminating_signal()) {
        (Some(code), _) => format!("ended with exit status {code}"),
        (None, Some(signal)) => format!("was ended by signal {signal}"),
        (None, None) => "ended".to_owned(),
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let mut ended = self.ended(GRACE);
        if ended.is_none() {
            warn!(program = self.name, "still runs after its line hung up, gets SIGTERM");
            self.signal(Signal::TERM);
            ended = self.ended(GRACE);
        }
        if ended.is_none() {
            warn!(program = self.name, "still runs after SIGTERM, gets SIGKILL");
        }
        // Whatever it left behind in its group goes too. Its number is its own until it is waited for.
        self.signal(Signal::KILL);
        if let Some(how) = ended.or_else(|| self.ended(GRACE)) {
            debug!(program = self.name, how, status = ?self.child.wait(), "program ended");
        } else {
            // Stuck in the kernel: not waited for, or the bench would be stuck too.
            warn!(program = self.name, pid = self.child.id(), "still runs after SIGKILL, left behind");
        }
    }
}

impl Link for Exec {
    fn exchange(&mut self, _now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.with_port(|port| port.exchange(bytes, answer))
    }

    fn pass(&mut self, _now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.with_port(|port| port.pass(said))
    }

    fn line(&mut self) -> Option<&mut dyn Line> {
        Some(self)
    }
}

impl Line for Exec {
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
    fn a_command_is_split_as_a_shell_would() {
        let words = Words::of("python3 'my controller.py' --port={port} \"{port}\" a\\ b").unwrap();
        assert_eq!(words.program(), "python3");
        let arguments: Vec<_> = words.arguments("/dev/pts/7").collect();
        assert_eq!(arguments, ["my controller.py", "--port=/dev/pts/7", "/dev/pts/7", "a b"]);
    }

    #[test]
    fn a_command_without_port_program_or_closing_quote_is_refused() {
        assert!(matches!(Words::of("true"), Err(ExecError::NoPlace(_))));
        assert!(matches!(Words::of("{port}"), Err(ExecError::NoPlace(_))));
        assert!(matches!(Words::of("  "), Err(ExecError::Empty(_))));
        assert!(matches!(Words::of("'' {port}"), Err(ExecError::Empty(_))));
        assert!(matches!(Words::of("a '{port}"), Err(ExecError::Quoting(_))));
    }

    /// True while a process of that number is there and no zombie.
    fn lives(pid: &str) -> bool {
        let status = std::fs::read_to_string(format!("/proc/{}/stat", pid.trim())).unwrap_or_default();
        status.rsplit_once(')').is_some_and(|(_, rest)| !rest.trim_start().starts_with('Z'))
    }

    fn script(folder: &tempfile::TempDir, text: &str) -> (Program, Vec<String>) {
        let said = folder.path().join("pids");
        let program = Program::start(&Words::of(&format!("sh -c '{text}' {} {{port}}", said.display())).unwrap(), "x");
        let deadline = Instant::now() + Duration::from_secs(10);
        loop {
            let pids = std::fs::read_to_string(&said).unwrap_or_default();
            if pids.ends_with("done\n") {
                return (program.unwrap(), pids.lines().filter(|line| *line != "done").map(str::to_owned).collect());
            }
            assert!(Instant::now() < deadline, "the script does not come up");
            std::thread::sleep(LOOK_EVERY);
        }
    }

    #[test]
    fn a_program_that_ignores_everything_is_ended_with_all_that_it_started() {
        let folder = tempfile::tempdir().unwrap();
        let text = r#"trap "" TERM HUP; sleep 60 & echo $$ >"$0"; echo $! >>"$0"; echo done >>"$0"; while :; do sleep 1; done"#;
        let (program, pids) = script(&folder, text);
        assert_eq!(pids.len(), 2);
        assert!(pids.iter().all(|pid| lives(pid)));
        drop(program);
        // What it started is nobody's child that could be waited for: the kernel takes its time over a killed process.
        let deadline = Instant::now() + Duration::from_secs(10);
        while pids.iter().any(|pid| lives(pid)) {
            assert!(Instant::now() < deadline, "{pids:?}");
            std::thread::sleep(LOOK_EVERY);
        }
    }

    #[test]
    fn a_program_that_heeds_sigterm_is_not_killed() {
        let folder = tempfile::tempdir().unwrap();
        let text = r#"trap "echo heard >>\"$0\"; exit 0" TERM; echo done >"$0"; while :; do sleep 0.01; done"#;
        let (program, _) = script(&folder, text);
        drop(program);
        assert!(std::fs::read_to_string(folder.path().join("pids")).unwrap().ends_with("heard\n"));
    }
}
