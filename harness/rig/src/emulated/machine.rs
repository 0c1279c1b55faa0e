//! Runs an image on the emulated board from event to event in virtual time.

use super::board::{EmulatedBoard, INSTRUCTIONS_PER_SECOND, ReceivedByte};
use super::bus::{BusGuard, SystemBus};
use super::firmware_output::FirmwareOutput;
use super::image::{EmulatedOptions, FLASH_START, Image};
use super::memory::{Memory, POWER_ON_FILL};
use super::post_mortem::FaultHandlers;
use super::{memory, no_model, post_mortem};
use crate::crash_report::StoppedAt;
use crate::link::TargetError;
use crate::symbols::{CodeLocation, Symbols};
use gdbstub::stub::SingleThreadStopReason;
use platebench_model::metrics::OutputRead;
use platebench_model::record::UnmodelledInstance;
use rigless::emulator::{Exit, Processor, Stop, StopReason};
use rigless::machine::Board as _;
use rigless::mcu::Operate as _;
use rigless::session::Session;
use rigless::soc::Width;
use rigless::time::{NO_DEADLINE, VirtualNanos};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

/// Largest number of rounds of the run loop at one instant. Some hundred are normal; after more
/// than this number, the emulator counts as hung.
const MAX_ROUNDS_WITHOUT_PROGRESS: u32 = 100_000;

/// Time between two reads of the output of firmware that waits for room in it.
const DRAIN_INTERVAL_NS: u64 = 100_000;

/// Numbers of d0 to d15 and FPSCR in the order of a debugger.
const FPU_REGISTERS: std::ops::RangeInclusive<usize> = 17..=33;

/// Address of the vector table (ARMv7-M, B3.2.5).
const VTOR: u64 = 0xE000_ED08;

/// Addresses and values of the unique device ID and of the flash size (RM0090, chapter 39).
const UNIQUE_ID: (u64, &[u8; 12]) = (0x1FFF_7A10, b"emulated-427");
const FLASH_KIB: (u64, [u8; 2]) = (0x1FFF_7A22, 2048_u16.to_le_bytes());

pub(super) struct Machine {
    // Declared, and so dropped, before `bus`, because it points into the memory of `bus`.
    pub(super) core: Box<dyn Processor>,
    pub(super) bus: SystemBus,
    pub(super) session: Session<EmulatedBoard>,
    pub(super) image: Image,
    pub(super) options: EmulatedOptions,
    handlers: FaultHandlers,
    recorder: ExecutionRecorder,
    pub(super) output: FirmwareOutput,
    /// Processor state after power-on. Unlike a reset, loading it keeps the translated code.
    power_on_state: Vec<u8>,
    pub(super) reported_resets: usize,
    /// True if flash contains the unchanged image.
    has_own_image: bool,
    /// True after a planned fault of the chip. The firmware must then handle traps and resets.
    pub(super) is_faulted: bool,
    /// True if words may pass as blocks from the next power-on on.
    pub(super) uses_blocks: bool,
    pub(super) debug: DebugControl,
}

impl fmt::Debug for Machine {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Machine").field("now_ns", &self.now_ns()).finish_non_exhaustive()
    }
}

pub(super) fn emulator_error(error: &dyn fmt::Display) -> TargetError {
    TargetError::Emulator(error.to_string())
}

fn session(options: EmulatedOptions) -> Result<Session<EmulatedBoard>, TargetError> {
    let board = EmulatedBoard::new(options.crystal_hz).map_err(|error| emulator_error(&error))?;
    Session::new(Box::new(board), 0, NO_DEADLINE).map_err(|error| emulator_error(&error))
}

impl Machine {
    pub(super) fn new(image: Image, options: EmulatedOptions) -> Result<Self, TargetError> {
        let mut session = session(options)?;
        let mut targets = session.board_mut().targets();
        let target = targets.pop().ok_or_else(|| emulator_error(&"the board has no processor"))?;
        let mut core = (target.core.processor)(target.mcu.cpu().endian).map_err(|error| emulator_error(&error))?;
        let mut memory = Memory::new(target.mcu.bus().memory(), &target.core.aliases);
        let boot = target.core.boot.reset;
        drop(targets);
        map_memory(&memory, &mut *core)?;

        let segments = image.segments.iter().map(|segment| (segment.address, &*segment.bytes));
        for (address, bytes) in segments.chain([(UNIQUE_ID.0, &UNIQUE_ID.1[..]), (FLASH_KIB.0, &FLASH_KIB.1[..])]) {
            if !memory.store(address, bytes) {
                return Err(emulator_error(&format_args!("no memory of {} bytes at {address:#010x}", bytes.len())));
            }
        }
        let handlers =
            if options.stop_at_traps { FaultHandlers::from_image(&memory, &image) } else { FaultHandlers::none() };
        handlers.set_breakpoints(&mut *core);
        let mut bus = SystemBus::new(memory, INSTRUCTIONS_PER_SECOND);
        bus.notify_core(&mut *core);
        core.boot(boot, &|address, width| bus.memory.value(address, width));
        let power_on_state = core.save();
        let recorder = ExecutionRecorder::default();
        let output = FirmwareOutput::new(&image.elf);
        let mut machine = Self {
            core,
            bus,
            session,
            image,
            options,
            handlers,
            recorder,
            output,
            power_on_state,
            reported_resets: 0,
            has_own_image: true,
            is_faulted: false,
            uses_blocks: false,
            debug: DebugControl::default(),
        };
        machine.power_on()?;
        Ok(machine)
    }

    fn stop(&mut self, reason: StopReason) {
        let instruction_count = self.core.retired();
        let stop = Stop { at: self.bus.time_at(instruction_count), instruction_count, reason };
        self.bus.deadline = self.session.stop(stop, &mut self.bus);
        self.bus.notify_core(&mut *self.core);
    }

    fn reset_core(&mut self) {
        let Self { core, bus, .. } = self;
        // A reset makes the pin an input, which the board pulls low.
        bus.enable_pin.record(false, bus.time_at(core.retired()).0);
        core.reset();
        core.boot(FLASH_START, &|address, width| bus.memory.value(address, width));
    }

    /// Resets chip and processor. It counts as no reset by the firmware.
    pub(super) fn reset_by_debugger(&mut self) {
        let instructions = self.core.retired();
        self.session.reset_by_pin(self.bus.time_at(instructions), instructions, &mut self.bus);
        self.reported_resets = self.session.resets().len();
        self.bus.reset_requested = false;
        self.bus.notify_core(&mut *self.core);
        self.reset_core();
        self.bus.deadline = self.session.next_deadline();
    }

    fn symbols(&self) -> Symbols {
        Symbols::read(&self.image.elf)
    }

    pub(super) fn code_location(&self) -> CodeLocation {
        self.symbols().locate(self.core.pc() as u32)
    }

    /// Stops at the fault handlers of the present vector table, which the firmware may have moved.
    fn follow_vector_table(&mut self) {
        if self.options.stop_at_traps {
            let now = self.bus.time_at(self.core.retired());
            let table = self.core.debugger_access(None, VTOR, Width::W32, now).unwrap_or(FLASH_START);
            self.handlers.follow(&self.bus.memory, table, &mut *self.core);
        }
    }

    /// The trap that the firmware handles now, if the bench ends trials at traps.
    pub(super) fn trap(&mut self, stopped: StoppedAt) -> Option<TargetError> {
        if self.is_faulted || !self.options.stop_at_traps {
            return None;
        }
        let crash = self.handlers.read_crash(stopped, &mut *self.core, &self.bus, &mut self.session, &self.image);
        crash.map(|crash| TargetError::Trap(Box::new(crash)))
    }

    fn take_frame_end(&mut self) -> bool {
        self.session.board_mut().wire().is_some_and(|wire| std::mem::take(&mut wire.frames) > 0)
    }

    fn check_for_errors(&mut self) -> Result<(), TargetError> {
        if let Some(error) = self.session.take_error() {
            return Err(emulator_error(&error));
        }
        if let Some(failure) = self.session.board().part.port.failure {
            return Err(emulator_error(&failure));
        }
        let access = post_mortem::first_unsupported_access(&self.session, &self.bus, &self.image);
        if let Some(access) = access.filter(|_| !self.is_faulted) {
            return Err(TargetError::Unsupported(access));
        }
        let resets = self.session.resets();
        if let Some(reset) = resets.get(self.reported_resets) {
            let (cause, at_us) = (post_mortem::reset_cause(reset.cause), reset.at.0 / 1_000);
            self.reported_resets = resets.len();
            if self.options.stop_at_traps && !self.is_faulted {
                let reset = TargetError::Reset { cause, at_us, place: self.code_location() };
                return Err(self.trap(StoppedAt::Body).unwrap_or(reset));
            }
        }
        Ok(())
    }

    fn step(&mut self) -> Result<(), TargetError> {
        let target = self.bus.next_event(self.core.next_event());
        let single_step = std::mem::take(&mut self.debug.single_step);
        let budget = if single_step { 1 } else { self.bus.instructions_until(self.core.retired(), target) };
        let mut guard = BusGuard { bus: &mut self.bus, session: &mut self.session };
        let (exit, ran) = self.core.run(budget, &mut guard);
        self.bus.notify_core(&mut *self.core);
        if single_step && ran == 0 {
            self.debug.single_step = true;
        } else if single_step {
            self.debug.stop = Some(DebugStop::DoneStep);
        }
        if let Some((addr, kind)) = self.bus.watch_hit.take() {
            self.debug.stop = Some(DebugStop::Watch { tid: (), kind, addr });
        }
        match exit {
            Exit::Breakpoint if self.debug.stop.is_none() => {
                let pc = self.core.pc();
                self.recorder.record(pc, &mut *self.core);
                if let Some(trap) = self.trap(StoppedAt::Entry) {
                    return Err(trap);
                }
                self.debug.stop = self.debug.stop_at(pc);
                if self.debug.stop.is_none() {
                    self.core.pass_breakpoint(pc);
                }
            }
            // Semihosting without a debugger has no effect.
            Exit::HostCall => self.core.answer_host_call(None),
            // The peripherals still run, so that the watchdog may reset the processor.
            Exit::Lockup if self.is_faulted => {
                let now = self.bus.time_at(self.core.retired());
                self.sleep_until_event(now);
            }
            Exit::Lockup => return Err(TargetError::Lockup(self.code_location())),
            _ => {}
        }
        if ran == 0 && self.core.waiting() {
            let now = self.bus.time_at(self.core.retired());
            self.sleep_until_event(now);
        }
        Ok(())
    }

    fn sleep_until_event(&mut self, now: VirtualNanos) {
        let target = self.bus.next_event(self.core.next_event());
        if target > now && target != NO_DEADLINE {
            self.bus.slept_ns += target.0 - now.0;
        }
    }
}

#[allow(unsafe_code, reason = "the processor holds pointers to the memory")]
fn map_memory(memory: &Memory, core: &mut dyn Processor) -> Result<(), TargetError> {
    // SAFETY: `Machine::new` moves both into a `Machine`, which drops its processor first; the
    // pages do not move. Borrows of `Memory` end before the processor runs, or begin and end within
    // a callback.
    unsafe { memory::map_into_core(memory, core) }.map_err(|problem| emulator_error(&problem))
}

impl Machine {
    /// Switches the supply off and on: virtual time is 0, RAM undefined, the line idle.
    pub(super) fn power_on(&mut self) -> Result<(), TargetError> {
        self.session = session(self.options)?;
        self.session.board_mut().part.port.start(self.uses_blocks);
        let _ = self.core.take_reset_request();
        self.core.load(&self.power_on_state).map_err(|error| emulator_error(&error))?;
        self.bus.reset();
        self.bus.notify_core(&mut *self.core);
        self.bus.deadline = self.session.next_deadline();
        self.reported_resets = 0;
        self.is_faulted = false;
        self.output.start(0);
        Ok(())
    }

    /// Call it when the firmware has started and will hardly use further peripherals. Unused ones
    /// are then not polled. This affects only the speed.
    pub(super) fn mark_booted(&mut self) {
        self.session.board_mut().part.booted = true;
    }

    pub(super) fn now_ns(&self) -> u64 {
        self.bus.time_at(self.core.retired()).0
    }

    pub(super) fn instructions(&self) -> u64 {
        self.core.retired()
    }

    /// Time of `instructions` at one instruction per cycle.
    pub(super) fn nanoseconds_of(&self, instructions: u64) -> u64 {
        self.bus.nanoseconds_of(instructions)
    }

    /// Number of instructions that take this time at one instruction per cycle.
    pub(super) fn instructions_in(&self, nanoseconds: u64) -> u64 {
        self.bus.instructions_in(nanoseconds)
    }

    pub(super) fn send(&mut self, bytes: &[u8]) {
        self.transport_due_words();
        let now = VirtualNanos(self.now_ns());
        let processor_sleeps = self.core.waiting();
        let part = &mut self.session.board_mut().part;
        part.continue_word_by_word(now.0);
        part.send(bytes, now.0, processor_sleeps);
        let instructions = self.core.retired();
        self.bus.deadline = self.session.resume(NO_DEADLINE, now, instructions, &mut self.bus);
        self.bus.notify_core(&mut *self.core);
    }

    /// Transports the words whose last bit is past, so that the bench can read them.
    fn transport_due_words(&mut self) {
        let now = VirtualNanos(self.now_ns());
        let part = &mut self.session.board_mut().part;
        if part.catch_up(now.0) {
            let (until, instructions) = (self.session.until(), self.core.retired());
            self.bus.deadline = self.session.resume(until, now, instructions, &mut self.bus);
            self.bus.notify_core(&mut *self.core);
        }
        self.session.board_mut().part.port.report_sent(now.0);
    }

    /// Returns true at the end of a frame from the firmware, false at `until_ns`. Fails if time
    /// does not advance. Firmware that waits for room in its output is emptied meanwhile.
    pub(super) fn run(&mut self, until_ns: u64) -> Result<bool, TargetError> {
        while self.output.is_blocking() && self.now_ns() + DRAIN_INTERVAL_NS < until_ns {
            self.drain_output();
            if self.run_without_drain(self.now_ns() + DRAIN_INTERVAL_NS)? || self.debug.stop.is_some() {
                return Ok(self.debug.stop.is_none());
            }
        }
        self.run_without_drain(until_ns)
    }

    pub(super) fn drain_output(&mut self) {
        let now_ns = self.now_ns();
        if self.output.drain(&mut self.bus.memory, now_ns) {
            self.bus.notify_core(&mut *self.core);
        }
    }

    fn run_without_drain(&mut self, until_ns: u64) -> Result<bool, TargetError> {
        let until = VirtualNanos(until_ns);
        self.session.run_until(until);
        self.bus.deadline = self.session.next_deadline();
        self.follow_vector_table();
        let mut rounds_at = (VirtualNanos(u64::MAX), 0);
        loop {
            let now = self.bus.time_at(self.core.retired());
            rounds_at = if rounds_at.0 == now { (now, rounds_at.1 + 1) } else { (now, 0) };
            if rounds_at.1 > MAX_ROUNDS_WITHOUT_PROGRESS {
                return Err(emulator_error(&format_args!(
                    "virtual time does not advance beyond {} ns, at {}",
                    now.0,
                    self.code_location()
                )));
            }
            if std::mem::take(&mut self.bus.reset_requested) {
                // Checked before the reset, because the report names the code that ran.
                self.check_for_errors()?;
                self.reset_core();
            } else if self.core.take_reset_request() {
                self.stop(StopReason::Reset);
                self.check_for_errors()?;
                self.reset_core();
            } else if self.core.next_event().is_some_and(|event| event <= now) {
                self.core.on_event(now);
            } else if now >= self.bus.deadline {
                self.stop(if self.core.waiting() { StopReason::Idle } else { StopReason::Deadline });
                if self.take_frame_end() {
                    self.check_for_errors()?;
                    return Ok(true);
                }
                if now >= until && !self.bus.reset_requested {
                    self.transport_due_words();
                    self.check_for_errors()?;
                    return Ok(false);
                }
            } else {
                if !self.session.board().part.booted {
                    self.follow_vector_table();
                }
                self.step()?;
                if self.debug.stop.is_some() {
                    return Ok(false);
                }
            }
        }
    }

    pub(super) fn amplifier_enabled(&self) -> bool {
        self.session.board().amplifier_enabled()
    }

    pub(super) fn take_received(&mut self, into: &mut Vec<ReceivedByte>) {
        if let Some(wire) = self.session.board_mut().wire() {
            into.append(&mut wire.received);
        }
        self.drain_output();
    }

    pub(super) fn firmware_output(&self) -> Option<String> {
        self.output.text(&self.bus.memory)
    }

    pub(super) fn defmt_frames(&self) -> Option<Vec<u8>> {
        self.output.frames(&self.bus.memory)
    }

    /// `seconds` converts the time of the chip.
    pub(super) fn firmware_output_reads(&self, seconds: impl Fn(u64) -> f64) -> Option<Vec<OutputRead>> {
        self.output.reads(&self.bus.memory, self.now_ns(), seconds)
    }

    /// Starts the records of a trial.
    pub(super) fn start_records(&mut self) {
        let now_ns = self.now_ns();
        self.output.start(now_ns);
        self.bus.enable_pin.start(now_ns);
    }

    /// Moves the records of the trial with its start.
    pub(super) fn shift_records(&mut self, by_ns: u64) {
        self.output.shift(by_ns);
        self.bus.enable_pin.shift(by_ns);
    }

    pub(super) fn watch(&mut self, addresses: &BTreeSet<u32>) {
        self.recorder.watch(addresses, &mut *self.core);
    }

    /// True if a restart need not execute the start of the firmware: no changed instruction acts
    /// there, and none is recorded.
    pub(super) fn may_skip_start(&self) -> bool {
        self.has_own_image && !self.recorder.is_recording()
    }

    pub(super) fn set_control_step(&mut self, in_control_step: bool) {
        self.recorder.set_control_step(in_control_step, &mut *self.core);
    }

    pub(super) fn executed_instructions(&self) -> &BTreeMap<u32, bool> {
        self.recorder.executed_instructions()
    }

    pub(super) fn patch(&mut self, address: u32, bytes: &[u8]) -> bool {
        let stored = self.bus.memory.store(u64::from(address), bytes);
        self.has_own_image = false;
        self.bus.notify_core(&mut *self.core);
        stored
    }

    pub(super) fn unmodelled_instances(&self) -> Vec<UnmodelledInstance> {
        no_model::count(self.session.unimplemented().values())
    }

    /// See [`crate::Chip::is_fpu_unused`].
    pub(super) fn is_fpu_unused(&self) -> bool {
        let is_zero = |number| self.core.gdb_register(number).is_none_or(|bytes| bytes.iter().all(|byte| *byte == 0));
        self.image.is_hard_float && FPU_REGISTERS.into_iter().all(is_zero)
    }

    pub(super) fn used_instances(&self) -> Vec<&'static str> {
        self.session.board().part.instances_the_firmware_used()
    }

    /// True if words have passed as a block since power-on.
    pub(super) fn has_used_blocks(&self) -> bool {
        self.session.board().part.port.has_used_blocks
    }

    pub(super) fn stack_used(&self) -> Option<u32> {
        let symbols = self.symbols();
        let top = self.image.initial_stack;
        let bottom = u32::try_from(symbols.address("_stack_end")?).ok()?;
        let memory = self.bus.memory.slice(u64::from(bottom), top.checked_sub(bottom)? as usize)?;
        let unused = memory.iter().take_while(|&&byte| byte == POWER_ON_FILL).count();
        u32::try_from(memory.len() - unused).ok()
    }
}

pub(super) type DebugStop = SingleThreadStopReason<u32>;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum BreakpointKind {
    Software,
    Hardware,
}

/// Breakpoints of a debugger and its requests to step or to stop the chip.
#[derive(Debug, Default)]
pub(super) struct DebugControl {
    /// Both kinds stop before the instruction at their address.
    breakpoints: BTreeSet<(u64, BreakpointKind)>,
    pub(super) single_step: bool,
    pub(super) stop: Option<DebugStop>,
}

impl DebugControl {
    pub(super) fn has_breakpoint(&self, address: u64) -> bool {
        self.stop_at(address).is_some()
    }

    fn stop_at(&self, address: u64) -> Option<DebugStop> {
        if self.breakpoints.contains(&(address, BreakpointKind::Software)) {
            return Some(DebugStop::SwBreak(()));
        }
        self.breakpoints.contains(&(address, BreakpointKind::Hardware)).then_some(DebugStop::HwBreak(()))
    }

    pub(super) fn add(&mut self, address: u64, kind: BreakpointKind, core: &mut dyn Processor) -> bool {
        let breakpoint = (address, kind);
        self.breakpoints.contains(&breakpoint) || core.add_breakpoint(address) && self.breakpoints.insert(breakpoint)
    }

    pub(super) fn remove(&mut self, address: u64, kind: BreakpointKind, core: &mut dyn Processor) -> bool {
        let removed = self.breakpoints.remove(&(address, kind));
        if removed {
            core.remove_breakpoint(address);
        }
        removed
    }

    pub(super) fn end(&mut self, core: &mut dyn Processor) {
        for (address, _) in std::mem::take(&mut self.breakpoints) {
            core.remove_breakpoint(address);
        }
        *self = Self::default();
    }
}

/// Records which watched instructions ran. Each has a breakpoint, which is removed at the first hit,
/// so that code runs at full speed.
#[derive(Debug, Default)]
pub(super) struct ExecutionRecorder {
    pending: BTreeSet<u64>,
    /// Executed instructions by address. The value is true if one ran in a control step.
    executed: BTreeMap<u32, bool>,
    in_control_step: bool,
    had_control_step: bool,
}

impl ExecutionRecorder {
    pub(super) fn watch(&mut self, addresses: &BTreeSet<u32>, core: &mut dyn Processor) {
        self.pending.iter().for_each(|&address| core.remove_breakpoint(address));
        *self = Self { pending: addresses.iter().map(|&address| u64::from(address)).collect(), ..Self::default() };
        self.pending.retain(|&address| core.add_breakpoint(address));
    }

    fn is_recording(&self) -> bool {
        !self.pending.is_empty() || !self.executed.is_empty()
    }

    /// Before the first control step, watches instructions again that ran during the start, because
    /// they may also run in a control step.
    pub(super) fn set_control_step(&mut self, in_control_step: bool, core: &mut dyn Processor) {
        self.in_control_step = in_control_step;
        if in_control_step && !std::mem::replace(&mut self.had_control_step, true) {
            let again = self.executed.keys().map(|&address| u64::from(address));
            self.pending.extend(again.filter(|&address| core.add_breakpoint(address)));
        }
    }

    pub(super) fn record(&mut self, address: u64, core: &mut dyn Processor) {
        if self.pending.remove(&address)
            && let Ok(recorded) = u32::try_from(address)
        {
            core.remove_breakpoint(address);
            *self.executed.entry(recorded).or_default() |= self.in_control_step;
        }
    }

    pub(super) fn executed_instructions(&self) -> &BTreeMap<u32, bool> {
        &self.executed
    }
}
