//! Runs the controller on QEMU's `netduinoplus2`, which checks every bit of the law a second time.
//!
//! QEMU models no clock tree, DMA, pins or watchdog, and its timers run at wrong rates. Therefore
//! interrupts serve USART2, and the time is that of the last sample. After a fault report the
//! firmware resets; QEMU with `-no-reboot` then ends.
#![no_std]
#![no_main]

mod identity;

use core::panic::PanicInfo;
use core::sync::atomic::{AtomicU8, AtomicUsize, Ordering};
use cortex_m::peripheral::{NVIC, SCB};
use cortex_m_rt::{ExceptionFrame, entry, exception};
use pac::interrupt;
use platebench_controller::Device;
use platebench_wire::{FaultReport, FrameReader, Message, Packet};
use stm32f4::stm32f405 as pac;

/// Size of the ring, more bytes than a bench sends before it reads the answers.
const RING: usize = 4_096;
const ROUNDS: u32 = 20_000;

const RECEIVED_DATA: u32 = 1 << 5;
const TRANSMIT_EMPTY: u32 = 1 << 7;

const PANIC: u16 = 1;
const HARD_FAULT: u16 = 2;

static RECEIVED: [AtomicU8; RING] = [const { AtomicU8::new(0) }; RING];
static STORED: AtomicUsize = AtomicUsize::new(0);

#[entry]
fn main() -> ! {
    // SAFETY: called once, at the start; only this function owns them.
    let p = unsafe { pac::Peripherals::steal() };
    // SAFETY: UE, RXNEIE, TE, RE (RM0090, 30.6.4). A baud rate would have no effect.
    unsafe {
        p.USART2.cr1().write(|w| w.bits(1 << 13 | 1 << 5 | 1 << 3 | 1 << 2));
        NVIC::unmask(pac::Interrupt::USART2);
    }
    let mut device = Device::new(identity::identity(&p));
    let mut reader = FrameReader::new();
    let (mut taken, mut now_us) = (0_usize, 0);
    loop {
        // Interrupts are masked until the core sleeps, so that no byte is missed. A masked
        // interrupt also ends the sleep.
        cortex_m::interrupt::disable();
        if STORED.load(Ordering::Acquire) == taken {
            cortex_m::asm::wfi();
        }
        // SAFETY: no critical section is open.
        unsafe { cortex_m::interrupt::enable() };
        while STORED.load(Ordering::Acquire) != taken {
            let byte = RECEIVED[taken % RING].load(Ordering::Relaxed);
            taken = taken.wrapping_add(1);
            if let Some(Ok(body)) = reader.push(byte)
                && let Ok(Packet { message: Message::Sample(sample), .. }) = Packet::decode(body)
            {
                now_us = sample.time_us;
            }
            device.receive(&[byte], now_us, send);
        }
    }
}

#[interrupt]
fn USART2() {
    // SAFETY: reading status, then data, clears the request; only this handler reads the data
    // register.
    let usart = unsafe { &*pac::USART2::ptr() };
    if u32::from(usart.sr().read().bits()) & RECEIVED_DATA != 0 {
        let byte = usart.dr().read().bits() as u8;
        let stored = STORED.load(Ordering::Relaxed);
        RECEIVED[stored % RING].store(byte, Ordering::Relaxed);
        STORED.store(stored.wrapping_add(1), Ordering::Release);
    }
}

fn send(frame: &[u8]) {
    // SAFETY: only the main loop sends, or a fault handler after the main loop has stopped.
    let usart = unsafe { &*pac::USART2::ptr() };
    for &byte in frame {
        let _ = (0..ROUNDS).any(|_| u32::from(usart.sr().read().bits()) & TRANSMIT_EMPTY != 0);
        // SAFETY: nine bits of data.
        usart.dr().write(|w| unsafe { w.bits(u16::from(byte)) });
    }
}

#[exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    // SAFETY: reads of the fault status registers.
    let (cfsr, address) = unsafe { ((*SCB::PTR).cfsr.read(), (*SCB::PTR).bfar.read()) };
    end(FaultReport { code: HARD_FAULT, pc: frame.pc(), lr: frame.lr(), cfsr, address })
}

#[panic_handler]
fn panic(info: &PanicInfo<'_>) -> ! {
    cortex_m::interrupt::disable();
    let address = info.location().map_or(0, |location| core::ptr::from_ref(location) as u32);
    end(FaultReport { code: PANIC, pc: 0, lr: 0, cfsr: 0, address })
}

fn end(report: FaultReport) -> ! {
    send(&[0]);
    send(Packet { sequence: 0, message: Message::Fault(report) }.encode().as_bytes());
    SCB::sys_reset()
}
