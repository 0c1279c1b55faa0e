//! Drives the board's outputs.
//!
//! With a bench, drive and frequency travel as a [`Command`] on the line, which replaces the
//! converters. Every board has PB0, *amplifier enable*: high while the controller runs, low in
//! every other state, low after reset (the amplifier needs a pull-down), and low first in a fault
//! handler.
//!
//! A board with converters extends [`Output::apply`]: `drive_vpp` to the DAC or the amplitude
//! register of a synthesiser, `frequency_mhz` to its tuning word. [`off`] must then silence the
//! converters too, with plain register writes, since it runs in the fault handlers.

use platebench_wire::{Command, ControllerState};
use stm32f4::stm32f405 as pac;

const ENABLE: u32 = 1 << 0;

/// The board's outputs, off.
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

    /// Applies the controller's state.
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

/// Sets 0 V; safe in every state, with almost no stack.
pub(crate) fn off() {
    // SAFETY: one store that clears only PB0.
    unsafe { (*pac::GPIOB::ptr()).bsrr().write(|w| w.bits(ENABLE << 16)) };
}
