//! Starts clocks, microsecond counter, alarm, 1 ms tick and watchdog. Every wait is bounded.
//!
//! Crystal and PLL give 168 MHz. If the crystal fails, internal oscillator and PLL give 168 MHz; if
//! the PLL fails, the internal oscillator gives 16 MHz. The baud rate divides APB1 in all cases.

use cortex_m::peripheral::SYST;
use cortex_m::peripheral::syst::SystClkSource;
use stm32f4::stm32f405 as pac;

const CRYSTAL_MHZ: Option<u32> = if cfg!(feature = "no-crystal") {
    None
} else if cfg!(feature = "crystal-25mhz") {
    Some(25)
} else {
    Some(8)
};
const INTERNAL_MHZ: u32 = 16;

const CHANNEL_1: u32 = 1 << 1;

/// Largest number of rounds of a wait, at least 6 cycles each. A crystal starts within a few ms.
const ROUNDS: u32 = 30_000;

#[derive(Clone, Copy)]
#[allow(clippy::struct_field_names, reason = "the unit is in the name")]
pub(crate) struct Clocks {
    pub(crate) core_hz: u32,
    pub(crate) apb1_hz: u32,
    pub(crate) timer_hz: u32,
}

const SLOW: Clocks = Clocks { core_hz: 16_000_000, apb1_hz: 16_000_000, timer_hz: 16_000_000 };
const FAST: Clocks = Clocks { core_hz: 168_000_000, apb1_hz: 42_000_000, timer_hz: 84_000_000 };

fn wait_until(mut ready: impl FnMut() -> bool) -> bool {
    (0..ROUNDS).any(|_| ready())
}

pub(crate) fn start(p: &pac::Peripherals) -> Clocks {
    let rcc = &p.RCC;
    // SAFETY: values and order of RM0090 chapters 5 to 7.
    unsafe {
        rcc.apb1enr().modify(|r, w| w.bits(r.bits() | 1 << 28)); // PWR
        p.PWR.cr().modify(|r, w| w.bits(r.bits() | 1 << 14)); // voltage scale 1, which 168 MHz need
        let crystal_mhz = CRYSTAL_MHZ.filter(|_| {
            rcc.cr().modify(|_, w| w.hseon().set_bit());
            let ready = wait_until(|| rcc.cr().read().hserdy().bit_is_set());
            if !ready {
                rcc.cr().modify(|_, w| w.hseon().clear_bit());
            }
            ready
        });
        // PLL: 1 MHz times 336, divided by 2, is 168 MHz. Q = 7 divides 336 MHz to 48 MHz.
        let source = u32::from(crystal_mhz.is_some()) << 22;
        rcc.pllcfgr().write(|w| w.bits(crystal_mhz.unwrap_or(INTERNAL_MHZ) | 336 << 6 | source | 7 << 24));
        rcc.cr().modify(|_, w| w.pllon().set_bit());
        if !wait_until(|| rcc.cr().read().pllrdy().bit_is_set()) {
            rcc.cr().modify(|_, w| w.pllon().clear_bit());
            return SLOW;
        }
        // Flash: 5 wait states for 168 MHz at 3.3 V; prefetch and both caches are on.
        p.FLASH.acr().write(|w| w.bits(5 | 0b111 << 8));
        if !wait_until(|| p.FLASH.acr().read().bits() & 0b111 == 5) {
            return SLOW;
        }
        let dividers = 0b101 << 10 | 0b100 << 13; // APB1 / 4, APB2 / 2, before the switch
        rcc.cfgr().write(|w| w.bits(dividers));
        rcc.cfgr().write(|w| w.bits(dividers | 0b10));
        if !wait_until(|| rcc.cfgr().read().bits() >> 2 & 0b11 == 0b10) {
            rcc.cfgr().write(|w| w.bits(0));
            return SLOW;
        }
    }
    FAST
}

pub(crate) fn start_microseconds(p: &pac::Peripherals, timer_hz: u32) {
    let timer = &p.TIM2;
    // SAFETY: TIM2 belongs to this module; RM0090 chapter 18.
    unsafe {
        p.RCC.apb1enr().modify(|r, w| w.bits(r.bits() | 1));
        timer.psc().write(|w| w.bits(timer_hz / 1_000_000 - 1));
        timer.arr().write(|w| w.bits(u32::MAX));
        timer.egr().write(|w| w.bits(1)); // loads the prescaler
        timer.cr1().write(|w| w.bits(1));
    }
}

pub(crate) fn now_us(p: &pac::Peripherals) -> u32 {
    p.TIM2.cnt().read().bits()
}

/// Wakes the main loop for the next tick by the counter's first compare channel, so that interrupt
/// delays do not shift the periods.
pub(crate) struct Alarm {
    at_us: Option<u32>,
}

impl Alarm {
    /// Call it once, after [`start_microseconds`].
    pub(crate) fn new() -> Self {
        // SAFETY: the handler of this interrupt only sets a flag.
        unsafe { cortex_m::peripheral::NVIC::unmask(pac::Interrupt::TIM2) };
        Self { at_us: None }
    }

    /// `None` switches the alarm off. Returns false if `at_us` has already passed, because the
    /// alarm then never fires.
    #[must_use]
    pub(crate) fn set(&mut self, p: &pac::Peripherals, at_us: Option<u32>) -> bool {
        if self.at_us == at_us {
            return true;
        }
        self.at_us = at_us;
        let timer = &p.TIM2;
        // SAFETY: compare value, flag and enable of the first channel, whose output is off;
        // RM0090 18.4.
        unsafe {
            timer.dier().write(|w| w.bits(0));
            let Some(at_us) = at_us else { return true };
            timer.ccr1().write(|w| w.bits(at_us));
            timer.sr().write(|w| w.bits(!CHANNEL_1));
            timer.dier().write(|w| w.bits(CHANNEL_1));
        }
        // The counter may have passed `at_us` before the interrupt was enabled.
        at_us.is_none_or(|at_us| at_us.wrapping_sub(now_us(p)).wrapping_sub(1) < u32::MAX / 2)
    }

    pub(crate) fn acknowledge() {
        // SAFETY: clears only the flag of the first channel.
        unsafe { (*pac::TIM2::ptr()).sr().write(|w| w.bits(!CHANNEL_1)) };
    }
}

/// Starts the independent watchdog with LSI / 4 and 32 counts: 4 ms, 2.7 to 7.5 ms over the
/// oscillator's tolerance. After 4 ms a stopped main loop has held the drive for less than five
/// periods of 1 ms. The watchdog cannot be stopped; a debugger that halts the core pauses it.
pub(crate) fn start_watchdog(p: &pac::Peripherals) {
    // SAFETY: RM0090, 21.3 and 32.16.4.
    unsafe {
        p.DBGMCU.apb1_fz().modify(|r, w| w.bits(r.bits() | 1 << 12)); // DBG_IWDG_STOP
        p.IWDG.kr().write(|w| w.bits(0xCCCC));
    }
    set_watchdog(p, 0, 32);
}

/// LSI / 64 and 256 counts: 0.5 s, 0.35 to 0.96 s over the oscillator's tolerance. After a trap at
/// 0 V a debugger has this time to read the state.
pub(crate) fn lengthen_watchdog(p: &pac::Peripherals) {
    set_watchdog(p, 4, 256);
}

fn set_watchdog(p: &pac::Peripherals, prescaler: u16, reload: u16) {
    // SAFETY: the key sequence of RM0090, 21.3.
    unsafe {
        p.IWDG.kr().write(|w| w.bits(0x5555));
        p.IWDG.pr().write(|w| w.bits(prescaler));
        p.IWDG.rlr().write(|w| w.bits(reload));
    }
    wait_until(|| p.IWDG.sr().read().bits() == 0);
    feed_watchdog(p);
}

/// Only the main loop calls this function, so that the watchdog detects a stopped main loop.
pub(crate) fn feed_watchdog(p: &pac::Peripherals) {
    // SAFETY: only reloads the counter.
    p.IWDG.kr().write(|w| unsafe { w.bits(0xAAAA) });
}

pub(crate) fn was_watchdog_reset(p: &pac::Peripherals) -> bool {
    let was = p.RCC.csr().read().bits() & 1 << 29 != 0;
    // SAFETY: RMVF only clears the flags.
    p.RCC.csr().modify(|r, w| unsafe { w.bits(r.bits() | 1 << 24) });
    was
}

pub(crate) fn start_tick(timer: &mut SYST, core_hz: u32) {
    timer.set_clock_source(SystClkSource::Core);
    timer.set_reload(core_hz / 1_000 - 1);
    timer.clear_current();
    timer.enable_counter();
    timer.enable_interrupt();
}
