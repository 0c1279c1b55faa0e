//! A firmware image on an emulated STM32F427, in virtual time, in this process.
//!
//! Bytes enter USART2 (PA2, PA3) at the instants that the firmware's own baud rate gives, and the last stop bit of the answer is the instant of its effect: the delay
//! that an exchange returns holds the wire both ways, the idle line that ends a frame and the computing. While the firmware sleeps, time jumps. Every trial begins
//! with a power-on, so that equal trials give equal bytes whatever came before and whichever thread they run on.
//!
//! ```text
//!   Emulated ─── trial time to virtual time, handshake, patience           this file
//!      └ Target ─ power_on, send, run, heard                               target.rs: the emulator stays behind it
//!          └ Machine ─ event loop, board, memory, what went wrong          machine, board, surroundings, memory, post_mortem
//! ```
//!
//! What the emulator has no model of ends the trial with address, instruction, function and line, as do traps, lock-ups, resets and silence. Instructions are counted
//! exactly, but each takes 1/168 µs: a real processor waits for its flash and its pipeline.

mod board;
mod fault;
mod image;
mod machine;
mod memory;
mod post_mortem;
mod surroundings;
mod target;

pub use fault::{Gap, TargetFault, Trap};
pub use image::ImageError;

use crate::asked::Asked;
use crate::link::{Link, LinkError};
use image::Image;
use machine::{Machine, Setup};
use platebench_wire::{FrameReader, MAX_ENCODED, Message, Packet};
use std::any::Any;
use std::fs;
use std::io;
use std::panic::{self, AssertUnwindSafe};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use target::{Heard, Target};

/// The firmware that comes with the bench, built from `firmware-under-test/stm32f4`.
/// The firmware that came with the bench: an ELF for STM32F405, F407 and F427.
pub(crate) const BUILT_IN: &[u8] = include_bytes!("../../../firmware-under-test/images/platebench-stm32f4.elf");
/// What it talks at.
const BUILT_IN_BAUD: u32 = 1_000_000;

const NS_PER_MS: u64 = 1_000_000;
const BITS_PER_BYTE: u64 = 10;

/// An answer that has not begun this long after its question is none.
const PATIENCE_NS: u64 = 20 * NS_PER_MS;
/// What needs no answer may still have one: how long to listen after the idle line.
const AFTERTHOUGHT_NS: u64 = NS_PER_MS / 5;
/// A handshake is tried this often after power-on, for this long.
const HANDSHAKE_EVERY_NS: u64 = 10 * NS_PER_MS;
const HANDSHAKE_WITHIN_NS: u64 = 1_000 * NS_PER_MS;
/// Firmware that polls can be slower than real time here.
const HANDSHAKE_WITHIN_WALL: Duration = Duration::from_secs(20);
/// Between the handshake and time zero of a trial.
const SETTLE_NS: u64 = NS_PER_MS;
/// Baud rates further than this from the expected one are errors: a UART samples its tenth bit wrong from 5 % on, both ends together.
const BAUD_TOLERANCE_PERCENT: u64 = 2;

/// How an emulated board is set up.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Options {
    /// The crystal on PH0 and PH1; 0 for none.
    pub crystal_hz: u64,
    /// The baud rate that the firmware must use; `None` for whatever it does use.
    pub baud: Option<u32>,
    /// Report traps, panics and resets as errors where they happen. False lets the firmware deal with them, as on a board.
    pub stop_at_traps: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self { crystal_hz: 8_000_000, baud: None, stop_at_traps: true }
    }
}

/// Why there is no emulated board to work with.
#[derive(Debug, thiserror::Error)]
pub enum EmulatedError {
    /// The file could not be read.
    #[error("{}: {error}", path.display())]
    Read {
        /// Which file.
        path: PathBuf,
        /// Why not.
        error: std::io::Error,
    },
    /// The file is no firmware for this board.
    #[error("no firmware for the emulated board: {0}")]
    Image(#[from] ImageError),
    /// The firmware did not come up.
    #[error(transparent)]
    Target(#[from] TargetFault),
}

/// An emulated board with firmware that has introduced itself.
#[derive(Debug)]
pub struct Emulated {
    target: Box<dyn Target>,
    options: Options,
    /// Virtual time at the trial's time zero.
    zero_ns: u64,
    /// How long the firmware takes for a byte, once it has sent a frame.
    byte_ns: u64,
    heard: Vec<Heard>,
    asked: Asked,
    answers: FrameReader,
    instructions: Option<u64>,
    dead: Option<TargetFault>,
}

impl Emulated {
    /// The firmware that came with the bench.
    ///
    /// # Errors
    /// [`EmulatedError`] where it does not come up.
    pub fn built_in() -> Result<Self, EmulatedError> {
        Self::new(BUILT_IN, Options { baud: Some(BUILT_IN_BAUD), ..Options::default() })
    }

    /// The image of the firmware that came with the bench.
    pub const fn built_in_image() -> &'static [u8] {
        BUILT_IN
    }

    /// The firmware in the file `elf`, at whatever baud rate it uses.
    ///
    /// # Errors
    /// [`EmulatedError`] where the file is no firmware for this board, or the firmware does not come up.
    pub fn open(elf: &Path) -> Result<Self, EmulatedError> {
        let content = read_elf(elf).map_err(|error| EmulatedError::Read { path: elf.to_owned(), error })?;
        Self::new(&content, Options::default())
    }

    /// The firmware in `elf` on a board with `options`.
    ///
    /// # Errors
    /// [`EmulatedError`] where `elf` is no firmware for this board, or it does not come up.
    pub fn new(elf: &[u8], options: Options) -> Result<Self, EmulatedError> {
        let image = Image::new(Arc::from(elf))?;
        let setup = Setup { crystal_hz: options.crystal_hz, stop_at_traps: options.stop_at_traps };
        let mut emulated = Self {
            target: Box::new(contained(|| Machine::new(image, setup))?),
            options,
            zero_ns: 0,
            byte_ns: 0,
            heard: Vec::with_capacity(2 * MAX_ENCODED),
            asked: Asked::default(),
            answers: FrameReader::new(),
            instructions: None,
            dead: None,
        };
        contained(|| emulated.start())?;
        Ok(emulated)
    }

    /// Bits per second that the firmware sends at, measured.
    pub fn baud(&self) -> u32 {
        (BITS_PER_BYTE * 1_000_000_000).checked_div(self.byte_ns).unwrap_or(0) as u32
    }

    /// Most bytes of stack in use since the trial's power-on; `None` where the image has no symbol `_stack_end` for the stack's lowest address.
    pub fn stack_used(&self) -> Option<u32> {
        self.target.stack_used()
    }

    /// Power-on and handshake; time zero comes at a whole millisecond soon after.
    fn start(&mut self) -> Result<(), TargetFault> {
        self.dead = None;
        self.instructions = None;
        self.byte_ns = 0;
        self.target.power_on()?;
        let deadline = Instant::now() + HANDSHAKE_WITHIN_WALL;
        let hello = Packet { sequence: 0, message: Message::Hello }.encode();
        let mut attempt_ends = 0;
        loop {
            self.asked = Asked::default();
            self.answers = FrameReader::new();
            self.heard.clear();
            attempt_ends += HANDSHAKE_EVERY_NS;
            self.run_to(self.target.now_ns() + SETTLE_NS)?;
            self.heard.clear();
            self.target.send(hello.as_bytes());
            if self.listen(attempt_ends, Some(0))?.is_some() {
                break;
            }
            if attempt_ends >= HANDSHAKE_WITHIN_NS || Instant::now() > deadline {
                let whereabouts = self.target.whereabouts();
                return Err(TargetFault::NoHandshake {
                    waited_ms: self.target.now_ns() / NS_PER_MS,
                    instances: whereabouts.instances,
                    place: whereabouts.place,
                });
            }
        }
        self.check_baud()?;
        self.heard.clear();
        self.target.came_up();
        self.zero_ns = (self.target.now_ns() + SETTLE_NS).next_multiple_of(NS_PER_MS);
        Ok(())
    }

    /// Measures the baud rate on a frame that has just been heard.
    fn check_baud(&mut self) -> Result<(), TargetFault> {
        let (Some(first), Some(last)) = (self.heard.first(), self.heard.last()) else { return Ok(()) };
        let gaps = self.heard.len() as u64 - 1;
        self.byte_ns = (last.at_ns - first.at_ns + gaps / 2).checked_div(gaps).unwrap_or(0);
        let Some(expected) = self.options.baud else { return Ok(()) };
        let seen = self.baud();
        if u64::from(seen.abs_diff(expected)) * 100 > u64::from(expected) * BAUD_TOLERANCE_PERCENT {
            return Err(TargetFault::Baud { expected, seen });
        }
        Ok(())
    }

    /// Runs to `until_ns`, whatever is said meanwhile.
    fn run_to(&mut self, until_ns: u64) -> Result<(), TargetFault> {
        while self.target.now_ns() < until_ns {
            self.target.run(until_ns)?;
        }
        self.target.take_heard(&mut self.heard);
        Ok(())
    }

    /// Runs until the answer to message `sequence` is whole, or to `until_ns`, or to the end of a frame that has begun by then. The instant of the answer's last stop bit.
    fn listen(&mut self, mut until_ns: u64, sequence: Option<u8>) -> Result<Option<u64>, TargetFault> {
        let mut read = self.heard.len();
        let mut extended = false;
        loop {
            let frame_ended = self.target.run(until_ns)?;
            self.target.take_heard(&mut self.heard);
            let mut within_frame = false;
            while let Some(&Heard { byte, at_ns }) = self.heard.get(read) {
                read += 1;
                within_frame = byte != 0;
                let Some(Ok(body)) = self.answers.push(byte) else { continue };
                match Packet::decode(body) {
                    Ok(Packet { message: Message::Fault(_), .. }) => return Ok(Some(at_ns)),
                    // Ticks count by themselves.
                    Ok(Packet { message: Message::Tick(_), .. }) => {}
                    Ok(packet) if Some(packet.sequence) == sequence => return Ok(Some(at_ns)),
                    _ => {}
                }
            }
            if frame_ended {
                continue;
            }
            if within_frame && !extended {
                extended = true;
                until_ns += MAX_ENCODED as u64 * self.byte_ns.max(1);
                continue;
            }
            return Ok(None);
        }
    }

    fn virtual_ns(&self, now: Duration) -> u64 {
        self.zero_ns.saturating_add(u64::try_from(now.as_nanos()).unwrap_or(u64::MAX))
    }

    /// Runs to the trial's instant `now`. A target that is already past it (its last answer took longer than the bench's time since) has the rest of the
    /// trial moved: the plate waits for the firmware, never the other way round.
    fn catch_up(&mut self, now: Duration) -> Result<(), TargetFault> {
        let wanted = self.virtual_ns(now);
        let ahead = self.target.now_ns().saturating_sub(wanted);
        self.zero_ns += ahead;
        self.run_to(wanted + ahead)
    }

    fn ask(&mut self, now: Duration, bytes: &[u8]) -> Result<Duration, TargetFault> {
        self.catch_up(now)?;
        let (start_ns, instructions) = (self.target.now_ns(), self.target.instructions());
        let expected = self.asked.expects(bytes);
        self.target.send(bytes);
        let arrived_ns = start_ns + bytes.len() as u64 * self.byte_ns;
        let patience_ns = if expected.is_some() { PATIENCE_NS } else { AFTERTHOUGHT_NS };
        let answered = self.listen(arrived_ns + patience_ns, expected)?;
        self.instructions = answered.map(|_| self.target.instructions() - instructions);
        match (answered, expected) {
            (Some(at_ns), _) => Ok(Duration::from_nanos(at_ns - start_ns)),
            (None, None) => Ok(Duration::ZERO),
            (None, Some(_)) => {
                let waited_us = (self.target.now_ns() - arrived_ns) / 1_000;
                Err(TargetFault::Silent { waited_us, place: self.target.whereabouts().place })
            }
        }
    }

    /// Does `what` unless the target is dead already, and hands over what was heard. A target that dies of it stays dead until it is restarted.
    fn alive<T>(
        &mut self,
        heard: &mut Vec<u8>,
        what: impl FnOnce(&mut Self) -> Result<T, TargetFault>,
    ) -> Result<T, LinkError> {
        if let Some(fault) = &self.dead {
            return Err(LinkError::Target(Box::new(fault.clone())));
        }
        let result = contained(|| what(self));
        heard.extend(self.heard.drain(..).map(|heard| heard.byte));
        result.map_err(|fault| {
            self.dead = Some(fault.clone());
            LinkError::Target(Box::new(fault))
        })
    }
}

/// A panic of the emulator is an error of the rig, not the end of the bench.
fn contained<T>(what: impl FnOnce() -> Result<T, TargetFault>) -> Result<T, TargetFault> {
    let panicked = |cause: Box<dyn Any + Send>| {
        let text = cause.downcast_ref::<String>().map(String::as_str);
        let text = text.or_else(|| cause.downcast_ref::<&str>().copied()).unwrap_or("no message");
        TargetFault::Emulator(format!("it panicked: {text}"))
    };
    panic::catch_unwind(AssertUnwindSafe(what)).unwrap_or_else(|cause| Err(panicked(cause)))
}

impl Link for Emulated {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.alive(answer, |emulated| emulated.ask(now, bytes))
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        // Where the target is past it already, that much has passed.
        self.alive(said, |emulated| emulated.run_to(emulated.virtual_ns(now)))
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        // An emulator that failed cannot be trusted to begin again.
        if let Some(fault @ TargetFault::Emulator(_)) = &self.dead {
            return Err(LinkError::Target(Box::new(fault.clone())));
        }
        match contained(|| self.start()) {
            Ok(()) => Ok(true),
            Err(fault) => {
                self.dead = Some(fault.clone());
                Err(LinkError::Target(Box::new(fault)))
            }
        }
    }

    fn cost(&self) -> Option<u64> {
        self.instructions
    }
}

/// The content of the file `elf`. A pipe or a device may never begin or never end: it is not opened.
pub(crate) fn read_elf(elf: &Path) -> io::Result<Vec<u8>> {
    let kind = fs::metadata(elf)?.file_type();
    if !kind.is_file() && !kind.is_dir() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "it is a pipe or a device, expected an ELF file"));
    }
    fs::read(elf)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_is_no_firmware() {
        let error = read_elf(Path::new("/dev/zero")).unwrap_err().to_string();
        assert_eq!(error, "it is a pipe or a device, expected an ELF file");
        assert_eq!(read_elf(Path::new("/")).unwrap_err().kind(), io::ErrorKind::IsADirectory);
    }

    #[test]
    fn a_panic_of_the_emulator_is_an_error() {
        let result = contained(|| if BUILT_IN.is_empty() { Ok(()) } else { panic!("checked at construction") });
        assert_eq!(result, Err(TargetFault::Emulator("it panicked: checked at construction".to_owned())));
    }
}
