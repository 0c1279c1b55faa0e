//! Watches accesses to instances of the chip without a model. A write changes nothing that the
//! bench models, so it is only counted. A read ends the trial if a board may return another value.

use platebench_model::record::UnmodelledInstance;
use rigless::emulator::{Access, AccessKind};
use rigless::session::Unimplemented;
use rigless::snapshot::{self, Reader, Store, Writer};
use rigless::soc::{self, Peripheral};

/// Ends of the names of control registers, without digits. They keep what is written.
const CONTROL_REGISTERS: [&str; 3] = ["CR", "BTR", "IER"];

#[derive(Debug)]
pub(super) struct InstancesWithoutModel {
    has_model: Box<[bool]>,
    /// True if the firmware wrote to the instance since its reset, by slot. Before, it has the
    /// reset values of a board.
    is_changed: Box<[bool]>,
    /// Address and instruction of the first read that a board may answer with another value.
    pub(super) doubtful_read: Option<(u64, u64)>,
}

impl InstancesWithoutModel {
    /// `has_model` in the order of the slots.
    pub(super) fn new(has_model: impl Iterator<Item = bool>) -> Self {
        let has_model: Box<[bool]> = has_model.collect();
        let is_changed = vec![false; has_model.len()].into_boxed_slice();
        Self { has_model, is_changed, doubtful_read: None }
    }

    pub(super) fn reset(&mut self) {
        self.is_changed.fill(false);
    }

    pub(super) fn record(&mut self, slot: usize, instance: &Peripheral, access: &Access) {
        let Some(instruction) = access.program_counter.filter(|_| self.has_model.get(slot) == Some(&false)) else {
            return;
        };
        let Some(is_changed) = self.is_changed.get_mut(slot) else { return };
        match access.kind {
            AccessKind::Write => *is_changed = true,
            AccessKind::Read if *is_changed && !keeps_written_value(instance, access.address) => {
                self.doubtful_read.get_or_insert((access.address, instruction));
            }
            AccessKind::Read => {}
        }
    }
}

impl Store for InstancesWithoutModel {
    fn store(&self, to: &mut Writer) -> Result<(), snapshot::Error> {
        to.put(&self.is_changed)
    }

    fn load(&mut self, from: &mut Reader) -> Result<(), snapshot::Error> {
        self.is_changed = from.take()?;
        self.doubtful_read = None;
        Ok(())
    }
}

/// True if `address` is a control register, in which the hardware sets no bit.
fn keeps_written_value(instance: &Peripheral, address: u64) -> bool {
    let offset = address.saturating_sub(instance.base);
    let covers = |from: u32, end: u32| (u64::from(from)..u64::from(end)).contains(&offset);
    let register = instance.registers.iter().find(|register| covers(register.offset, register.end()));
    register.is_some_and(|register| {
        let name = register.name.trim_end_matches(|letter: char| letter.is_ascii_digit());
        let is_writable = register.fields.iter().all(|field| field.access == soc::Access::ReadWrite);
        is_writable && CONTROL_REGISTERS.iter().any(|end| name.ends_with(end))
    })
}

/// One entry per instance, with its registers in the order of their addresses.
pub(super) fn count<'a>(accesses: impl Iterator<Item = &'a Unimplemented>) -> Vec<UnmodelledInstance> {
    let mut instances: Vec<UnmodelledInstance> = Vec::new();
    for access in accesses {
        let known = instances.iter_mut().find(|known| known.instance == access.instance);
        let (register, count) = (access.register.to_owned(), access.reads + access.writes);
        match known {
            Some(known) => {
                known.registers.push(register);
                known.accesses += count;
            }
            None => instances.push(UnmodelledInstance {
                instance: access.instance.to_owned(),
                registers: vec![register],
                accesses: count,
            }),
        }
    }
    instances
}
