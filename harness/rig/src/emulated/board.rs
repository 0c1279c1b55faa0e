//! The emulated board: an STM32F427 with a crystal, a supply and the bench's wire on USART2, in the emulator's terms.

use rigless::chip::{Timeline, uart};
use rigless::cpu::armv7m::windows;
use rigless::device::{ErasedDevice, ResetCause};
use rigless::machine::{Board, Crystal, Target, armv7m};
use rigless::mcu::{Mcu, Operate};
use rigless::snapshot::Store;
use rigless::soc::stm32f427::Stm32f427;
use rigless::soc::{Bus, Error};
use rigless::time::VirtualNanos;
use std::collections::VecDeque;
use std::num::{NonZeroU32, NonZeroU64};

use super::target::Heard;

/// Instructions per second of a processor at 168 MHz that takes one cycle for each. A fixed number, not a model of its pipeline and flash.
pub(super) const INSTRUCTIONS_PER_SECOND: NonZeroU64 = NonZeroU64::new(168_000_000).unwrap();

const INTERRUPT_PRIORITY_BITS: u8 = 4;
const SYSTICK_DIVIDER: NonZeroU32 = NonZeroU32::new(8).unwrap();
const SUPPLY_MV: u32 = 3_300;
/// Index of USART2 among the part's serial ports.
const USART2: usize = 1;

/// The bench's end of the wire.
#[derive(Debug, Default)]
pub(super) struct Wire {
    pub(super) to_target: VecDeque<u8>,
    pub(super) heard: Vec<Heard>,
    /// Frames that ended since somebody last looked.
    pub(super) frames: u32,
    within_frame: bool,
}

impl Store for Wire {}

impl uart::Peer for Wire {
    fn receive(&mut self, word: u16, context: &mut Timeline<'_, '_>) {
        let byte = word as u8;
        self.heard.push(Heard { byte, at_ns: context.now().0 });
        let ended = byte == 0 && self.within_frame;
        self.within_frame = byte != 0;
        self.frames += u32::from(ended);
    }

    fn transmit(&mut self, _now: VirtualNanos) -> Option<u16> {
        self.to_target.pop_front().map(u16::from)
    }
}

/// The part. Once the firmware has come up, models that it has never touched are not asked at every event any more: they are in their reset state and have
/// nothing to say. That is worth a quarter of the speed. Until then they are, since they have to hear of the clocks.
#[derive(Debug)]
pub(super) struct Part {
    whole: Stm32f427,
    usart2: usize,
    clocks: usize,
    touched: Box<[bool]>,
    /// Only what was touched is asked.
    pub(super) came_up: bool,
    /// Bytes wait on the wire: the one thing outside that a model has to be told of.
    pub(super) bytes_wait: bool,
}

impl Part {
    /// Notes that the firmware uses what answers at `address`. False where nothing does.
    pub(super) fn touch(&mut self, address: u64) -> bool {
        let Some(slot) = self.whole.bus().slot_at(address) else { return false };
        if let Some(touched) = self.touched.get_mut(slot) {
            *touched = true;
        }
        // A change of clocks is told to every model.
        self.came_up &= slot != self.clocks;
        true
    }

    /// The instances that the firmware has touched.
    pub(super) fn touched(&self) -> Vec<&'static str> {
        let slots = self.whole.bus().slots().iter().zip(&self.touched);
        let names = slots.filter(|(_, touched)| **touched).map(|(slot, _)| slot.peripheral().name);
        names.collect()
    }

    /// What answers at `address`.
    pub(super) fn instance_at(&self, address: u64) -> Option<&'static str> {
        let bus = self.whole.bus();
        let slot = bus.slot_at(address).and_then(|slot| bus.slots().get(slot));
        slot.map(|slot| slot.peripheral().name).or_else(|| {
            bus.memory()
                .iter()
                .find(|region| (region.base..region.base + region.size).contains(&address))
                .map(|region| region.name)
        })
    }
}

impl Mcu for Part {
    fn bus(&self) -> &Bus {
        self.whole.bus()
    }

    fn bus_mut(&mut self) -> &mut Bus {
        self.whole.bus_mut()
    }

    fn reset(&mut self, at: VirtualNanos, cause: ResetCause) {
        self.whole.reset(at, cause);
    }

    fn poll(&mut self, now: VirtualNanos) {
        if std::mem::take(&mut self.bytes_wait) {
            let (bus, model) = self.whole.split(self.usart2);
            let (registers, mut context) = bus.drive(now, self.usart2);
            if let Some(model) = model {
                model.poll(registers, &mut context);
            }
        }
    }

    fn split(&mut self, slot: usize) -> (&mut Bus, Option<&mut dyn ErasedDevice>) {
        if !self.came_up || self.touched.get(slot).copied().unwrap_or(false) {
            self.whole.split(slot)
        } else {
            (self.whole.bus_mut(), None)
        }
    }
}

/// The part and what hangs on it.
#[derive(Debug)]
pub(super) struct Bench {
    pub(super) part: Part,
}

impl Bench {
    pub(super) fn new(crystal_hz: u64) -> Result<Self, Error> {
        let mut whole = Stm32f427::new()?;
        whole.rcc.attach_crystals(crystal_hz, Crystal::NONE.0);
        whole.set_supply(SUPPLY_MV);
        if let Some(usart) = whole.usart.get_mut(USART2) {
            usart.attach(Wire::default());
        }
        let usart2 = whole.bus().slot("USART2")?;
        let clocks = whole.bus().slot("RCC")?;
        let touched = vec![false; whole.bus().slots().len()].into_boxed_slice();
        Ok(Self { part: Part { whole, usart2, clocks, touched, came_up: false, bytes_wait: false } })
    }

    /// The bench's end of the wire; `None` never happens, since `new` hung it there.
    pub(super) fn wire(&mut self) -> Option<&mut Wire> {
        self.part.whole.usart.get_mut(USART2).and_then(|usart| usart.chip_mut())
    }
}

impl Store for Bench {}

impl Board for Bench {
    fn name(&self) -> &'static str {
        "platebench"
    }

    fn target_names(&self) -> Vec<&'static str> {
        vec!["stm32f4"]
    }

    fn mcu(&mut self, target: usize) -> Option<&mut dyn Mcu> {
        (target == 0).then_some(&mut self.part)
    }

    fn targets(&mut self) -> Vec<Target<'_>> {
        let lines = NonZeroU32::new(u32::from(self.part.cpu().interrupt_lines)).unwrap_or(NonZeroU32::MIN);
        let core = armv7m::Core {
            variant: armv7m::Variant::M4,
            clock_hz: INSTRUCTIONS_PER_SECOND,
            interrupt_lines: lines,
            priority_bits: INTERRUPT_PRIORITY_BITS,
            refclk_divider: SYSTICK_DIVIDER,
            instructions_per_second: INSTRUCTIONS_PER_SECOND,
            boot: "flash",
        };
        let spec = core.spec_with_parts(&windows(self.part.bus()), armv7m::Fpu::FpV4Sp, armv7m::MpuRegions::Eight);
        vec![Target::new("stm32f4", &mut self.part, spec)]
    }
}
