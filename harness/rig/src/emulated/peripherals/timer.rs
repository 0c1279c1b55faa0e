//! Basic and two-channel timers (RM0090, chapters 19 and 20): an up-counter with update and compare
//! interrupts. Captures, slave modes, outputs and DMA requests are not modelled.

use super::{Clocks, Model, Registers, snapshot, store_fields};
use rigless::device::DeviceContext;
use rigless::snapshot::{Reader, Store, Writer};
use rigless::soc::stm32f427::peripherals::rcc::Apb;
use rigless::time::{EventId, VirtualNanos};

const NS_PER_S: u128 = 1_000_000_000;
const HSI_HZ: u64 = 16_000_000;
const LARGEST: u64 = 0xFFFF;
const LINE: usize = 0;

// Bits of CR1.
const ENABLE: u32 = 0;
const UPDATE_DISABLE: u32 = 1;
const UPDATE_BY_OVERFLOW_ONLY: u32 = 2;
const ONE_PULSE: u32 = 3;
const RELOAD_PRELOAD: u32 = 7;

/// Flag of the update in SR, DIER and EGR. Flags of the channels follow.
const UPDATE: u64 = 1;
const FLAGS: u64 = 0b111;
/// Bits of a channel in CCMR1 that are 0 for a compare.
const CAPTURE: u64 = 0b11;
const CHANNELS: [(&str, u64, u32); 2] = [("CCR1", 1 << 1, 0), ("CCR2", 1 << 2, 8)];

#[derive(Debug)]
pub(super) struct Timer {
    bus: Apb,
    hz: u64,
    /// Instant at which the counter was `origin_count`, and at which the present settings began.
    origin_ns: u64,
    origin_count: u64,
    /// Ticks since the origin whose flags are set.
    seen: u64,
    prescaler: u64,
    reload: u64,
    is_counting: bool,
    next: Option<EventId>,
}

store_fields!(Timer { hz, origin_ns, origin_count, seen, prescaler, reload, is_counting, next });

impl Timer {
    pub(super) fn new(bus: Apb) -> Self {
        Self {
            bus,
            hz: HSI_HZ,
            origin_ns: 0,
            origin_count: 0,
            seen: 0,
            prescaler: 0,
            reload: LARGEST,
            is_counting: false,
            next: None,
        }
    }

    fn period(&self) -> u64 {
        self.reload + 1
    }

    /// Ticks from the origin to `now`.
    fn ticks(&self, now: u64) -> u64 {
        let elapsed = u128::from(now.saturating_sub(self.origin_ns)) * u128::from(self.hz);
        (elapsed / (NS_PER_S * u128::from(self.prescaler + 1))) as u64
    }

    fn instant(&self, ticks: u64) -> u64 {
        let cycles = u128::from(ticks) * u128::from(self.prescaler + 1);
        self.origin_ns.saturating_add((cycles * NS_PER_S).div_ceil(u128::from(self.hz.max(1))) as u64)
    }

    fn count(&self) -> u64 {
        (self.origin_count + self.seen) % self.period()
    }

    /// First tick after `seen` at which the counter becomes `value`. `None` if it never does.
    fn next_tick_at(&self, value: u64) -> Option<u64> {
        let period = self.period();
        let wait = (value + period - self.count() % period) % period;
        (value < period && self.reload > 0).then(|| self.seen + if wait == 0 { period } else { wait })
    }

    fn restart(&mut self, now: u64, count: u64) {
        (self.origin_ns, self.origin_count, self.seen) = (now, count, 0);
    }

    fn load_settings(&mut self, registers: &Registers<'_>) {
        self.prescaler = registers.get("PSC") & LARGEST;
        self.reload = registers.get("ARR") & LARGEST;
    }

    /// Sets the flags of all ticks to `now`.
    fn catch_up(&mut self, now: u64, registers: &mut Registers<'_>) {
        while self.is_counting {
            let last = self.ticks(now);
            let update = self.next_tick_at(0).filter(|&tick| tick <= last);
            let changes = registers.is_set("CR1", ONE_PULSE)
                || self.prescaler != registers.get("PSC") & LARGEST
                || self.reload != registers.get("ARR") & LARGEST;
            let updates = !registers.is_set("CR1", UPDATE_DISABLE);
            let to = update.filter(|_| changes && updates).unwrap_or(last);
            let flags = CHANNELS.iter().filter(|&&(register, _, shift)| {
                let is_output = registers.get("CCMR1_Output") >> shift & CAPTURE == 0;
                is_output && self.next_tick_at(registers.get(register)).is_some_and(|tick| tick <= to)
            });
            let mut set = flags.fold(0, |set, (_, flag, _)| set | flag);
            if update.is_some() && updates {
                set |= UPDATE;
            }
            // Basic timers have no channels.
            let implemented = if registers.row("CCR1").is_none() { UPDATE } else { u64::MAX };
            registers.set("SR", registers.get("SR") | set & implemented);
            self.seen = to;
            if update.is_none() || !changes || !updates {
                return;
            }
            let at = self.instant(to);
            self.load_settings(registers);
            self.restart(at, 0);
            if registers.is_set("CR1", ONE_PULSE) {
                self.is_counting = false;
                registers.set("CR1", registers.get("CR1") & !(1 << ENABLE));
            }
        }
    }

    /// Drives the interrupt and schedules the next one.
    fn settle(&mut self, registers: &Registers<'_>, context: &mut DeviceContext<'_>) {
        let enabled = registers.get("DIER");
        if registers.get("SR") & enabled & FLAGS == 0 {
            context.lower(LINE);
        } else {
            context.raise(LINE);
        }
        self.next = None;
        if !self.is_counting || self.hz == 0 {
            return;
        }
        let waits_for_update = enabled & UPDATE != 0 || registers.is_set("CR1", ONE_PULSE);
        let update = self.next_tick_at(0).filter(|_| waits_for_update);
        let compares = CHANNELS.iter().filter(|(_, flag, _)| enabled & flag != 0);
        let compares = compares.filter_map(|(register, ..)| self.next_tick_at(registers.get(register)));
        if let Some(tick) = update.into_iter().chain(compares).min() {
            self.next = Some(context.schedule(VirtualNanos(self.instant(tick))));
        }
    }
}

impl Model for Timer {
    /// The part's table has 0, which would stop the counter (19.4.9, 20.4.8).
    fn initialise(&mut self, registers: &mut Registers<'_>) {
        registers.set("ARR", LARGEST);
    }

    fn read(&mut self, register: &str, registers: &mut Registers<'_>, context: &mut DeviceContext<'_>) -> Option<u64> {
        self.catch_up(context.now().0, registers);
        (register == "CNT").then(|| self.count())
    }

    fn write(&mut self, register: &str, value: u64, registers: &mut Registers<'_>, context: &mut DeviceContext<'_>) {
        let now = context.now().0;
        self.catch_up(now, registers);
        match register {
            // Also clears flags of ticks before the write.
            "SR" => registers.set("SR", registers.get("SR") & value),
            "EGR" if value & UPDATE != 0 => {
                if !registers.is_set("CR1", UPDATE_DISABLE) {
                    self.load_settings(registers);
                    if !registers.is_set("CR1", UPDATE_BY_OVERFLOW_ONLY) {
                        registers.set("SR", registers.get("SR") | UPDATE);
                    }
                }
                self.restart(now, 0);
            }
            "CR1" => {
                let enabled = value >> ENABLE & 1 != 0;
                if enabled != self.is_counting {
                    let count = self.count();
                    if enabled && !registers.is_set("CR1", RELOAD_PRELOAD) {
                        self.reload = registers.get("ARR") & LARGEST;
                    }
                    self.restart(now, count);
                    self.is_counting = enabled;
                }
            }
            "CNT" => self.restart(now, value & LARGEST),
            "ARR" if !registers.is_set("CR1", RELOAD_PRELOAD) => {
                let count = self.count();
                self.reload = value & LARGEST;
                self.restart(now, count);
            }
            _ => {}
        }
        self.settle(registers, context);
    }

    fn on_event(&mut self, event: EventId, registers: &mut Registers<'_>, context: &mut DeviceContext<'_>) {
        if self.next == Some(event) {
            self.catch_up(context.now().0, registers);
            self.settle(registers, context);
        }
    }

    fn on_clock(&mut self, clocks: &Clocks, registers: &mut Registers<'_>, context: &mut DeviceContext<'_>) {
        let hz = clocks.timer(self.bus);
        if hz == self.hz {
            return;
        }
        let now = context.now().0;
        self.catch_up(now, registers);
        let count = self.count();
        self.restart(now, count);
        self.hz = hz;
        if self.is_counting {
            self.settle(registers, context);
        }
    }

    fn reset(&mut self) {
        *self = Self::new(self.bus);
    }
}
