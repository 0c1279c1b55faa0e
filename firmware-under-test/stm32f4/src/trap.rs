//! Handles a panic and a `HardFault`: 0 V, then a fault report on the line, then the watchdog's
//! reset.
//!
//! The report survives the reset. A panic has no faulting instruction: its `pc` is the caller of
//! the handler, and its `address` is that of the panic's `core::panic::Location` in the image.

use crate::{clock, line, output};
use core::arch::global_asm;
use core::cell::UnsafeCell;
use core::mem::MaybeUninit;
use core::panic::PanicInfo;
use cortex_m::peripheral::SCB;
use platebench_wire::{FaultReport, Message, Packet};
use stm32f4::stm32f405 as pac;

const PANIC: u16 = 1;
const HARD_FAULT: u16 = 2;
const WATCHDOG: u16 = 3;

const STACKING_FAILED: u32 = 1 << 12 | 1 << 4;
const BUS_ADDRESS_VALID: u32 = 1 << 15;
const MEMORY_ADDRESS_VALID: u32 = 1 << 7;
const MARK: u32 = 0x504C_4154;

/// `MARK` and the last report, in memory that the start-up code does not clear.
struct SavedReport(UnsafeCell<MaybeUninit<[u32; 5]>>);
// SAFETY: accessed once at the start and once after all other code has stopped.
unsafe impl Sync for SavedReport {}
#[unsafe(link_section = ".uninit.trap")]
static SAVED: SavedReport = SavedReport(UnsafeCell::new(MaybeUninit::uninit()));

/// Stack of the fault handler, because the normal one may have overflowed.
#[repr(C, align(8))]
struct FaultStack(UnsafeCell<[u8; FAULT_STACK_BYTES]>);
// SAFETY: only the fault handler uses it, and it never returns.
unsafe impl Sync for FaultStack {}
const FAULT_STACK_BYTES: usize = 2_048;
static FAULT_STACK: FaultStack = FaultStack(UnsafeCell::new([0; FAULT_STACK_BYTES]));

/// The trap for unaligned access stays off, because the compiler generates such accesses.
pub(crate) fn enable_division_trap(scb: &mut SCB) {
    // SAFETY: DIV_0_TRP.
    unsafe { scb.ccr.modify(|ccr| ccr | 1 << 4) };
}

pub(crate) fn report_before_reset(p: &pac::Peripherals) -> Option<FaultReport> {
    // SAFETY: any bits are a valid array of numbers; volatile, since the program has not
    // initialised it.
    let [mark, pc, lr, cfsr, address] = unsafe { SAVED.0.get().cast::<[u32; 5]>().read_volatile() };
    // SAFETY: as above.
    unsafe { SAVED.0.get().cast::<u32>().write_volatile(0) };
    if !clock::was_watchdog_reset(p) {
        return None;
    }
    let unknown = FaultReport { code: WATCHDOG, pc: 0, lr: 0, cfsr: 0, address: 0 };
    Some(if mark == MARK { FaultReport { pc, lr, cfsr, address, ..unknown } } else { unknown })
}

// A stack overflow may be the cause, so the handler uses its own stack from its first push on.
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
    // The linker script of cortex-m-rt requires this name.
    ".global HardFaultTrampoline",
    ".equ HardFaultTrampoline, HardFault",
    spare = sym FAULT_STACK,
    size = const FAULT_STACK_BYTES,
    handler = sym on_hard_fault,
);

/// `frame` points to r0 to r3, r12, lr, pc and xpsr, unless the processor failed to store them.
extern "C" fn on_hard_fault(frame: *const u32) -> ! {
    output::off();
    // SAFETY: reads of the fault status registers.
    let (cfsr, mmfar, bfar) = unsafe {
        let scb = &*SCB::PTR;
        (scb.cfsr.read(), scb.mmfar.read(), scb.bfar.read())
    };
    let in_ram = (0x2000_0000..=0x2001_C000 - 32).contains(&(frame as usize));
    let (lr, pc) = if in_ram && cfsr & STACKING_FAILED == 0 {
        // SAFETY: eight words in SRAM, checked above.
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

fn report(report: FaultReport) -> ! {
    // SAFETY: all other code has stopped.
    unsafe {
        SAVED.0.get().cast::<[u32; 5]>().write_volatile([MARK, report.pc, report.lr, report.cfsr, report.address]);
    }
    // SAFETY: all other code has stopped.
    let p = unsafe { pac::Peripherals::steal() };
    clock::lengthen_watchdog(&p);
    line::send_by_polling(Packet { sequence: 0, message: Message::Fault(report) }.encode().as_bytes());
    loop {
        core::hint::spin_loop();
    }
}
