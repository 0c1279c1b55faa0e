//! What leaves the board besides the line.
//!
//! In the loop with a bench, drive and frequency travel as a [`Command`] and the bench's plate takes them from there: the line stands in for the converters. The one
//! thing that is real on every board is PB0, *amplifier enable*: high while the controller runs, low in every other state, low from reset on (a pull-down on the
//! amplifier's side is expected) and low before anything else when the processor traps.
//!
//! A board with its own converters has its place in [`Output::apply`]: `drive_vpp` to the DAC or to the amplitude register of a synthesiser, `frequency_mhz` to its
//! tuning word, and [`off`] then has to silence that as well, with plain register writes, since it runs in the fault handlers.

use crate::pac;
use platebench_wire::{Command, State};

const ENABLE: u32 = 1 << 0;

/// The board's outputs, off.
pub(crate) struct Output {
    running: bool,
}

impl Output {
    pub(crate) fn new(p: &pac::Peripherals) -> Self {
        // SAFETY: the reset value with GPIOB's clock added; the pin goes low before it becomes an output.
        unsafe {
            p.RCC.ahb1enr().modify(|r, w| w.bits(r.bits() | 1 << 1));
            p.GPIOB.bsrr().write(|w| w.bits(ENABLE << 16));
            p.GPIOB.moder().modify(|r, w| w.bits(r.bits() & !0b11 | 0b01));
        }
        Self { running: false }
    }

    /// Follows the controller; cheap when nothing changed.
    pub(crate) fn apply(&mut self, p: &pac::Peripherals, command: &Command) {
        let running = command.state == State::Running;
        if running != self.running {
            self.running = running;
            let bits = if running { ENABLE } else { ENABLE << 16 };
            // SAFETY: sets or clears PB0 alone.
            p.GPIOB.bsrr().write(|w| unsafe { w.bits(bits) });
        }
    }
}

/// 0 V, from any state and without a stack worth speaking of.
pub(crate) fn off() {
    // SAFETY: one store that clears PB0 alone, harmless at any time.
    unsafe { (*pac::GPIOB::ptr()).bsrr().write(|w| w.bits(ENABLE << 16)) };
}
