//! Causes fault n if a sample has the setpoint `900 + n` µm; the bench's tests use these faults.

use core::arch::asm;
use core::hint::black_box;
use platebench_wire::{FrameReader, Message, Packet};
use stm32f4::stm32f405 as pac;

const FIRST: f32 = 900.0;

pub(crate) struct SampleWatcher(FrameReader);

impl SampleWatcher {
    pub(crate) fn new() -> Self {
        Self(FrameReader::new())
    }

    pub(crate) fn watch(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            let Some(Ok(body)) = self.0.push(byte) else { continue };
            if let Ok(Packet { message: Message::Sample(sample), .. }) = Packet::decode(body) {
                let which = sample.setpoint_um - FIRST;
                if (1.0..=12.0).contains(&which) {
                    trigger(which as u8);
                }
            }
        }
    }
}

// Each fault has its own function, because the fault report shows the name. Different constants
// prevent the linker from merging two functions.
fn trigger(which: u8) {
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
    // SAFETY: traps as intended.
    unsafe { asm!("ldrd {0}, {1}, [{2}]", out(reg) _, out(reg) _, in(reg) 0x2000_4002_u32) };
}

#[inline(never)]
fn division_by_zero() {
    // SAFETY: traps as intended.
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
    // SAFETY: traps as intended.
    unsafe { asm!("udf #7") };
}

#[inline(never)]
fn index_out_of_bounds() {
    black_box([1_u8, 2, 3][black_box(7_usize)]);
}

#[inline(never)]
fn read_of_nothing() {
    // SAFETY: traps as intended: this bank has no memory.
    black_box(unsafe { (0x6000_0000 as *const u32).read_volatile() });
}

#[inline(never)]
fn jump_into_nothing() {
    // SAFETY: traps as intended.
    unsafe { asm!("blx {0}", in(reg) 0x3000_0001_u32, out("lr") _) };
}

#[inline(never)]
fn unmodelled_peripheral() {
    // SAFETY: nothing else uses TIM6; harmless on a board, not modelled by the emulator.
    unsafe {
        (*pac::RCC::ptr()).apb1enr().modify(|r, w| w.bits(r.bits() | 1 << 4));
        (*pac::TIM6::ptr()).arr().write(|w| w.bits(9));
    }
}

#[inline(never)]
fn hole_between_peripherals() {
    // SAFETY: traps as intended.
    black_box(unsafe { (0x4000_2400 as *const u32).read_volatile() });
}

#[inline(never)]
fn sleep_without_end() {
    cortex_m::interrupt::disable();
    loop {
        // A pending masked interrupt ends the sleep, so the loop sleeps again.
        cortex_m::asm::wfi();
    }
}
