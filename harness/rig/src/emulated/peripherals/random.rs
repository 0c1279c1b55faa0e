//! Random numbers (RM0090, chapter 24) from a fixed seed, so that equal trials give equal bytes.

use super::{Model, Registers, snapshot, store_fields};
use rigless::device::DeviceContext;
use rigless::snapshot::{Reader, Store, Writer};

const ENABLE: u32 = 2;
const INTERRUPT: u32 = 3;
const READY: u64 = 1;
const LINE: usize = 0;
const SEED: u32 = 0x2545_F491;

#[derive(Debug)]
pub(super) struct RandomNumbers {
    state: u32,
}

store_fields!(RandomNumbers { state });

impl Default for RandomNumbers {
    fn default() -> Self {
        Self { state: SEED }
    }
}

impl Model for RandomNumbers {
    fn read(&mut self, register: &str, registers: &mut Registers<'_>, _: &mut DeviceContext<'_>) -> Option<u64> {
        let is_enabled = registers.is_set("CR", ENABLE);
        match register {
            "SR" => Some(if is_enabled { READY } else { 0 }),
            "DR" if is_enabled => {
                // Marsaglia, Xorshift RNGs (2003).
                self.state ^= self.state << 13;
                self.state ^= self.state >> 17;
                self.state ^= self.state << 5;
                Some(self.state.into())
            }
            _ => None,
        }
    }

    fn write(&mut self, _: &str, _: u64, registers: &mut Registers<'_>, context: &mut DeviceContext<'_>) {
        if registers.is_set("CR", ENABLE) && registers.is_set("CR", INTERRUPT) {
            context.raise(LINE);
        } else {
            context.lower(LINE);
        }
    }

    fn reset(&mut self) {
        *self = Self::default();
    }
}
