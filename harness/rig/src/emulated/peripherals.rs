//! Models peripherals of ordinary start-up code that the emulator lacks. [`MODELS`] lists them; a model
//! is one file and one line.

mod checksum;
mod dac;
mod interrupts;
mod random;
mod syscfg;
mod timer;
mod window_watchdog;

use rigless::device::{DeviceContext, ErasedDevice, RegisterFile, RequestChange};
use rigless::snapshot::{self, Reader, Store, Writer};
use rigless::soc::stm32f427::peripherals::rcc::{Apb, Rcc};
use rigless::soc::{Bus, Layout, RegisterSpec};
use rigless::time::{EventId, VirtualNanos};
use std::fmt;

type NewModel = fn() -> Box<dyn Model>;

/// Instances and their models. RM0090, chapters 4, 9, 12, 14, 19, 20, 22 and 24.
const MODELS: [(&str, NewModel); 14] = [
    ("TIM6", || Box::new(timer::Timer::new(Apb::One))),
    ("TIM7", || Box::new(timer::Timer::new(Apb::One))),
    ("TIM9", || Box::new(timer::Timer::new(Apb::Two))),
    ("TIM10", || Box::new(timer::Timer::new(Apb::Two))),
    ("TIM11", || Box::new(timer::Timer::new(Apb::Two))),
    ("TIM12", || Box::new(timer::Timer::new(Apb::One))),
    ("TIM13", || Box::new(timer::Timer::new(Apb::One))),
    ("TIM14", || Box::new(timer::Timer::new(Apb::One))),
    ("EXTI", || Box::new(interrupts::ExternalInterrupts::default())),
    ("SYSCFG", || Box::new(syscfg::SystemConfiguration)),
    ("CRC", || Box::new(checksum::Checksum::default())),
    ("RNG", || Box::new(random::RandomNumbers::default())),
    ("WWDG", || Box::new(window_watchdog::WindowWatchdog::default())),
    ("DAC", || Box::new(dac::Converter)),
];

/// A peripheral. Registers have the names of the part's table. The register file already holds a written
/// value, except that of a write-only register.
trait Model: Store + fmt::Debug + Send {
    /// Sets reset values in which the part's table differs from the manual.
    fn initialise(&mut self, _registers: &mut Registers<'_>) {}

    /// `None` for the value in the register file.
    fn read(
        &mut self,
        _register: &str,
        _registers: &mut Registers<'_>,
        _context: &mut DeviceContext<'_>,
    ) -> Option<u64> {
        None
    }

    fn write(&mut self, register: &str, value: u64, registers: &mut Registers<'_>, context: &mut DeviceContext<'_>);

    fn on_event(&mut self, _event: EventId, _registers: &mut Registers<'_>, _context: &mut DeviceContext<'_>) {}

    fn on_clock(&mut self, _clocks: &Clocks, _registers: &mut Registers<'_>, _context: &mut DeviceContext<'_>) {}

    fn reset(&mut self) {}
}

/// Frequencies in Hz of the clocks that the models use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Clocks {
    timers: [u64; 2],
    pclk1: u64,
}

impl Clocks {
    pub(super) fn read(rcc: &Rcc, registers: &RegisterFile) -> Self {
        let timers = [Apb::One, Apb::Two].map(|apb| rcc.timer_clock(registers, apb));
        Self { timers, pclk1: rcc.pclk1(registers) }
    }

    fn timer(&self, bus: Apb) -> u64 {
        let [one, two] = self.timers;
        match bus {
            Apb::One => one,
            Apb::Two => two,
        }
    }
}

/// Registers of an instance by name. Registers that it does not have read 0.
struct Registers<'a> {
    file: &'a mut RegisterFile,
    layout: &'static [RegisterSpec],
}

/// A register of any instance.
#[derive(Debug, Clone, Copy)]
struct Row {
    index: usize,
    spec: &'static RegisterSpec,
}

impl Layout for Row {
    const REGISTERS: &'static [RegisterSpec] = &[];

    fn from_index(_: usize) -> Option<Self> {
        None
    }

    fn index(self) -> usize {
        self.index
    }

    fn spec(self) -> &'static RegisterSpec {
        self.spec
    }
}

impl Registers<'_> {
    fn row(&self, name: &str) -> Option<Row> {
        let found = self.layout.iter().enumerate().find(|(_, spec)| spec.name == name);
        found.map(|(index, spec)| Row { index, spec })
    }

    fn get(&self, name: &str) -> u64 {
        self.row(name).map_or(0, |row| self.file.get(row))
    }

    fn set(&mut self, name: &str, value: u64) {
        if let Some(row) = self.row(name) {
            self.file.set(row, value);
        }
    }

    fn is_set(&self, name: &str, bit: u32) -> bool {
        self.get(name) >> bit & 1 != 0
    }
}

/// A model in its place on the bus.
#[derive(Debug)]
struct Peripheral {
    slot: usize,
    layout: &'static [RegisterSpec],
    model: Box<dyn Model>,
}

impl Peripheral {
    fn name(&self, row: usize) -> &'static str {
        self.layout.get(row).map_or("", |register| register.name)
    }
}

impl ErasedDevice for Peripheral {
    fn layout(&self) -> &'static [RegisterSpec] {
        self.layout
    }

    fn read(&mut self, row: usize, file: &mut RegisterFile, context: &mut DeviceContext<'_>) -> Option<u64> {
        let (name, layout) = (self.name(row), self.layout);
        self.model.read(name, &mut Registers { file, layout }, context)
    }

    fn write(&mut self, row: usize, value: u64, file: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        let (name, layout) = (self.name(row), self.layout);
        self.model.write(name, value, &mut Registers { file, layout }, context);
    }

    fn on_event(&mut self, event: EventId, file: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        self.model.on_event(event, &mut Registers { file, layout: self.layout }, context);
    }

    fn on_request(&mut self, _: RequestChange, _: &mut RegisterFile, _: &mut DeviceContext<'_>) {}

    fn on_clock(&mut self, _: u64, _: &mut RegisterFile, _: &mut DeviceContext<'_>) {}

    fn poll(&mut self, _: &mut RegisterFile, _: &mut DeviceContext<'_>) {}

    fn reset(&mut self) {
        self.model.reset();
    }

    fn on_access(&mut self, _: u64, _: u64, _: &mut RegisterFile, _: &mut DeviceContext<'_>) {}

    fn on_refused(&mut self, _: u64, _: &mut RegisterFile, _: &mut DeviceContext<'_>) {}
}

#[derive(Debug)]
pub(super) struct Peripherals {
    all: Vec<Peripheral>,
    /// Index in `all` by slot of the bus.
    by_slot: Box<[Option<usize>]>,
    clocks: Option<Clocks>,
}

impl Peripherals {
    pub(super) fn new(bus: &mut Bus) -> Result<Self, rigless::soc::Error> {
        let mut by_slot = vec![None; bus.slots().len()].into_boxed_slice();
        let mut all = Vec::new();
        for (name, model) in MODELS {
            let slot = bus.slot(name)?;
            if let Some(index) = by_slot.get_mut(slot) {
                *index = Some(all.len());
            }
            let layout = bus.slots().get(slot).map_or(&[][..], |slot| slot.peripheral().registers);
            all.push(Peripheral { slot, layout, model: model() });
        }
        let mut peripherals = Self { all, by_slot, clocks: None };
        peripherals.initialise(bus);
        Ok(peripherals)
    }

    fn initialise(&mut self, bus: &mut Bus) {
        for Peripheral { slot, layout, model } in &mut self.all {
            let (file, _) = bus.drive(VirtualNanos(0), *slot);
            model.initialise(&mut Registers { file, layout });
        }
    }

    pub(super) fn at(&mut self, slot: usize) -> Option<&mut dyn ErasedDevice> {
        let index = (*self.by_slot.get(slot)?)?;
        Some(self.all.get_mut(index)?)
    }

    /// Call it after a reset of the bus, whose registers have their reset values.
    pub(super) fn reset(&mut self, bus: &mut Bus) {
        self.all.iter_mut().for_each(|peripheral| peripheral.model.reset());
        self.clocks = None;
        self.initialise(bus);
    }

    /// Call it after a write to a register of the clocks.
    pub(super) fn follow_clocks(&mut self, now: u64, clocks: Clocks, bus: &mut Bus) {
        if self.clocks.replace(clocks) == Some(clocks) {
            return;
        }
        for Peripheral { slot, layout, model } in &mut self.all {
            let (file, mut context) = bus.drive(VirtualNanos(now), *slot);
            model.on_clock(&clocks, &mut Registers { file, layout }, &mut context);
        }
    }
}

impl Store for Peripherals {
    fn store(&self, to: &mut Writer) -> Result<(), snapshot::Error> {
        self.all.iter().try_for_each(|peripheral| peripheral.model.store(to))
    }

    fn load(&mut self, from: &mut Reader) -> Result<(), snapshot::Error> {
        self.clocks = None;
        self.all.iter_mut().try_for_each(|peripheral| peripheral.model.load(from))
    }
}

/// Stores a model that keeps all of its state in one value.
macro_rules! store_fields {
    ($model:ty { $($field:ident),* }) => {
        impl Store for $model {
            fn store(&self, to: &mut Writer) -> Result<(), snapshot::Error> {
                to.put(&($(self.$field,)*))
            }

            fn load(&mut self, from: &mut Reader) -> Result<(), snapshot::Error> {
                ($(self.$field,)*) = from.take()?;
                Ok(())
            }
        }
    };
}
use store_fields;
