//! External interrupts (RM0090, chapter 12): registers and software interrupts. No edge comes to a pin.

use super::{Model, Registers, snapshot, store_fields};
use rigless::device::DeviceContext;
use rigless::snapshot::{Reader, Store, Writer};
use rigless::soc::stm32f427::generated::EXTI;

/// Interrupts and the lines that raise them (RM0090, table 62).
const GROUPS: [(u16, u64); 8] =
    [(6, 1 << 0), (7, 1 << 1), (8, 1 << 2), (9, 1 << 3), (10, 1 << 4), (23, 0x1F << 5), (40, 0x3F << 10), (2, 1 << 21)];

#[derive(Debug, Default)]
pub(super) struct ExternalInterrupts {
    pending: u64,
    requested: u64,
}

store_fields!(ExternalInterrupts { pending, requested });

impl Model for ExternalInterrupts {
    fn write(&mut self, register: &str, value: u64, registers: &mut Registers<'_>, context: &mut DeviceContext<'_>) {
        match register {
            "SWIER" => {
                self.pending |= value & !self.requested & registers.get("IMR");
                self.requested |= value;
            }
            "PR" => {
                self.pending &= !value;
                self.requested &= !value;
            }
            _ => {}
        }
        registers.set("PR", self.pending);
        registers.set("SWIER", self.requested);
        let active = self.pending & registers.get("IMR");
        for (number, lines) in GROUPS {
            let Some(position) = EXTI.interrupts.iter().position(|&other| other == number) else { continue };
            if active & lines == 0 {
                context.lower(position);
            } else {
                context.raise(position);
            }
        }
    }

    fn reset(&mut self) {
        *self = Self::default();
    }
}
