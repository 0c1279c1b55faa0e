//! Drives the board's outputs.
//!
//! The board has no converters, so drive and frequency go to the bench as a [`Command`]. PB0,
//! *amplifier enable*, is high while the controller runs, and low in every other state and after
//! reset (the amplifier needs a pull-down). A fault handler sets it low first. A board with
//! converters extends [`Output::apply`], and [`off`] for 0 V by plain register writes.

use platebench_wire::{Command, ControllerState};
use stm32f4::stm32f405 as pac;

const ENABLE: u32 = 1 << 0;

pub(crate) struct Output {
    running: bool,
}

impl Output {
    pub(crate) fn new(p: &pac::Peripherals) -> Self {
        // SAFETY: the reset value with GPIOB's clock added; the pin goes low before it becomes an
        // output.
        unsafe {
            p.RCC.ahb1enr().modify(|r, w| w.bits(r.bits() | 1 << 1));
            p.GPIOB.bsrr().write(|w| w.bits(ENABLE << 16));
            p.GPIOB.moder().modify(|r, w| w.bits(r.bits() & !0b11 | 0b01));
        }
        Self { running: false }
    }

    pub(crate) fn apply(&mut self, p: &pac::Peripherals, command: &Command) {
        let running = command.state == ControllerState::Running;
        if running != self.running {
            self.running = running;
            let bits = if running { ENABLE } else { ENABLE << 16 };
            // SAFETY: sets or clears only PB0.
            p.GPIOB.bsrr().write(|w| unsafe { w.bits(bits) });
        }
    }
}

/// Disables the amplifier; safe in every state, with almost no stack.
pub(crate) fn off() {
    // SAFETY: one store that clears only PB0.
    unsafe { (*pac::GPIOB::ptr()).bsrr().write(|w| w.bits(ENABLE << 16)) };
}
