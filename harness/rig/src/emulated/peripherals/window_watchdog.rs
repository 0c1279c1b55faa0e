//! Window watchdog (RM0090, chapter 22): a down-counter of 7 bits whose bit 6 must stay set.

use super::{Clocks, Model, Registers, snapshot, store_fields};
use rigless::device::DeviceContext;
use rigless::snapshot::{Reader, Store, Writer};
use rigless::time::{EventId, VirtualNanos};

const NS_PER_S: u128 = 1_000_000_000;
const HSI_HZ: u64 = 16_000_000;
const ACTIVE: u64 = 1 << 7;
const COUNT: u64 = 0x7F;
/// The early interrupt comes at this count, the reset one count later.
const EARLY: u64 = 0x40;
const EARLY_INTERRUPT: u32 = 9;
const CYCLES_PER_COUNT: u64 = 4_096;
const LINE: usize = 0;

#[derive(Debug)]
pub(super) struct WindowWatchdog {
    hz: u64,
    is_active: bool,
    /// Count at `since_ns`.
    count: u64,
    since_ns: u64,
    next: Option<EventId>,
}

store_fields!(WindowWatchdog { hz, is_active, count, since_ns, next });

impl Default for WindowWatchdog {
    fn default() -> Self {
        Self { hz: HSI_HZ, is_active: false, count: COUNT, since_ns: 0, next: None }
    }
}

impl WindowWatchdog {
    fn ns_per_count(&self, registers: &Registers<'_>) -> u128 {
        let divider = registers.get("CFR") >> 7 & 0b11;
        u128::from(CYCLES_PER_COUNT << divider) * NS_PER_S / u128::from(self.hz.max(1))
    }

    fn count_at(&self, now: u64, registers: &Registers<'_>) -> u64 {
        let elapsed = u128::from(now.saturating_sub(self.since_ns)) / self.ns_per_count(registers).max(1);
        if self.is_active { self.count.saturating_sub(elapsed as u64) } else { self.count }
    }

    fn schedule(&mut self, registers: &Registers<'_>, context: &mut DeviceContext<'_>) {
        self.next = None;
        if self.is_active && self.hz > 0 {
            let target = if self.count > EARLY { EARLY } else { EARLY - 1 };
            let wait = u128::from(self.count.saturating_sub(target)) * self.ns_per_count(registers);
            self.next = Some(context.schedule(VirtualNanos(self.since_ns.saturating_add(wait as u64))));
        }
    }

    fn settle_interrupt(registers: &Registers<'_>, context: &mut DeviceContext<'_>) {
        if registers.get("SR") & 1 != 0 && registers.is_set("CFR", EARLY_INTERRUPT) {
            context.raise(LINE);
        } else {
            context.lower(LINE);
        }
    }
}

impl Model for WindowWatchdog {
    fn read(&mut self, register: &str, registers: &mut Registers<'_>, context: &mut DeviceContext<'_>) -> Option<u64> {
        let active = if self.is_active { ACTIVE } else { 0 };
        (register == "CR").then(|| active | self.count_at(context.now().0, registers))
    }

    fn write(&mut self, register: &str, value: u64, registers: &mut Registers<'_>, context: &mut DeviceContext<'_>) {
        let now = context.now().0;
        if register == "CR" {
            let is_early = self.is_active && self.count_at(now, registers) > registers.get("CFR") & COUNT;
            self.is_active |= value & ACTIVE != 0;
            (self.count, self.since_ns) = (value & COUNT, now);
            if is_early || self.is_active && value & EARLY == 0 {
                context.request_reset();
            }
            self.schedule(registers, context);
        }
        Self::settle_interrupt(registers, context);
    }

    fn on_event(&mut self, event: EventId, registers: &mut Registers<'_>, context: &mut DeviceContext<'_>) {
        if self.next != Some(event) {
            return;
        }
        let now = context.now().0;
        (self.count, self.since_ns) = (self.count_at(now, registers), now);
        if self.count < EARLY {
            context.request_reset();
            return;
        }
        registers.set("SR", 1);
        Self::settle_interrupt(registers, context);
        self.schedule(registers, context);
    }

    fn on_clock(&mut self, clocks: &Clocks, registers: &mut Registers<'_>, context: &mut DeviceContext<'_>) {
        if clocks.pclk1 == self.hz {
            return;
        }
        let now = context.now().0;
        (self.count, self.since_ns) = (self.count_at(now, registers), now);
        self.hz = clocks.pclk1;
        if self.is_active {
            self.schedule(registers, context);
        }
    }

    fn reset(&mut self) {
        *self = Self::default();
    }
}
