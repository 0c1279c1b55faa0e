//! CRC calculation unit (RM0090, chapter 4): CRC-32 over words, most significant bit first.

use super::{Model, Registers, snapshot, store_fields};
use rigless::device::DeviceContext;
use rigless::snapshot::{Reader, Store, Writer};

const POLYNOMIAL: u32 = 0x04C1_1DB7;
const INITIAL: u32 = u32::MAX;

#[derive(Debug)]
pub(super) struct Checksum {
    value: u32,
}

store_fields!(Checksum { value });

impl Default for Checksum {
    fn default() -> Self {
        Self { value: INITIAL }
    }
}

impl Model for Checksum {
    fn write(&mut self, register: &str, value: u64, registers: &mut Registers<'_>, _: &mut DeviceContext<'_>) {
        match register {
            "DR" => {
                self.value = (0..u32::BITS).fold(self.value ^ value as u32, |crc, _| {
                    if crc >> 31 == 0 { crc << 1 } else { crc << 1 ^ POLYNOMIAL }
                });
            }
            "CR" if value & 1 != 0 => self.value = INITIAL,
            _ => {}
        }
        registers.set("DR", self.value.into());
    }

    fn reset(&mut self) {
        *self = Self::default();
    }
}
