//! Runs the image `qemu.elf` on QEMU's board `netduinoplus2`, its line on a Unix socket.

use platebench_test_kit::{ChildGuard, skip_without};
use platebench_wire::{Message, Packet, PacketReader};
use std::fs;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

const PROGRAM: &str = "qemu-system-arm";
const IMAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../firmware-under-test/images/qemu.elf");

const START_TIMEOUT: Duration = Duration::from_secs(30);
const ANSWER_TIMEOUT: Duration = Duration::from_secs(30);
const HELLO_INTERVAL: Duration = Duration::from_millis(200);
const POLL_INTERVAL: Duration = Duration::from_millis(10);

pub(crate) struct Qemu {
    child: ChildGuard,
    line: UnixStream,
    folder: TempDir,
}

impl Qemu {
    /// Prints a message and returns `None` if QEMU is neither installed nor required.
    pub(crate) fn start_if_installed() -> Option<Self> {
        match Command::new(PROGRAM).arg("--version").stdin(Stdio::null()).output() {
            Ok(_) => Some(Self::start().unwrap()),
            Err(error) if error.kind() == ErrorKind::NotFound => {
                skip_without(PROGRAM);
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
        let mut child = ChildGuard(child);
        let line = connect(&socket, &mut child.0, folder.path())?;
        line.set_read_timeout(Some(POLL_INTERVAL)).unwrap();
        line.set_write_timeout(Some(ANSWER_TIMEOUT)).unwrap();
        let mut qemu = Self { child, line, folder };
        qemu.wait_for_identity()?;
        Ok(qemu)
    }

    /// Repeats the handshake, because the line exists before the firmware reads it.
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
                let packet = reader.push(byte[0]).and_then(Result::ok);
                if let Some(Packet { sequence: answered, message: Message::Identity(identity) }) = packet
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
            "the firmware on QEMU did not answer the handshake within {START_TIMEOUT:?}; {}",
            log_text(self.folder.path())
        ))
    }

    pub(crate) fn exchange(&mut self, requests: &[u8], length: usize) -> Result<Vec<u8>, String> {
        self.line.write_all(requests).map_err(|error| self.exit_message(&error))?;
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

    pub(crate) fn finish(mut self) -> Result<(), String> {
        let mut rest = [0; 64];
        match self.line.read(&mut rest) {
            Ok(0) => Err(self.exit_message(&"the line is closed")),
            Ok(more) => Err(format!("{more} unexpected bytes from QEMU: {:02x?}", &rest[..more])),
            Err(_) => Ok(()),
        }
    }

    pub(crate) fn kill(&mut self) {
        let _ = self.child.0.kill();
        let _ = self.child.0.wait();
    }

    fn exit_message(&self, cause: &dyn std::fmt::Display) -> String {
        format!("QEMU has ended: {cause}; {}", log_text(self.folder.path()))
    }
}

fn connect(socket: &Path, child: &mut Child, folder: &Path) -> Result<UnixStream, String> {
    let deadline = Instant::now() + START_TIMEOUT;
    loop {
        match UnixStream::connect(socket) {
            Ok(line) => return Ok(line),
            Err(error) if Instant::now() > deadline => {
                return Err(format!("QEMU opens no line: {error}; {}", log_text(folder)));
            }
            Err(_) => {}
        }
        if let Ok(Some(status)) = child.try_wait() {
            return Err(format!("QEMU ended with {status}; {}", log_text(folder)));
        }
        std::thread::sleep(POLL_INTERVAL);
    }
}

fn log_text(folder: &Path) -> String {
    let log = fs::read_to_string(folder.join("log")).unwrap_or_default();
    if log.trim().is_empty() { "no message".to_owned() } else { format!("its message: {}", log.trim()) }
}
