//! Runs `platebench-controller` on an STM32F405, F407 or F427.
//!
//! | pin | function |
//! |---|---|
//! | PA2, PA3 | USART2 TX, RX: the line to the bench, 1 Mbaud, 8N1 |
//! | PB0 | amplifier enable, high while the controller runs |
//! | PH0, PH1 | crystal, 8 MHz (features `crystal-25mhz`, `no-crystal`); internal oscillator if it does not start |
//!
//! The main loop sleeps until the line is idle after a frame, 1 ms has passed or the alarm fires.
#![no_std]
#![no_main]

mod clock;
mod identity;
mod line;
mod output;
#[cfg(feature = "plant-faults")]
mod planted_faults;
mod trap;

use core::mem::MaybeUninit;
use core::sync::atomic::{AtomicBool, Ordering};
use cortex_m_rt::{entry, exception};
use line::Inbox;
use pac::interrupt;
use platebench_controller::Device;
use platebench_wire::{Message, Packet};
use stm32f4::stm32f405 as pac;

static TICK: AtomicBool = AtomicBool::new(false);

#[entry]
fn main() -> ! {
    // State of the control law. A debugger and the chip fault `bit-flip` find it by this name.
    static mut CONTROLLER: MaybeUninit<Device> = MaybeUninit::uninit();

    // SAFETY: called once, at the start; only this function owns them.
    let (p, mut core) = unsafe { (pac::Peripherals::steal(), cortex_m::Peripherals::steal()) };

    let mut output = output::Output::new(&p);
    trap::enable_division_trap(&mut core.SCB);
    let clocks = clock::start(&p);
    clock::start_microseconds(&p, clocks.timer_hz);
    let mut alarm = clock::Alarm::new();
    clock::start_watchdog(&p);
    let (mut inbox, mut outbox) = line::start(&p, clocks.apb1_hz);
    if let Some(report) = trap::report_before_reset(&p) {
        outbox.put(Packet { sequence: 0, message: Message::Fault(report) }.encode().as_bytes());
        outbox.flush(&p);
    }
    clock::start_tick(&mut core.SYST, clocks.core_hz);

    let device = CONTROLLER.write(Device::new(identity::identity(&p)));
    #[cfg(feature = "plant-faults")]
    let mut planted = planted_faults::SampleWatcher::new();
    loop {
        // Masked until the core sleeps, so that none is missed. A masked interrupt ends the sleep.
        cortex_m::interrupt::disable();
        if !Inbox::went_idle() && !TICK.load(Ordering::Relaxed) {
            cortex_m::asm::wfi();
        }
        // SAFETY: no critical section is open.
        unsafe { cortex_m::interrupt::enable() };
        clock::feed_watchdog(&p);

        loop {
            let bytes = inbox.take(&p);
            if bytes.is_empty() {
                break;
            }
            #[cfg(feature = "plant-faults")]
            planted.watch(bytes);
            let since = clock::now_us(&p);
            device.receive(bytes, since, |frame| outbox.put(frame));
            let took = clock::now_us(&p).wrapping_sub(since);
            device.set_compute_us(u16::try_from(took).unwrap_or(u16::MAX));
        }
        if TICK.swap(false, Ordering::Relaxed) {
            device.tick(clock::now_us(&p), |frame| outbox.put(frame));
        }
        if !alarm.set(&p, device.next_tick_us()) {
            TICK.store(true, Ordering::Relaxed);
        }
        output.apply(&p, device.output());
        outbox.flush(&p);
    }
}

#[exception]
fn SysTick() {
    TICK.store(true, Ordering::Relaxed);
}

#[interrupt]
fn TIM2() {
    clock::Alarm::acknowledge();
    TICK.store(true, Ordering::Relaxed);
}
