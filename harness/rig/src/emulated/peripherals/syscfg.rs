//! System configuration (RM0090, chapter 9): registers, without an effect on memory.

use super::{Model, Registers, snapshot};
use rigless::device::DeviceContext;
use rigless::snapshot::{Reader, Store, Writer};

const MEM_MODE: u64 = 0b111;

#[derive(Debug)]
pub(super) struct SystemConfiguration;

impl Store for SystemConfiguration {
    fn store(&self, _: &mut Writer) -> Result<(), snapshot::Error> {
        Ok(())
    }

    fn load(&mut self, _: &mut Reader) -> Result<(), snapshot::Error> {
        Ok(())
    }
}

impl Model for SystemConfiguration {
    fn write(&mut self, register: &str, value: u64, _: &mut Registers<'_>, context: &mut DeviceContext<'_>) {
        if register == "MEMRM" && value & MEM_MODE != 0 {
            context.tell("MEMRM", "another memory at address 0 than flash is not modelled");
        }
    }
}
