//! QEMU's `netduinoplus2` with the image `qemu.elf`, on a Unix socket. Nothing waits without an end, and the child dies with its owner.

use platebench_wire::{Message, Packet, PacketReader};
use std::fs;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Once;
use std::time::{Duration, Instant};
use tempfile::TempDir;

const PROGRAM: &str = "qemu-system-arm";
const IMAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../firmware-under-test/images/qemu.elf");
const REQUIRE_ALL: &str = "PLATEBENCH_REQUIRE_ALL";
static WARN_ONCE: Once = Once::new();

/// Generous: a busy machine starts programs slowly.
const START_TIMEOUT: Duration = Duration::from_secs(30);
const ANSWER_TIMEOUT: Duration = Duration::from_secs(30);
const HELLO_INTERVAL: Duration = Duration::from_millis(200);
const POLL_INTERVAL: Duration = Duration::from_millis(10);

/// A running QEMU.
pub(crate) struct Qemu {
    child: Child,
    line: UnixStream,
    folder: TempDir,
}

/// Kills what it holds unless it is taken out.
struct ChildGuard(Option<Child>);

impl Drop for ChildGuard {
    fn drop(&mut self) {
        if let Some(child) = &mut self.0 {
            kill_and_wait(child);
        }
    }
}

fn kill_and_wait(child: &mut Child) {
    let _ = child.kill();
    let _ = child.wait();
}

impl Qemu {
    /// A fresh machine; `None`, with a line that nobody can miss, where QEMU is not installed and nobody insists.
    pub(crate) fn start_if_installed() -> Option<Self> {
        let version = Command::new(PROGRAM).arg("--version").stdin(Stdio::null()).output();
        match version {
            Ok(_) => Some(Self::start().unwrap()),
            Err(error) if error.kind() == ErrorKind::NotFound => {
                let all = std::env::var(REQUIRE_ALL).is_ok_and(|value| value == "1");
                assert!(!all, "{PROGRAM} is not installed and {REQUIRE_ALL}=1: ci/install-test-tools");
                // Not by `eprintln!`, which the test harness keeps to itself while a test passes.
                WARN_ONCE.call_once(|| {
                    let _ = writeln!(std::io::stderr(), "left out: {PROGRAM} is not installed (ci/install-test-tools)");
                });
                None
            }
            Err(error) => panic!("{PROGRAM}: {error}"),
        }
    }

    fn start() -> Result<Self, String> {
        let folder = tempfile::tempdir().unwrap();
        let socket = folder.path().join("line");
        let log = fs::File::create(folder.path().join("log")).unwrap();
        let child = Command::new(PROGRAM)
            .args(["-M", "netduinoplus2", "-display", "none", "-monitor", "none", "-no-reboot", "-serial", "null"])
            .args(["-chardev", &format!("socket,id=w,path={},server=on,wait=off", socket.display())])
            .args(["-serial", "chardev:w", "-kernel", IMAGE])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .map_err(|error| format!("{PROGRAM}: {error}"))?;
        let mut guard = ChildGuard(Some(child));
        let line = connect(&socket, &mut guard, folder.path())?;
        line.set_read_timeout(Some(POLL_INTERVAL)).unwrap();
        line.set_write_timeout(Some(ANSWER_TIMEOUT)).unwrap();
        let child = guard.0.take().ok_or("no child")?;
        let mut qemu = Self { child, line, folder };
        qemu.wait_for_identity()?;
        Ok(qemu)
    }

    /// The line is there before the firmware has switched its end on, so the first words may be lost.
    fn wait_for_identity(&mut self) -> Result<(), String> {
        let deadline = Instant::now() + START_TIMEOUT;
        let mut reader = PacketReader::new();
        for sequence in (1..=u8::MAX).cycle() {
            let hello = Packet { sequence, message: Message::Hello }.encode();
            self.line.write_all(&[&[0], hello.as_bytes()].concat()).map_err(|error| self.exit_message(&error))?;
            let next_try = Instant::now() + HELLO_INTERVAL;
            while Instant::now() < next_try {
                let mut byte = [0];
                match self.line.read(&mut byte) {
                    Ok(0) => return Err(self.exit_message(&"the line is closed")),
                    Ok(_) => {}
                    Err(_) => continue,
                }
                let said = reader.push(byte[0]).and_then(Result::ok);
                if let Some(Packet { sequence: answered, message: Message::Identity(identity) }) = said
                    && answered == sequence
                {
                    assert_eq!(&identity.name, b"platebench-qemu\0");
                    return Ok(());
                }
            }
            if Instant::now() > deadline {
                break;
            }
        }
        Err(format!(
            "the firmware on QEMU does not introduce itself within {START_TIMEOUT:?}; {}",
            log_text(self.folder.path())
        ))
    }

    /// Sends `questions` and reads `length` bytes of answers.
    pub(crate) fn exchange(&mut self, questions: &[u8], length: usize) -> Result<Vec<u8>, String> {
        self.line.write_all(questions).map_err(|error| self.exit_message(&error))?;
        let mut answers = vec![0; length];
        let mut read = 0;
        let deadline = Instant::now() + ANSWER_TIMEOUT;
        while read < length {
            match self.line.read(&mut answers[read..]) {
                Ok(0) => return Err(self.exit_message(&"the line is closed")),
                Ok(more) => read += more,
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                    if Instant::now() > deadline {
                        return Err(format!("{read} of {length} bytes from QEMU within {ANSWER_TIMEOUT:?}"));
                    }
                }
                Err(error) => return Err(self.exit_message(&error)),
            }
        }
        Ok(answers)
    }

    /// Ends the machine; an error where it had something more to say.
    pub(crate) fn finish(mut self) -> Result<(), String> {
        let mut rest = [0; 64];
        match self.line.read(&mut rest) {
            Ok(0) => Err(self.exit_message(&"the line is closed")),
            Ok(more) => Err(format!("{more} bytes from QEMU that nobody asked for: {:02x?}", &rest[..more])),
            Err(_) => Ok(()),
        }
    }

    /// Ends the machine under way.
    pub(crate) fn kill(&mut self) {
        kill_and_wait(&mut self.child);
    }

    fn exit_message(&self, cause: &dyn std::fmt::Display) -> String {
        format!("QEMU is gone: {cause}; {}", log_text(self.folder.path()))
    }
}

impl Drop for Qemu {
    fn drop(&mut self) {
        kill_and_wait(&mut self.child);
    }
}

fn connect(socket: &Path, guard: &mut ChildGuard, folder: &Path) -> Result<UnixStream, String> {
    let deadline = Instant::now() + START_TIMEOUT;
    loop {
        match UnixStream::connect(socket) {
            Ok(line) => return Ok(line),
            Err(error) if Instant::now() > deadline => {
                return Err(format!("QEMU opens no line: {error}; {}", log_text(folder)));
            }
            Err(_) => {}
        }
        if let Some(child) = &mut guard.0
            && let Ok(Some(status)) = child.try_wait()
        {
            return Err(format!("QEMU ended with {status}; {}", log_text(folder)));
        }
        std::thread::sleep(POLL_INTERVAL);
    }
}

fn log_text(folder: &Path) -> String {
    let log = fs::read_to_string(folder.join("log")).unwrap_or_default();
    if log.trim().is_empty() { "it said nothing".to_owned() } else { format!("it said: {}", log.trim()) }
}
