//! Describes the emulated board: an STM32F427 with crystal, supply and the bench's wire on USART2.

use super::no_model::InstancesWithoutModel;
use super::peripherals::{Clocks, Peripherals};
use super::serial_port::{DMA1, SerialPort, Slots, USART2};
use rigless::chip::{Timeline, uart};
use rigless::cpu::armv7m::windows;
use rigless::device::{Device, ErasedDevice, ResetCause};
use rigless::emulator::Access;
use rigless::machine::{Board, Crystal, Target, armv7m};
use rigless::mcu::{Mcu, Operate};
use rigless::snapshot::{self, Reader, Store, Writer};
use rigless::soc::stm32f427::Stm32f427;
use rigless::soc::stm32f427::generated::gpiob::Register as Gpiob;
use rigless::soc::stm32f427::generated::rcc::Register as Rcc;
use rigless::soc::{Bus, Error};
use rigless::time::VirtualNanos;
use std::collections::VecDeque;
use std::num::{NonZeroU32, NonZeroU64};

/// One instruction per cycle of 168 MHz. The waits of pipeline and flash are not modelled.
pub(super) const INSTRUCTIONS_PER_SECOND: NonZeroU64 = NonZeroU64::new(168_000_000).unwrap();

const INTERRUPT_PRIORITY_BITS: u8 = 4;
const SYSTICK_DIVIDER: NonZeroU32 = NonZeroU32::new(8).unwrap();
const SUPPLY_MV: u32 = 3_300;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ReceivedByte {
    pub(super) byte: u8,
    /// End of the stop bit, as time since power-on.
    pub(super) at_ns: u64,
}

#[derive(Debug, Default)]
pub(super) struct UartPeer {
    pub(super) to_target: VecDeque<u8>,
    pub(super) received: Vec<ReceivedByte>,
    /// Frames that ended since `Machine` last read this count.
    pub(super) frames: u32,
    within_frame: bool,
    /// Start of the last word that the model of the USART took from `to_target`.
    pub(super) last_word_start: Option<u64>,
    /// Bytes in place of the next words of the model.
    pub(super) substitutes: VecDeque<u8>,
}

impl UartPeer {
    pub(super) fn push_received(&mut self, byte: u8, at_ns: u64) {
        self.received.push(ReceivedByte { byte, at_ns });
        let ended = byte == 0 && self.within_frame;
        self.within_frame = byte != 0;
        self.frames += u32::from(ended);
    }
}

/// Stores an idle line.
impl Store for UartPeer {
    fn store(&self, to: &mut Writer) -> Result<(), snapshot::Error> {
        to.put(&self.last_word_start)
    }

    fn load(&mut self, from: &mut Reader) -> Result<(), snapshot::Error> {
        *self = Self { last_word_start: from.take()?, ..Self::default() };
        Ok(())
    }
}

impl uart::Peer for UartPeer {
    fn receive(&mut self, word: u16, context: &mut Timeline<'_, '_>) {
        let byte = self.substitutes.pop_front().unwrap_or(word as u8);
        self.push_received(byte, context.now().0);
    }

    fn transmit(&mut self, now: VirtualNanos) -> Option<u16> {
        let word = self.to_target.pop_front().map(u16::from)?;
        self.last_word_start = Some(now.0);
        Some(word)
    }
}

/// Polls only the peripherals that the firmware has used, which saves a quarter of the computing
/// time. During the start it polls all, because a change of clocks affects them.
#[derive(Debug)]
pub(super) struct Microcontroller {
    mcu: Stm32f427,
    pub(super) port: SerialPort,
    /// Models of the bench, for instances without one in the emulator.
    peripherals: Peripherals,
    slots: Slots,
    clocks: usize,
    used: Box<[bool]>,
    pub(super) without_model: InstancesWithoutModel,
    pub(super) booted: bool,
    /// True if the USART has not yet received all bytes of the bench.
    has_pending_bytes: bool,
}

impl Microcontroller {
    /// Puts `bytes` on the line at `now`. Call it when the port has no deferred words.
    pub(super) fn send(&mut self, bytes: &[u8], now: u64, processor_sleeps: bool) {
        if let Some(at) = self.port.start_receiving(bytes, now, processor_sleeps, self.mcu.bus(), self.slots) {
            self.mcu.bus_mut().drive(VirtualNanos(now), self.slots.usart).1.schedule(at);
        } else if let Some(wire) = self.port.wire() {
            wire.to_target.extend(bytes);
            self.has_pending_bytes = true;
        }
    }

    /// True if an access to `address` may show or change what deferred words do.
    pub(super) fn shows_words(&self, address: u64) -> bool {
        let slot = self.mcu.bus().slot_at(address);
        slot.is_some_and(|slot| [self.slots.usart, self.slots.dma, self.clocks].contains(&slot))
    }

    pub(super) fn catch_up(&mut self, now: u64) -> bool {
        self.port.catch_up(now, self.mcu.bus_mut(), self.slots)
    }

    pub(super) fn continue_word_by_word(&mut self, now: u64) {
        self.port.continue_word_by_word(now, self.mcu.bus_mut(), self.slots);
    }

    /// Call it after a write to the control register of the transmit DMA stream.
    pub(super) fn start_sending<'a>(&mut self, now: u64, read: impl FnOnce(u64, usize) -> Option<&'a [u8]>) {
        let _ = self.port.start_sending(now, self.mcu.bus(), self.slots, read);
    }

    /// Call it after a write to the instance at `address`.
    pub(super) fn follow_clocks(&mut self, address: u64, now: u64) {
        let Self { mcu, peripherals, clocks, .. } = self;
        let slot = mcu.bus().slot_at(address).filter(|slot| slot == clocks);
        if let Some(slot) = slot.and_then(|slot| mcu.bus().slots().get(slot)) {
            let clocks = Clocks::read(&mcu.rcc, slot.registers());
            peripherals.follow_clocks(now, clocks, mcu.bus_mut());
        }
    }

    pub(super) fn has_register(&self, address: u64) -> bool {
        self.mcu.bus().slot_at(address).is_some()
    }

    /// Call it before each access. Returns false if no instance is at its address.
    pub(super) fn mark_used(&mut self, access: &Access) -> bool {
        let bus = self.mcu.bus();
        let Some(slot) = bus.slot_at(access.address) else { return false };
        if let Some(entry) = bus.slots().get(slot) {
            self.without_model.record(slot, entry.peripheral(), access);
        }
        if let Some(used) = self.used.get_mut(slot) {
            *used = true;
        }
        self.booted &= slot != self.clocks;
        true
    }

    pub(super) fn instances_the_firmware_used(&self) -> Vec<&'static str> {
        let slots = self.mcu.bus().slots().iter().zip(&self.used);
        slots.filter(|(_, used)| **used).map(|(slot, _)| slot.peripheral().name).collect()
    }

    pub(super) fn instance_at(&self, address: u64) -> Option<&'static str> {
        let bus = self.mcu.bus();
        let slot = bus.slot_at(address).and_then(|slot| bus.slots().get(slot));
        slot.map(|slot| slot.peripheral().name).or_else(|| {
            bus.memory()
                .iter()
                .find(|region| (region.base..region.base + region.size).contains(&address))
                .map(|region| region.name)
        })
    }
}

/// Flags of the watchdogs in `RCC_CSR` (RM0090, 6.3.21).
const IWDG_FLAG: u64 = 1 << 29;
const WWDG_FLAG: u64 = 1 << 30;

impl Microcontroller {
    fn reset_flags(&self) -> u64 {
        self.mcu.bus().slots().get(self.clocks).map_or(0, |slot| slot.registers().get(Rcc::Csr))
    }
}

impl Mcu for Microcontroller {
    fn bus(&self) -> &Bus {
        self.mcu.bus()
    }

    fn bus_mut(&mut self) -> &mut Bus {
        self.mcu.bus_mut()
    }

    fn reset(&mut self, at: VirtualNanos, cause: ResetCause) {
        // The emulator has no flag of the window watchdog, so it gets that of the other one.
        let by_window = matches!(cause, ResetCause::Model("WWDG"));
        let cause = if by_window { ResetCause::Model("IWDG") } else { cause };
        let before = self.reset_flags();
        self.without_model.reset();
        let Self { mcu, port, peripherals, .. } = self;
        port.reset_chip(at.0, |usart| {
            let [_, inherited, ..] = &mut mcu.usart;
            std::mem::swap(usart, inherited);
            mcu.reset(at, cause);
            let [_, fresh, ..] = &mut mcu.usart;
            std::mem::swap(usart, fresh);
        });
        peripherals.reset(mcu.bus_mut());
        if by_window {
            let flags = self.reset_flags() & !IWDG_FLAG | before & IWDG_FLAG | WWDG_FLAG;
            self.mcu.bus_mut().drive(at, self.clocks).0.set(Rcc::Csr, flags);
        }
    }

    fn poll(&mut self, now: VirtualNanos) {
        if std::mem::take(&mut self.has_pending_bytes) {
            let (registers, mut context) = self.mcu.bus_mut().drive(now, self.slots.usart);
            Device::poll(&mut self.port, registers, &mut context);
        }
    }

    fn split(&mut self, slot: usize) -> (&mut Bus, Option<&mut dyn ErasedDevice>) {
        if self.booted && !self.used.get(slot).copied().unwrap_or(false) {
            (self.mcu.bus_mut(), None)
        } else if slot == self.slots.usart {
            (self.mcu.bus_mut(), Some(&mut self.port))
        } else if let Some(peripheral) = self.peripherals.at(slot) {
            (self.mcu.bus_mut(), Some(peripheral))
        } else {
            self.mcu.split(slot)
        }
    }
}

#[derive(Debug)]
pub(super) struct EmulatedBoard {
    pub(super) part: Microcontroller,
}

impl EmulatedBoard {
    pub(super) fn new(crystal_hz: u64) -> Result<Self, Error> {
        let mut mcu = Stm32f427::new()?;
        mcu.rcc.attach_crystals(crystal_hz, Crystal::NONE.0);
        mcu.set_supply(SUPPLY_MV);
        let slots = Slots { usart: mcu.bus().slot(USART2)?, dma: mcu.bus().slot(DMA1)? };
        let clocks = mcu.bus().slot("RCC")?;
        let used = vec![false; mcu.bus().slots().len()].into_boxed_slice();
        let port = SerialPort::new();
        let mut peripherals = Peripherals::new(mcu.bus_mut())?;
        let has_model = |slot| mcu.split(slot).1.is_some() || peripherals.at(slot).is_some();
        let without_model = InstancesWithoutModel::new((0..used.len()).map(has_model));
        let part = Microcontroller {
            mcu,
            port,
            peripherals,
            slots,
            clocks,
            used,
            without_model,
            booted: false,
            has_pending_bytes: false,
        };
        Ok(Self { part })
    }

    /// True if PB0 is an output and high. If PB0 is no output, the board's pull-down holds it low.
    pub(super) fn amplifier_enabled(&self) -> bool {
        let registers = self.part.bus().registers("GPIOB");
        registers.is_some_and(|gpio| gpio.get(Gpiob::Moder) & 0b11 == 0b01 && gpio.get(Gpiob::Odr) & 1 != 0)
    }

    /// Always `Some`.
    pub(super) fn wire(&mut self) -> Option<&mut UartPeer> {
        self.part.port.wire()
    }
}

impl Store for EmulatedBoard {
    fn store(&self, to: &mut Writer) -> Result<(), snapshot::Error> {
        let Microcontroller { mcu, port, peripherals, used, without_model, booted, has_pending_bytes, .. } = &self.part;
        to.put(used)?;
        without_model.store(to)?;
        to.put(booted)?;
        to.put(has_pending_bytes)?;
        mcu.store(to)?;
        peripherals.store(to)?;
        port.store(to)
    }

    fn load(&mut self, from: &mut Reader) -> Result<(), snapshot::Error> {
        let Microcontroller { mcu, port, peripherals, used, without_model, booted, has_pending_bytes, .. } =
            &mut self.part;
        *used = from.take()?;
        without_model.load(from)?;
        *booted = from.take()?;
        *has_pending_bytes = from.take()?;
        mcu.load(from)?;
        peripherals.load(from)?;
        port.load(from)
    }
}

impl Board for EmulatedBoard {
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
