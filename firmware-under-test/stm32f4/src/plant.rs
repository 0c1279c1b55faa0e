//! Faults on demand, for the bench's own tests: a sample with setpoint `900 + n` µm does what `misbehave` has under n.

use core::arch::asm;
use core::hint::black_box;
use platebench_wire::{FrameReader, Message, Packet};

const FIRST: f32 = 900.0;

/// Watches the line for samples that ask for a fault.
pub(crate) struct Planted(FrameReader);

impl Planted {
    pub(crate) fn new() -> Self {
        Self(FrameReader::new())
    }

    pub(crate) fn watch(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            let Some(Ok(body)) = self.0.push(byte) else { continue };
            if let Ok(Packet { message: Message::Sample(sample), .. }) = Packet::decode(body) {
                let which = sample.setpoint_um - FIRST;
                if (1.0..=12.0).contains(&which) {
                    misbehave(which as u8);
                }
            }
        }
    }
}

// Every fault has a function of its own with a name that a report can show; the differing constants keep the linker from folding two into one.
fn misbehave(which: u8) {
    match which {
        1 => unaligned_access(),
        2 => division_by_zero(),
        3 => endless_loop(),
        4 => drop(black_box(stack_overflow(1))),
        5 => undefined_instruction(),
        6 => index_out_of_bounds(),
        7 => read_of_nothing(),
        8 => jump_into_nothing(),
        9 => unmodelled_peripheral(),
        10 => hole_between_peripherals(),
        11 => cortex_m::peripheral::SCB::sys_reset(),
        _ => sleep_without_end(),
    }
}

#[inline(never)]
fn unaligned_access() {
    // SAFETY: traps, as it is meant to.
    unsafe { asm!("ldrd {0}, {1}, [{2}]", out(reg) _, out(reg) _, in(reg) 0x2000_4002_u32) };
}

#[inline(never)]
fn division_by_zero() {
    // SAFETY: traps, as it is meant to.
    unsafe { asm!("sdiv {0}, {1}, {2}", out(reg) _, in(reg) 5, in(reg) 0) };
}

#[inline(never)]
fn endless_loop() {
    loop {
        core::hint::spin_loop();
    }
}

#[inline(never)]
#[allow(unconditional_recursion)]
fn stack_overflow(depth: u32) -> u32 {
    let pad = black_box([depth; 32]);
    stack_overflow(depth + 1) + pad[(depth % 32) as usize]
}

#[inline(never)]
fn undefined_instruction() {
    // SAFETY: traps, as it is meant to.
    unsafe { asm!("udf #7") };
}

#[inline(never)]
fn index_out_of_bounds() {
    black_box([1_u8, 2, 3][black_box(7_usize)]);
}

#[inline(never)]
fn read_of_nothing() {
    // SAFETY: traps, as it is meant to: no memory is wired to this bank.
    black_box(unsafe { (0x6000_0000 as *const u32).read_volatile() });
}

#[inline(never)]
fn jump_into_nothing() {
    // SAFETY: traps, as it is meant to.
    unsafe { asm!("blx {0}", in(reg) 0x3000_0001_u32, out("lr") _) };
}

#[inline(never)]
fn unmodelled_peripheral() {
    // SAFETY: TIM6 and its clock, which nothing else uses; harmless on a board, unknown to the emulator.
    unsafe {
        (*crate::pac::RCC::ptr()).apb1enr().modify(|r, w| w.bits(r.bits() | 1 << 4));
        (*crate::pac::TIM6::ptr()).arr().write(|w| w.bits(9));
    }
}

#[inline(never)]
fn hole_between_peripherals() {
    // SAFETY: traps, as it is meant to.
    black_box(unsafe { (0x4000_2400 as *const u32).read_volatile() });
}

#[inline(never)]
fn sleep_without_end() {
    cortex_m::interrupt::disable();
    loop {
        // With interrupts masked a pending one ends the sleep, so this one polls at once again.
        cortex_m::asm::wfi();
    }
}
