//! Keeps the state of the chip after the handshake for the next restarts and links of the process,
//! which then do not execute the start of the firmware again. The emulator keeps each state until
//! the process ends, so their number is limited.

use super::board::ReceivedByte;
use super::bus::SystemBus;
use super::firmware_output::FirmwareOutput;
use super::image::EmulatedOptions;
use super::machine::{Machine, emulator_error};
use crate::link::TargetError;
use platebench_model::trace::OutputFolder;
use rigless::device::Level;
use rigless::emulator::{Error, Host, InterruptLine, Memory, Stop, StopReason};
use rigless::snapshot::{self, Snapshot, Store};
use rigless::soc::Width;
use rigless::time::VirtualNanos;
use std::io::Write as _;
use std::sync::{Arc, Mutex, PoisonError};

const MAX_IMAGES: usize = 4;

static STATES: Mutex<Vec<Arc<BootedState>>> = Mutex::new(Vec::new());

#[derive(Debug)]
pub(super) struct BootedState {
    elf: Arc<[u8]>,
    options: EmulatedOptions,
    models: Snapshot,
    processor: Vec<u8>,
    ram: Vec<Vec<u8>>,
    slept_ns: u64,
    output: FirmwareOutput,
    reported_resets: usize,
    /// Answer to the handshake.
    pub(super) answer: Vec<ReceivedByte>,
}

/// The emulator identifies an image by a digest. [`BootedState::elf`] does it here.
const NO_DIGEST: [u8; 32] = [0; 32];

/// The part of a snapshot that belongs to the program that drives the emulator.
struct NoDriver;

impl Store for NoDriver {
    fn store(&self, _: &mut snapshot::Writer) -> Result<(), snapshot::Error> {
        Ok(())
    }

    fn load(&mut self, _: &mut snapshot::Reader) -> Result<(), snapshot::Error> {
        Ok(())
    }
}

/// Gives the emulator's snapshot no memory and no processor, which [`BootedState`] keeps itself.
struct ModelsOnly;

impl Memory for ModelsOnly {
    fn read(&mut self, _: u64, _: Width) -> Result<u64, Error> {
        Ok(0)
    }

    fn write(&mut self, address: u64, width: Width, _: u64) -> Result<(), Error> {
        Err(Error::Memory { address, width })
    }
}

impl Host for ModelsOnly {
    fn set_interrupt(&mut self, _: InterruptLine, _: Level) {}

    fn request_reset(&mut self) {}

    fn save_state(&mut self) -> Result<Vec<u8>, Error> {
        Ok(Vec::new())
    }
}

pub(super) fn find(elf: &[u8], options: EmulatedOptions) -> Option<Arc<BootedState>> {
    let states = STATES.lock().unwrap_or_else(PoisonError::into_inner);
    states.iter().find(|state| state.options == options && *state.elf == *elf).cloned()
}

/// Keeps the state of `machine` after the handshake. Without effect if there is no room for it.
pub(super) fn keep(machine: &mut Machine, answer: Vec<ReceivedByte>) -> Result<(), TargetError> {
    let mut states = STATES.lock().unwrap_or_else(PoisonError::into_inner);
    let is_known = states.iter().any(|state| state.options == machine.options && *state.elf == *machine.image.elf);
    if is_known || states.len() >= MAX_IMAGES {
        return Ok(());
    }
    let stop = Stop {
        at: VirtualNanos(machine.now_ns()),
        instruction_count: machine.instructions(),
        reason: StopReason::Deadline,
    };
    let taken = snapshot::take(&mut machine.session, &mut ModelsOnly, stop, &NO_DIGEST, &NoDriver)
        .map_err(|error| emulator_error(&error))?;
    let Some(models) = read_back(&taken.file) else { return Ok(()) };
    let SystemBus { memory, slept_ns, .. } = &machine.bus;
    states.push(Arc::new(BootedState {
        elf: machine.image.elf.clone(),
        options: machine.options,
        models,
        processor: machine.core.save(),
        ram: memory.ram(),
        slept_ns: *slept_ns,
        output: machine.output.clone(),
        reported_resets: machine.reported_resets,
        answer,
    }));
    Ok(())
}

/// The emulator reads snapshots only from a file. `None` if it cannot be written.
fn read_back(bytes: &[u8]) -> Option<Snapshot> {
    let mut file = OutputFolder::open(&std::env::temp_dir()).ok()?.create_file("snapshot").ok()?;
    file.write_all(bytes).ok()?;
    Snapshot::read(&file.temporary_path()).ok()
}

impl Machine {
    /// Continues at the state after the handshake. Translated code is kept.
    pub(super) fn restore(&mut self, state: &BootedState) -> Result<(), TargetError> {
        let _ = self.core.take_reset_request();
        state.models.restore(&mut self.session, &NO_DIGEST, &mut NoDriver).map_err(|error| emulator_error(&error))?;
        self.core.load(&state.processor).map_err(|error| emulator_error(&error))?;
        self.bus.reset();
        self.bus.memory.restore_ram(&state.ram);
        self.bus.slept_ns = state.slept_ns;
        self.bus.notify_core(&mut *self.core);
        self.bus.deadline = self.session.next_deadline();
        self.reported_resets = state.reported_resets;
        self.is_faulted = false;
        self.output = state.output.clone();
        self.session.board_mut().part.port.start(self.uses_blocks);
        Ok(())
    }
}
