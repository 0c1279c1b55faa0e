//! The emulator as a [`Target`]: one image on one board, run from event to event in virtual time.

use super::board::{Bench, INSTRUCTIONS_PER_SECOND};
use super::fault::TargetFault;
use super::image::Image;
use super::memory::{self, Memory, UNKNOWN};
use super::post_mortem::{self, Handlers};
use super::surroundings::{Lent, Surroundings};
use super::target::{Heard, Target, Whereabouts};
use crate::symbols::{Place, Symbols};
use rigless::emulator::{Exit, Processor, Stop, StopReason};
use rigless::machine::Board as _;
use rigless::mcu::Operate as _;
use rigless::session::Session;
use rigless::time::{NO_DEADLINE, VirtualNanos};
use std::fmt;

/// Rounds of the run loop without any time passing, after which it has hung. Some hundred are normal where many events meet.
const ROUNDS_AT_ONE_INSTANT: u32 = 100_000;

/// In the factory's part of the flash: what the part says of itself.
const UNIQUE_ID: (u64, &[u8; 12]) = (0x1FFF_7A10, b"emulated-427");
const FLASH_KIB: (u64, [u8; 2]) = (0x1FFF_7A22, 2048_u16.to_le_bytes());

/// What the machine is set up with.
#[derive(Debug, Clone, Copy)]
pub(super) struct Setup {
    pub(super) crystal_hz: u64,
    pub(super) stop_at_traps: bool,
}

/// See the module.
pub(super) struct Machine {
    // Declared before `surroundings`, whose memory it points into: fields are dropped in this order.
    core: Box<dyn Processor>,
    surroundings: Surroundings,
    session: Session<Bench>,
    image: Image,
    setup: Setup,
    handlers: Handlers,
    /// The processor's state right after power-on. Loading it is far cheaper than a reset of the emulator's, which drops all translated code.
    fresh: Vec<u8>,
    resets_seen: usize,
}

impl fmt::Debug for Machine {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Machine").field("now_ns", &self.now_ns()).finish_non_exhaustive()
    }
}

fn failed(error: &dyn fmt::Display) -> TargetFault {
    TargetFault::Emulator(error.to_string())
}

fn session(setup: Setup) -> Result<Session<Bench>, TargetFault> {
    let bench = Bench::new(setup.crystal_hz).map_err(|error| failed(&error))?;
    Session::new(Box::new(bench), 0, NO_DEADLINE).map_err(|error| failed(&error))
}

impl Machine {
    /// A board with `image` in its flash, switched on.
    pub(super) fn new(image: Image, setup: Setup) -> Result<Self, TargetFault> {
        let mut session = session(setup)?;
        let mut targets = session.board_mut().targets();
        let target = targets.pop().ok_or_else(|| failed(&"the board has no processor"))?;
        let mut core = (target.core.processor)(target.mcu.cpu().endian).map_err(|error| failed(&error))?;
        let mut memory = Memory::new(target.mcu.bus().memory(), &target.core.aliases);
        let boot = target.core.boot.reset;
        drop(targets);
        map_into(&memory, &mut *core)?;

        let segments = image.segments.iter().map(|segment| (segment.address, &*segment.bytes));
        for (address, bytes) in segments.chain([(UNIQUE_ID.0, &UNIQUE_ID.1[..]), (FLASH_KIB.0, &FLASH_KIB.1[..])]) {
            if !memory.place(address, bytes) {
                return Err(failed(&format_args!("no memory of {} bytes at {address:#010x}", bytes.len())));
            }
        }
        let handlers = if setup.stop_at_traps { Handlers::of(&memory, &image) } else { Handlers::none() };
        handlers.watch(&mut *core);
        let mut surroundings = Surroundings::new(memory, INSTRUCTIONS_PER_SECOND);
        surroundings.tell(&mut *core);
        core.boot(boot, &|address, width| surroundings.memory.value(address, width));
        let fresh = core.save();
        let mut machine = Self { core, surroundings, session, image, setup, handlers, fresh, resets_seen: 0 };
        machine.power_on()?;
        Ok(machine)
    }

    fn stop(&mut self, reason: StopReason) {
        let instruction_count = self.core.retired();
        let stop = Stop { at: self.surroundings.time(instruction_count), instruction_count, reason };
        self.surroundings.deadline = self.session.stop(stop, &mut self.surroundings);
        self.surroundings.tell(&mut *self.core);
    }

    /// The processor's part of a reset; the models have had theirs.
    fn restart_core(&mut self) {
        let Self { core, surroundings, .. } = self;
        core.reset();
        core.boot(super::image::FLASH_START, &|address, width| surroundings.memory.value(address, width));
    }

    fn symbols(&self) -> Symbols {
        Symbols::read(&self.image.elf)
    }

    fn place(&self) -> Place {
        self.symbols().place(self.core.pc() as u32)
    }

    fn frame_ended(&mut self) -> bool {
        self.session.board_mut().wire().is_some_and(|wire| std::mem::take(&mut wire.frames) > 0)
    }

    /// What must end a trial although the firmware goes on.
    fn check(&mut self) -> Result<(), TargetFault> {
        if let Some(error) = self.session.take_error() {
            return Err(failed(&error));
        }
        if let Some(gap) = post_mortem::gap(&self.session, &self.image) {
            return Err(TargetFault::Unsupported(gap));
        }
        // Without traps as stops, a reset is what a board does too.
        let resets = self.session.resets();
        if let Some(reset) = resets.get(self.resets_seen) {
            let (cause, at_us) = (post_mortem::reset_cause(reset.cause), reset.at.0 / 1_000);
            self.resets_seen = resets.len();
            if self.setup.stop_at_traps {
                return Err(TargetFault::Reset { cause, at_us, place: self.place() });
            }
        }
        Ok(())
    }

    /// One round: to the next event, or until the processor comes back by itself.
    fn step(&mut self) -> Result<(), TargetFault> {
        let target = self.surroundings.next(self.core.next_event());
        let budget = self.surroundings.instructions_until(self.core.retired(), target);
        let mut lent = Lent { surroundings: &mut self.surroundings, session: &mut self.session };
        let (exit, ran) = self.core.run(budget, &mut lent);
        self.surroundings.tell(&mut *self.core);
        match exit {
            Exit::Breakpoint => {
                let pc = self.core.pc();
                let trap = self.handlers.trap(&mut *self.core, &self.surroundings, &mut self.session, &self.image);
                if let Some(trap) = trap {
                    return Err(TargetFault::Trap(Box::new(trap)));
                }
                self.core.pass_breakpoint(pc);
            }
            // Semihosting without a debugger: the instruction does nothing.
            Exit::HostCall => self.core.answer_host_call(None),
            Exit::Lockup => return Err(TargetFault::Lockup(self.place())),
            _ => {}
        }
        if ran == 0 && self.core.waiting() {
            let now = self.surroundings.time(self.core.retired());
            let target = self.surroundings.next(self.core.next_event());
            if target > now && target != NO_DEADLINE {
                self.surroundings.slept_ns += target.0 - now.0;
            }
        }
        Ok(())
    }
}

#[allow(unsafe_code, reason = "the processor is given pointers to the memory")]
fn map_into(memory: &Memory, core: &mut dyn Processor) -> Result<(), TargetFault> {
    // SAFETY: `Machine::new` moves both into a `Machine`, which drops its processor first; the pages do not move with them. `Memory`'s borrows end
    // before the processor runs, or begin in a callback while it stands still and end with it.
    unsafe { memory::map(memory, core) }.map_err(|problem| failed(&problem))
}

impl Target for Machine {
    fn power_on(&mut self) -> Result<(), TargetFault> {
        self.session = session(self.setup)?;
        let _ = self.core.take_reset_request();
        self.core.load(&self.fresh).map_err(|error| failed(&error))?;
        self.surroundings.forget();
        self.surroundings.tell(&mut *self.core);
        self.surroundings.deadline = self.session.next_deadline();
        self.resets_seen = 0;
        Ok(())
    }

    fn came_up(&mut self) {
        self.session.board_mut().part.came_up = true;
    }

    fn now_ns(&self) -> u64 {
        self.surroundings.time(self.core.retired()).0
    }

    fn instructions(&self) -> u64 {
        self.core.retired()
    }

    fn send(&mut self, bytes: &[u8]) {
        let now = VirtualNanos(self.now_ns());
        let bench = self.session.board_mut();
        if let Some(wire) = bench.wire() {
            wire.to_target.extend(bytes);
            bench.part.bytes_wait = true;
        }
        let instructions = self.core.retired();
        self.surroundings.deadline = self.session.resume(NO_DEADLINE, now, instructions, &mut self.surroundings);
        self.surroundings.tell(&mut *self.core);
    }

    fn run(&mut self, until_ns: u64) -> Result<bool, TargetFault> {
        let until = VirtualNanos(until_ns);
        self.session.run_until(until);
        self.surroundings.deadline = self.session.next_deadline();
        let mut instant = (VirtualNanos(u64::MAX), 0);
        loop {
            let now = self.surroundings.time(self.core.retired());
            instant = if instant.0 == now { (now, instant.1 + 1) } else { (now, 0) };
            if instant.1 > ROUNDS_AT_ONE_INSTANT {
                return Err(failed(&format_args!("time stands still at {} ns, {}", now.0, self.place())));
            }
            if std::mem::take(&mut self.surroundings.restart) {
                self.restart_core();
                self.check()?;
            } else if self.core.take_reset_request() {
                self.stop(StopReason::Reset);
                self.restart_core();
                self.check()?;
            } else if self.core.next_event().is_some_and(|event| event <= now) {
                self.core.on_event(now);
            } else if now >= self.surroundings.deadline {
                self.stop(if self.core.waiting() { StopReason::Idle } else { StopReason::Deadline });
                if self.frame_ended() {
                    self.check()?;
                    return Ok(true);
                }
                if now >= until && !self.surroundings.restart {
                    self.check()?;
                    return Ok(false);
                }
            } else {
                self.step()?;
            }
        }
    }

    fn take_heard(&mut self, into: &mut Vec<Heard>) {
        if let Some(wire) = self.session.board_mut().wire() {
            into.append(&mut wire.heard);
        }
    }

    fn whereabouts(&self) -> Whereabouts {
        Whereabouts { place: self.place(), instances: self.session.board().part.touched() }
    }

    fn stack_used(&self) -> Option<u32> {
        let symbols = self.symbols();
        let top = self.image.initial_stack;
        let bottom = u32::try_from(symbols.address("_stack_end")?).ok()?;
        let memory = self.surroundings.memory.slice(u64::from(bottom), top.checked_sub(bottom)? as usize)?;
        let unused = memory.iter().take_while(|&&byte| byte == UNKNOWN).count();
        u32::try_from(memory.len() - unused).ok()
    }
}
