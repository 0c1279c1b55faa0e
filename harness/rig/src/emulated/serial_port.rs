//! USART2 with DMA in a few events per frame instead of one per word.
//!
//! The emulator's own models of USART and DMA stay in charge of all registers, flags and memory.
//! This port only defers words whose effects nothing can see: while the firmware sleeps or computes,
//! one request transports many words at once, as a block. The first and the last words of a frame,
//! the idle line and all interrupts keep their instants. An access of the firmware to USART2 or
//! DMA1 first transports the words that are due. If registers or data do not allow a block, the
//! words pass one by one.
//!
//! ```text
//! received frame   word 1 … word n-1 | word n        block at the end of word n-1, then the model
//! sent frame       word 1 | … word m-2 | m-1 | m     block at the end of word m-2, then the model
//! ```

use super::board::UartPeer;
use rigless::device::{Device, DeviceContext, Level, RegisterFile};
use rigless::snapshot::{self, Reader, Store, Writer};
use rigless::soc::stm32f427::generated::dma2::Register as Dma;
use rigless::soc::stm32f427::generated::usart6::{Register, brr, cr1, cr2};
use rigless::soc::stm32f427::peripherals::rcc::HSI_HZ;
use rigless::soc::stm32f427::peripherals::usart::{Kind, RECEIVE_REQUEST, TRANSMIT_REQUEST, Usart};
use rigless::soc::{Bus, RegisterSpec, Slot};
use rigless::time::{EventId, VirtualNanos};
use std::collections::VecDeque;

pub(super) const USART2: &str = "USART2";
pub(super) const DMA1: &str = "DMA1";
const DATA_REGISTER: u64 = 0x4000_4404;
/// Shorter blocks save nothing.
const MIN_BLOCK: usize = 3;
const NS_PER_S: u128 = 1_000_000_000;
/// Half bits of start bit and eight data bits, and of the stop bits by `STOP` (RM0090, 30.6.5).
const HALF_BITS: u128 = 18;
const STOP_HALF_BITS: [u128; 4] = [2, 1, 4, 3];

/// Bits of `USART_CR1` that decide whether words may pass as a block (RM0090, 30.6.4).
mod control {
    pub(super) const UE: u64 = 1 << 13;
    pub(super) const TE: u64 = 1 << 3;
    pub(super) const RE: u64 = 1 << 2;
    const NINE_BITS_OR_PARITY: u64 = 1 << 12 | 1 << 10;
    /// Also interrupts per word, mute mode and break.
    pub(super) const RECEIVING: u64 = UE | RE | NINE_BITS_OR_PARITY | 1 << 8 | 1 << 5 | 1 << 1;
    pub(super) const SENDING: u64 = UE | TE | NINE_BITS_OR_PARITY | 1 << 7 | 1;
    /// `USART_CR3`.
    pub(super) const DMAT: u64 = 1 << 7;
    pub(super) const DMAR: u64 = 1 << 6;
    /// `USART_SR`: RXNE, ORE, NF, FE.
    pub(super) const RECEIVED_OR_ERROR: u64 = 0b10_1110;
}

/// Bits of `DMA_SxCR` (RM0090, 10.5.5).
mod stream {
    pub(super) const CIRC: u64 = 1 << 8;
    const EN_MINC_CHANNEL_4: u64 = 1 | 1 << 10 | 4 << 25;
    /// EN, HTIE, PFCTRL, DIR, PINC, MINC, PSIZE, DBM, CHSEL.
    const CONFIGURATION: u64 = 1 | 1 << 3 | 0b111 << 5 | 1 << 9 | 1 << 10 | 0b11 << 11 | 1 << 18 | 0b111 << 25;
    /// Mask and value. No interrupt at half or end of the ring.
    pub(super) const RECEIVING: (u64, u64) = (CONFIGURATION | 1 << 4, EN_MINC_CHANNEL_4);
    pub(super) const SENDING: (u64, u64) = (CONFIGURATION | CIRC, EN_MINC_CHANNEL_4 | 1 << 6);
    /// `DMA_SxFCR`: no direct mode.
    pub(super) const DMDIS: u64 = 1 << 2;
}

/// Words that have not passed the models yet.
#[derive(Debug, Default)]
enum Transfer {
    #[default]
    None,
    /// The next of `words` starts at `start`.
    Receiving {
        words: VecDeque<u8>,
        start: u64,
        word_ns: u64,
    },
    Sending(Sending),
}

/// A transfer of the transmit DMA stream. The model of the USART keeps the first two words in its
/// registers until `forward_word` ends; it then continues with that word and the next.
#[derive(Debug)]
struct Sending {
    /// The model's event at the end of the first word; `None` before it.
    event: Option<EventId>,
    first_end: u64,
    word_ns: u64,
    /// Words that the DMA stream has written.
    words: Vec<u8>,
    /// Number of words that the bench has received.
    reported: usize,
    forward_word: usize,
}

impl Sending {
    fn end_of(&self, word: usize) -> u64 {
        self.first_end + word as u64 * self.word_ns
    }

    /// Number of words that ended by `now` before `forward_word`.
    fn ended(&self, now: u64) -> usize {
        let ended = now.checked_sub(self.first_end).map_or(0, |since| since / self.word_ns + 1);
        self.forward_word.min(usize::try_from(ended).unwrap_or(usize::MAX))
    }
}

/// Words that pass between the DMA controller and the data register during one request.
#[derive(Debug, Default)]
enum Block {
    #[default]
    None,
    Read(VecDeque<u8>),
    Written(usize),
}

#[derive(Debug)]
pub(super) struct SerialPort {
    pub(super) usart: Usart,
    clock_hz: u64,
    /// If false, all words pass one by one.
    uses_blocks: bool,
    /// True if the processor slept at the last frame of the bench. One that polls may take an
    /// interrupt of a block some instructions earlier or later than those of words.
    processor_sleeps: bool,
    transfer: Transfer,
    block: Block,
    /// Writes to the data register at the last instant at which there was one.
    written: (u64, Vec<u8>),
    pub(super) has_used_blocks: bool,
    pub(super) failure: Option<&'static str>,
}

impl SerialPort {
    pub(super) fn new() -> Self {
        let mut usart = Usart::with_clock(Kind::Usart, HSI_HZ);
        usart.attach(UartPeer::default());
        Self {
            usart,
            clock_hz: HSI_HZ,
            uses_blocks: false,
            processor_sleeps: false,
            transfer: Transfer::None,
            block: Block::None,
            written: (0, Vec::new()),
            has_used_blocks: false,
            failure: None,
        }
    }

    /// Always `Some`, because `new` attaches the peer.
    pub(super) fn wire(&mut self) -> Option<&mut UartPeer> {
        self.usart.chip_mut()
    }

    /// Starts a trial on an idle line.
    pub(super) fn start(&mut self, uses_blocks: bool) {
        self.uses_blocks = uses_blocks;
        self.processor_sleeps = false;
        self.has_used_blocks = false;
        self.transfer = Transfer::None;
        self.block = Block::None;
        self.written = (0, Vec::new());
        self.failure = None;
    }

    pub(super) fn has_deferred_words(&self) -> bool {
        !matches!(self.transfer, Transfer::None)
    }

    /// Ends the transfer at a reset of the chip. The wire keeps the words that have not started.
    pub(super) fn end_transfer(&mut self, now: u64) {
        if let Transfer::Receiving { words, start, word_ns } = std::mem::take(&mut self.transfer)
            && let Some(wire) = self.wire()
        {
            let started = now.saturating_sub(start) / word_ns + 1;
            wire.to_target.extend(words.into_iter().skip(started as usize));
        }
        self.block = Block::None;
        self.written.1.clear();
    }

    /// Resets the chip with `reset`, which needs the model of the USART.
    pub(super) fn reset_chip(&mut self, now: u64, reset: impl FnOnce(&mut Usart)) {
        self.end_transfer(now);
        self.clock_hz = HSI_HZ;
        reset(&mut self.usart);
    }

    /// Duration of a word if it is a whole number of nanoseconds.
    fn word_ns(&self, usart: &RegisterFile) -> Option<u64> {
        let value = usart.get(Register::Brr);
        let (mantissa, fraction) = (brr::DIV_MANTISSA.get(value), brr::DIV_FRACTION.get(value));
        let bit_cycles = if cr1::OVER8.is_set(usart.get(Register::Cr1)) {
            mantissa << 3 | fraction & 0b111
        } else {
            mantissa << 4 | fraction
        };
        let stop = STOP_HALF_BITS.get(cr2::STOP.get(usart.get(Register::Cr2)) as usize)?;
        let cycles = (HALF_BITS + stop) * u128::from(bit_cycles) * NS_PER_S;
        let hz = 2 * u128::from(self.clock_hz);
        let is_exact = cycles > 0 && cycles.checked_rem(hz) == Some(0);
        is_exact.then(|| u64::try_from(cycles / hz).ok()).flatten()
    }

    /// Starts to transport `bytes` from the bench as a block. Returns the instant at which the port
    /// needs an event, or `None` if the words must pass one by one.
    pub(super) fn start_receiving(
        &mut self,
        bytes: &[u8],
        now: u64,
        processor_sleeps: bool,
        bus: &Bus,
        slots: Slots,
    ) -> Option<VirtualNanos> {
        self.processor_sleeps = processor_sleeps;
        let (usart, dma) = (slots.usart(bus)?, slots.dma(bus)?);
        let word_ns = self.word_ns(usart)?;
        self.check_block();
        let wire = self.wire()?;
        // The line was idle for longer than a word, so that the model expects no event.
        let is_idle = wire.to_target.is_empty() && wire.last_word_start.is_none_or(|start| now > start + 2 * word_ns);
        let (mask, value) = stream::RECEIVING;
        let stream = dma.get(Dma::S5cr);
        let is_possible = self.uses_blocks
            && processor_sleeps
            && matches!(self.transfer, Transfer::None)
            && is_idle
            && bytes.len() > MIN_BLOCK
            && usart.get(Register::Cr1) & control::RECEIVING == control::UE | control::RE
            && usart.get(Register::Cr3) & control::DMAR != 0
            && usart.get(Register::Sr) & control::RECEIVED_OR_ERROR == 0
            && stream & mask == value
            && dma.get(Dma::S5fcr) & stream::DMDIS == 0
            && dma.get(Dma::S5par) == DATA_REGISTER
            && (stream & stream::CIRC != 0 || dma.get(Dma::S5ndtr) > bytes.len() as u64);
        if !is_possible {
            return None;
        }
        self.transfer = Transfer::Receiving { words: bytes.iter().copied().collect(), start: now, word_ns };
        Some(VirtualNanos(now + (bytes.len() as u64 - 1) * word_ns))
    }

    /// Call it after an access to the transmit DMA stream at `now`. `read` returns memory of the
    /// target.
    pub(super) fn start_sending<'a>(
        &mut self,
        now: u64,
        bus: &Bus,
        slots: Slots,
        read: impl FnOnce(u64, usize) -> Option<&'a [u8]>,
    ) -> Option<()> {
        let (usart, dma) = (slots.usart(bus)?, slots.dma(bus)?);
        let (mask, value) = stream::SENDING;
        if !self.uses_blocks
            || !self.processor_sleeps
            || self.has_deferred_words()
            || dma.get(Dma::S6cr) & mask != value
        {
            return None;
        }
        let word_ns = self.word_ns(usart)?;
        let first_end = now + word_ns;
        let wire = self.wire()?;
        // No word arrives, and the idle line is detected at another instant.
        let is_receiving = !wire.to_target.is_empty()
            || wire.last_word_start.is_some_and(|start| now < start + word_ns || first_end == start + 2 * word_ns);
        let is_possible = !is_receiving
            && self.written.0 == now
            && self.written.1.len() == 2
            && usart.get(Register::Cr1) & control::SENDING == control::UE | control::TE
            && usart.get(Register::Cr3) & control::DMAT != 0
            && dma.get(Dma::S6fcr) & stream::DMDIS == 0
            && dma.get(Dma::S6par) == DATA_REGISTER;
        let left = dma.get(Dma::S6ndtr) as usize;
        if !is_possible || left < MIN_BLOCK {
            return None;
        }
        let rest = read(dma.get(Dma::S6m0ar) + 2, left)?;
        // The bench acts at the end of each frame, so only the last word may end one.
        let (_, within) = rest.split_last()?;
        if self.written.1.iter().chain(within).any(|&byte| byte == 0) {
            return None;
        }
        let total = left + 2;
        self.transfer = Transfer::Sending(Sending {
            event: None,
            first_end,
            word_ns,
            words: std::mem::take(&mut self.written.1),
            reported: 0,
            forward_word: total - 2,
        });
        Some(())
    }

    /// Requests the words that are due at `now` as a block. Returns true if there are any; they
    /// pass when the part settles.
    pub(super) fn catch_up(&mut self, now: u64, bus: &mut Bus, slots: Slots) -> bool {
        let (_, mut context) = bus.drive(VirtualNanos(now), slots.usart);
        match &mut self.transfer {
            Transfer::Receiving { words, start, word_ns } => {
                let due = (now.saturating_sub(*start) / *word_ns) as usize;
                let due = due.min(words.len() - 1);
                *start += due as u64 * *word_ns;
                let block: VecDeque<u8> = words.drain(..due).collect();
                self.read_block(block, &mut context)
            }
            Transfer::Sending(sending) if sending.event.is_some() => {
                let due = (sending.ended(now) + 2).saturating_sub(sending.words.len());
                self.write_block(due, &mut context)
            }
            Transfer::Sending(_) | Transfer::None => false,
        }
    }

    fn read_block(&mut self, words: VecDeque<u8>, context: &mut DeviceContext<'_>) -> bool {
        if words.is_empty() {
            return false;
        }
        self.block = Block::Read(words);
        self.has_used_blocks = true;
        context.request(RECEIVE_REQUEST, Level::High);
        true
    }

    fn write_block(&mut self, count: usize, context: &mut DeviceContext<'_>) -> bool {
        if count == 0 {
            return false;
        }
        self.block = Block::Written(count);
        self.has_used_blocks = true;
        context.request(TRANSMIT_REQUEST, Level::High);
        true
    }

    fn check_block(&mut self) {
        if !matches!(self.block, Block::None) {
            self.failure = Some("the DMA stream did not transport all words of a block");
        }
    }

    /// Gives the bench the words that ended by `now`, after the part has settled.
    pub(super) fn report_sent(&mut self, now: u64) {
        self.check_block();
        if let Transfer::Sending(sending) = &mut self.transfer
            && let Some(wire) = self.usart.chip_mut::<UartPeer>()
        {
            let ended = sending.ended(now);
            for word in sending.reported..ended {
                if let Some(&byte) = sending.words.get(word) {
                    wire.push_received(byte, sending.end_of(word));
                }
            }
            sending.reported = sending.reported.max(ended);
        }
    }

    /// Lets the model continue word by word, after [`Self::catch_up`] and [`Self::report_sent`].
    pub(super) fn continue_word_by_word(&mut self, now: u64, bus: &mut Bus, slots: Slots) {
        match std::mem::take(&mut self.transfer) {
            Transfer::Receiving { words, start, .. } => {
                if let Some(wire) = self.wire() {
                    wire.to_target.extend(words);
                }
                let (registers, mut context) = bus.drive(VirtualNanos(start), slots.usart);
                self.usart.poll(registers, &mut context);
            }
            Transfer::Sending(mut sending) if sending.event.is_some() => {
                sending.forward_word = sending.ended(now);
                let (_, mut context) = bus.drive(VirtualNanos(now), slots.usart);
                context.schedule(VirtualNanos(sending.end_of(sending.forward_word)));
                self.transfer = Transfer::Sending(sending);
            }
            Transfer::Sending(_) | Transfer::None => {}
        }
    }

    /// Handles the port's own instants. Returns false if the model must not see `event`.
    fn advance(&mut self, event: EventId, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) -> bool {
        let now = context.now().0;
        match &mut self.transfer {
            Transfer::Receiving { words, start, word_ns } => {
                if now >= *start + (words.len() as u64 - 1) * *word_ns {
                    let mut words = std::mem::take(words);
                    self.transfer = Transfer::None;
                    if let Some((last, wire)) = words.pop_back().zip(self.wire()) {
                        wire.to_target.push_back(last);
                    }
                    self.read_block(words, context);
                    self.usart.poll(registers, context);
                }
            }
            Transfer::Sending(sending) => match sending.event {
                None if now == sending.first_end => {
                    sending.event = Some(event);
                    context.schedule(VirtualNanos(sending.end_of(sending.forward_word - 1)));
                    return false;
                }
                None => {}
                Some(first) if now == sending.end_of(sending.forward_word) => {
                    self.report_sent(now);
                    self.forward(first, registers, context);
                }
                Some(_) => {
                    let due = (sending.ended(now) + 2).saturating_sub(sending.words.len());
                    context.schedule(VirtualNanos(sending.end_of(sending.forward_word)));
                    self.write_block(due, context);
                }
            },
            Transfer::None => {}
        }
        true
    }

    /// Lets the model send the word at `forward_word` and the next one, under the words that its
    /// registers hold.
    fn forward(&mut self, first: EventId, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        let Transfer::Sending(sending) = std::mem::take(&mut self.transfer) else { return };
        let words = sending.words.get(sending.forward_word..sending.forward_word + 2);
        match words.zip(self.wire()) {
            Some((words, wire)) => wire.substitutes.extend(words),
            None => self.failure = Some("the DMA stream ended before the frame"),
        }
        self.usart.on_event(first, registers, context);
    }
}

/// Stores a port without deferred words.
impl Store for SerialPort {
    fn store(&self, to: &mut Writer) -> Result<(), snapshot::Error> {
        to.put(&self.clock_hz)?;
        self.usart.store(to)
    }

    fn load(&mut self, from: &mut Reader) -> Result<(), snapshot::Error> {
        self.clock_hz = from.take()?;
        self.usart.load(from)
    }
}

/// Places of the two models on the bus.
#[derive(Debug, Clone, Copy)]
pub(super) struct Slots {
    pub(super) usart: usize,
    pub(super) dma: usize,
}

impl Slots {
    fn usart(self, bus: &Bus) -> Option<&RegisterFile> {
        bus.slots().get(self.usart).map(Slot::registers)
    }

    fn dma(self, bus: &Bus) -> Option<&RegisterFile> {
        bus.slots().get(self.dma).map(Slot::registers)
    }
}

impl Device for SerialPort {
    type Register = Register;

    fn layout(&self) -> &'static [RegisterSpec] {
        Device::layout(&self.usart)
    }

    fn read(
        &mut self,
        register: Register,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) -> Option<u64> {
        if register == Register::Dr
            && let Block::Read(words) = &mut self.block
        {
            let word = words.pop_front();
            if words.is_empty() {
                self.block = Block::None;
                context.request(RECEIVE_REQUEST, Level::Low);
            }
            return word.map(u64::from);
        }
        Device::read(&mut self.usart, register, registers, context)
    }

    fn peek(&self, register: Register, registers: &RegisterFile, now: VirtualNanos) -> Option<u64> {
        Device::peek(&self.usart, register, registers, now)
    }

    fn write(&mut self, register: Register, value: u64, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        if register == Register::Dr {
            if let (Block::Written(left), Transfer::Sending(sending)) = (&mut self.block, &mut self.transfer) {
                sending.words.push(value as u8);
                *left -= 1;
                if *left == 0 {
                    self.block = Block::None;
                    context.request(TRANSMIT_REQUEST, Level::Low);
                }
                return;
            }
            let now = context.now().0;
            if self.written.0 != now {
                self.written = (now, std::mem::take(&mut self.written.1));
                self.written.1.clear();
            }
            self.written.1.push(value as u8);
        }
        Device::write(&mut self.usart, register, value, registers, context);
    }

    fn on_event(&mut self, event: EventId, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        if self.advance(event, registers, context) {
            self.usart.on_event(event, registers, context);
        }
    }

    fn on_clock(&mut self, hz: u64, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        self.clock_hz = hz;
        self.usart.on_clock(hz, registers, context);
    }

    fn poll(&mut self, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        self.usart.poll(registers, context);
    }

    fn reset(&mut self) {
        Device::reset(&mut self.usart);
    }

    fn reset_line(&mut self, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        self.end_transfer(context.now().0);
        self.usart.reset_line(registers, context);
    }
}
