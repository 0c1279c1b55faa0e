//! Digital-to-analogue converter (RM0090, chapter 14) as a store of registers. A value without a trigger
//! is at once in the output register. The bench does not read it: commands go over the line.

use super::{Model, Registers, snapshot};
use rigless::device::DeviceContext;
use rigless::snapshot::{Reader, Store, Writer};

#[derive(Debug)]
pub(super) struct Converter;

impl Store for Converter {
    fn store(&self, _: &mut Writer) -> Result<(), snapshot::Error> {
        Ok(())
    }

    fn load(&mut self, _: &mut Reader) -> Result<(), snapshot::Error> {
        Ok(())
    }
}

/// Trigger enable bits of both channels in CR.
const TRIGGERED: [(&str, u32); 2] = [("DOR1", 2), ("DOR2", 18)];

/// Outputs of both channels after a write to a holding register; `None` for an unchanged one.
fn outputs(register: &str, value: u64) -> [Option<u64>; 2] {
    let twelve = |value: u64| Some(value & 0xFFF);
    let eight = |value: u64| Some((value & 0xFF) << 4);
    match register {
        "DHR12R1" => [twelve(value), None],
        "DHR12L1" => [twelve(value >> 4), None],
        "DHR8R1" => [eight(value), None],
        "DHR12R2" => [None, twelve(value)],
        "DHR12L2" => [None, twelve(value >> 4)],
        "DHR8R2" => [None, eight(value)],
        "DHR12RD" => [twelve(value), twelve(value >> 16)],
        "DHR12LD" => [twelve(value >> 4), twelve(value >> 20)],
        "DHR8RD" => [eight(value), eight(value >> 8)],
        _ => [None, None],
    }
}

impl Model for Converter {
    fn write(&mut self, register: &str, value: u64, registers: &mut Registers<'_>, _: &mut DeviceContext<'_>) {
        for ((output, trigger), value) in TRIGGERED.into_iter().zip(outputs(register, value)) {
            if let Some(value) = value.filter(|_| !registers.is_set("CR", trigger)) {
                registers.set(output, value);
            }
        }
    }
}
