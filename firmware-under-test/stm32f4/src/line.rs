//! Receives and sends bytes on USART2: PA2 (TX), PA3 (RX), 8N1.
//!
//! DMA1 stream 5 writes received bytes to a ring, stream 6 sends (both channel 4, RM0090 table 42).

use crate::clock;
use core::cell::UnsafeCell;
use core::sync::atomic::{AtomicBool, Ordering, compiler_fence};
use pac::interrupt;
use stm32f4::stm32f405 as pac;

/// 1 Mbaud divides both possible APB1 clocks, 42 MHz and 16 MHz.
const BAUD: u32 = 1_000_000;
const BITS_PER_BYTE: u32 = 10;

const RING: usize = 512;
const OUTBOX: usize = 256;

const TAKE_WITHOUT_IDLE: usize = RING / 2;

const DATA_REGISTER: u32 = 0x4000_4404;
const CHANNEL_4: u32 = 4 << 25;
const MEMORY_INCREMENT: u32 = 1 << 10;
const CIRCULAR: u32 = 1 << 8;
const TO_PERIPHERAL: u32 = 1 << 6;
const ENABLE: u32 = 1;

#[repr(C, align(4))]
struct Shared<const N: usize>(UnsafeCell<[u8; N]>);

// SAFETY: the chip has one core, and only the main loop accesses the bytes. It never touches the
// bytes that the DMA stream transfers at that moment.
unsafe impl<const N: usize> Sync for Shared<N> {}

impl<const N: usize> Shared<N> {
    const fn new() -> Self {
        Self(UnsafeCell::new([0; N]))
    }

    fn start(&self) -> *mut u8 {
        self.0.get().cast()
    }
}

static RECEIVED: Shared<RING> = Shared::new();
static LEAVING: Shared<OUTBOX> = Shared::new();
static IDLE: AtomicBool = AtomicBool::new(false);

pub(crate) struct Inbox {
    taken: usize,
}

pub(crate) struct Outbox {
    bytes: [u8; OUTBOX],
    length: usize,
}

pub(crate) fn start(p: &pac::Peripherals, apb1_hz: u32) -> (Inbox, Outbox) {
    // SAFETY: only this module uses these pins, streams and USART; values of RM0090 chapters 8, 10
    // and 30. The streams are configured while disabled.
    unsafe {
        p.RCC.ahb1enr().modify(|r, w| w.bits(r.bits() | 1 | 1 << 21)); // GPIOA, DMA1
        p.RCC.apb1enr().modify(|r, w| w.bits(r.bits() | 1 << 17)); // USART2
        p.GPIOA.pupdr().modify(|r, w| w.bits(r.bits() & !(0b11 << 6) | 0b01 << 6)); // PA3 pull-up
        p.GPIOA.afrl().modify(|r, w| w.bits(r.bits() & !(0xFF << 8) | 0x77 << 8));
        p.GPIOA.moder().modify(|r, w| w.bits(r.bits() & !(0b1111 << 4) | 0b1010 << 4));
        let receive = p.DMA1.st(5);
        receive.par().write(|w| w.bits(DATA_REGISTER));
        receive.m0ar().write(|w| w.bits(RECEIVED.start() as u32));
        receive.ndtr().write(|w| w.bits(RING as u32));
        receive.cr().write(|w| w.bits(CHANNEL_4 | MEMORY_INCREMENT | CIRCULAR));
        receive.cr().write(|w| w.bits(CHANNEL_4 | MEMORY_INCREMENT | CIRCULAR | ENABLE));
        let send = p.DMA1.st(6);
        send.par().write(|w| w.bits(DATA_REGISTER));
        send.m0ar().write(|w| w.bits(LEAVING.start() as u32));
        send.cr().write(|w| w.bits(CHANNEL_4 | MEMORY_INCREMENT | TO_PERIPHERAL));
        p.USART2.brr().write(|w| w.bits(((apb1_hz + BAUD / 2) / BAUD) as u16));
        p.USART2.cr3().write(|w| w.bits(1 << 7 | 1 << 6)); // DMAT, DMAR
        p.USART2.cr1().write(|w| w.bits(1 << 13 | 1 << 4 | 1 << 3 | 1 << 2)); // UE, IDLEIE, TE, RE
        cortex_m::peripheral::NVIC::unmask(pac::Interrupt::USART2);
    }
    (Inbox { taken: 0 }, Outbox { bytes: [0; OUTBOX], length: 0 })
}

impl Inbox {
    pub(crate) fn went_idle() -> bool {
        IDLE.load(Ordering::Relaxed)
    }

    /// Returns the bytes since the last call, if the line is idle or at least [`TAKE_WITHOUT_IDLE`]
    /// bytes are available. Ends at the end of the ring, so the caller repeats the call until it
    /// returns nothing.
    pub(crate) fn take(&mut self, p: &pac::Peripherals) -> &[u8] {
        let idle = IDLE.swap(false, Ordering::Acquire);
        let written = (RING - p.DMA1.st(5).ndtr().read().bits() as usize) % RING;
        let waiting = (written + RING - self.taken) % RING;
        if waiting == 0 || !idle && waiting < TAKE_WITHOUT_IDLE {
            return &[];
        }
        compiler_fence(Ordering::SeqCst);
        let from = self.taken;
        let until = if written > from { written } else { RING };
        self.taken = until % RING;
        if self.taken != written {
            IDLE.store(true, Ordering::Release);
        }
        // SAFETY: `from..until` lies in the ring behind the stream's position; the stream reaches
        // it again after 5 ms.
        unsafe { core::slice::from_raw_parts(RECEIVED.start().add(from), until - from) }
    }
}

impl Outbox {
    pub(crate) fn put(&mut self, frame: &[u8]) {
        if let Some(place) = self.bytes.get_mut(self.length..self.length + frame.len()) {
            place.copy_from_slice(frame);
            self.length += frame.len();
        }
    }

    /// Waits for the previous transfer, at most for the duration of the longest one.
    pub(crate) fn flush(&mut self, p: &pac::Peripherals) {
        if self.length == 0 {
            return;
        }
        let send = p.DMA1.st(6);
        let since = clock::now_us(p);
        while send.cr().read().bits() & ENABLE != 0 {
            if clock::now_us(p).wrapping_sub(since) > OUTBOX as u32 * BITS_PER_BYTE * 1_000_000 / BAUD {
                break;
            }
        }
        // SAFETY: only this module uses stream 6, disabled before memory and length change; HIFCR
        // clears its flags.
        unsafe {
            send.cr().write(|w| w.bits(CHANNEL_4 | MEMORY_INCREMENT | TO_PERIPHERAL));
            p.DMA1.hifcr().write(|w| w.bits(0x3D << 16));
            LEAVING.start().copy_from_nonoverlapping(self.bytes.as_ptr(), self.length);
            compiler_fence(Ordering::SeqCst);
            cortex_m::asm::dmb();
            send.ndtr().write(|w| w.bits(self.length as u32));
            send.cr().write(|w| w.bits(CHANNEL_4 | MEMORY_INCREMENT | TO_PERIPHERAL | ENABLE));
        }
        self.length = 0;
    }
}

#[interrupt]
fn USART2() {
    // SAFETY: reading status, then data, only clears the idle and error flags.
    let usart = unsafe { &*pac::USART2::ptr() };
    let _ = usart.sr().read();
    let _ = usart.dr().read();
    IDLE.store(true, Ordering::Release);
}

/// Sends a delimiter, which ends an unfinished frame, and then `frame`. Fault handlers call it, so
/// it uses neither interrupts nor DMA, and its waits are bounded.
pub(crate) fn send_by_polling(frame: &[u8]) {
    // SAFETY: all other code has stopped for good.
    let usart = unsafe { &*pac::USART2::ptr() };
    // SAFETY: only switches the DMA requests off.
    usart.cr3().modify(|r, w| unsafe { w.bits(r.bits() & !(1 << 7)) });
    for &byte in [0].iter().chain(frame) {
        let _ = (0..20_000).any(|_| usart.sr().read().bits() & 1 << 7 != 0);
        // SAFETY: nine bits of data.
        usart.dr().write(|w| unsafe { w.bits(u16::from(byte)) });
    }
}
