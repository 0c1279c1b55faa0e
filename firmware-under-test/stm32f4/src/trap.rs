//! Panic and `HardFault`: 0 V, then a fault report on the line, then the watchdog.
//!
//! The report is kept over the reset, so that the start after it can tell what the watchdog ended. A panic has no faulting instruction: its `pc` is where the
//! handler was called from, its `address` that of the panic's `core::panic::Location` in the image.

use crate::{clock, line, output, pac};
use core::arch::global_asm;
use core::cell::UnsafeCell;
use core::mem::MaybeUninit;
use core::panic::PanicInfo;
use cortex_m::peripheral::SCB;
use platebench_wire::{FaultReport, Message, Packet};

const PANIC: u16 = 1;
const HARD_FAULT: u16 = 2;
const WATCHDOG: u16 = 3;

const STACKING_FAILED: u32 = 1 << 12 | 1 << 4;
const BUS_ADDRESS_VALID: u32 = 1 << 15;
const MEMORY_ADDRESS_VALID: u32 = 1 << 7;
const MARK: u32 = 0x504C_4154;

/// The last report and a mark, in memory that a start leaves alone.
struct Kept(UnsafeCell<MaybeUninit<[u32; 5]>>);
// SAFETY: touched once at the start and once after everything else has stopped.
unsafe impl Sync for Kept {}
#[unsafe(link_section = ".uninit.trap")]
static KEPT: Kept = Kept(UnsafeCell::new(MaybeUninit::uninit()));

/// A stack for when the stack is what failed.
#[repr(C, align(8))]
struct Spare(UnsafeCell<[u8; SPARE]>);
// SAFETY: used by the fault handler alone, which never returns.
unsafe impl Sync for Spare {}
const SPARE: usize = 2_048;
static SPARE_STACK: Spare = Spare(UnsafeCell::new([0; SPARE]));

/// Division by zero traps. Unaligned access does not: the compiler makes use of it.
pub(crate) fn arm(scb: &mut SCB) {
    // SAFETY: DIV_0_TRP.
    unsafe { scb.ccr.modify(|ccr| ccr | 1 << 4) };
}

/// Where the watchdog ended the run before this one: what was known about it.
pub(crate) fn before_this_start(p: &pac::Peripherals) -> Option<FaultReport> {
    // SAFETY: any bits are a valid array of numbers; volatile, since the compiler must not reason about a value that nobody wrote.
    let [mark, pc, lr, cfsr, address] = unsafe { KEPT.0.get().cast::<[u32; 5]>().read_volatile() };
    // SAFETY: as above.
    unsafe { KEPT.0.get().cast::<u32>().write_volatile(0) };
    if !clock::was_watchdog_reset(p) {
        return None;
    }
    let unknown = FaultReport { code: WATCHDOG, pc: 0, lr: 0, cfsr: 0, address: 0 };
    Some(if mark == MARK { FaultReport { pc, lr, cfsr, address, ..unknown } } else { unknown })
}

// The handler is entered on a stack that may be the trouble: it takes the spare one before its first push.
global_asm!(
    ".section .HardFault.user, \"ax\"",
    ".global HardFault",
    ".type HardFault,%function",
    ".thumb_func",
    "HardFault:",
    "tst lr, #4",
    "ite eq",
    "mrseq r0, msp",
    "mrsne r0, psp",
    "ldr r2, ={spare}",
    "add r2, r2, #{size}",
    "msr msp, r2",
    "b {handler}",
    ".ltorg",
    ".size HardFault, . - HardFault",
    // cortex-m-rt's linker script asks for this name.
    ".global HardFaultTrampoline",
    ".equ HardFaultTrampoline, HardFault",
    spare = sym SPARE_STACK,
    size = const SPARE,
    handler = sym on_hard_fault,
);

/// `frame` is where the processor stored, or failed to store, r0 to r3, r12, lr, pc and xpsr.
extern "C" fn on_hard_fault(frame: *const u32) -> ! {
    output::off();
    // SAFETY: reads of the fault status registers.
    let (cfsr, mmfar, bfar) = unsafe {
        let scb = &*SCB::PTR;
        (scb.cfsr.read(), scb.mmfar.read(), scb.bfar.read())
    };
    let in_ram = (0x2000_0000..=0x2001_C000 - 32).contains(&(frame as usize));
    let (lr, pc) = if in_ram && cfsr & STACKING_FAILED == 0 {
        // SAFETY: eight words in SRAM, as just checked.
        unsafe { (frame.add(5).read_volatile(), frame.add(6).read_volatile()) }
    } else {
        (0, 0)
    };
    let address = if cfsr & BUS_ADDRESS_VALID != 0 {
        bfar
    } else if cfsr & MEMORY_ADDRESS_VALID != 0 {
        mmfar
    } else {
        0
    };
    report(FaultReport { code: HARD_FAULT, pc, lr, cfsr, address })
}

#[panic_handler]
fn panic(info: &PanicInfo<'_>) -> ! {
    cortex_m::interrupt::disable();
    output::off();
    let lr: u32;
    // SAFETY: copies a register.
    unsafe { core::arch::asm!("mov {}, lr", out(reg) lr, options(nomem, nostack, preserves_flags)) };
    let address = info.location().map_or(0, |location| core::ptr::from_ref(location) as u32);
    report(FaultReport { code: PANIC, pc: lr & !1, lr, cfsr: 0, address })
}

/// Keeps the report, says it once and waits for the watchdog, which nobody feeds any more.
fn report(report: FaultReport) -> ! {
    // SAFETY: nothing else runs any more.
    unsafe {
        KEPT.0.get().cast::<[u32; 5]>().write_volatile([MARK, report.pc, report.lr, report.cfsr, report.address]);
    }
    line::send_by_hand(Packet { sequence: 0, message: Message::Fault(report) }.encode().as_bytes());
    loop {
        core::hint::spin_loop();
    }
}
