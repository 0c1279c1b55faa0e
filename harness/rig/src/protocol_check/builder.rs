//! Builds the exchanges of a script. An exchange consists of frames that the controller does not
//! answer and one frame that it answers.

use platebench_wire::{Configure, EncodedFrame, Message, Packet, Sample};
use std::time::Duration;

#[derive(Debug, Clone)]
pub(super) struct Script {
    pub(super) name: &'static str,
    /// If an exchange is later than planned by more than this time, the watchdog may act.
    pub(super) stall: Duration,
    pub(super) exchanges: Vec<Exchange>,
}

pub(super) fn script(name: &'static str, variation: Variation, write: impl FnOnce(&mut Builder)) -> Script {
    let mut builder = Builder::new(name, variation);
    write(&mut builder);
    builder.script
}

const PAUSE: Duration = Duration::from_millis(5);
const STALL: Duration = Duration::from_millis(80);

/// Change of the values in a script's messages. It does not change the number of exchanges.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Variation {
    /// Relative change of Wd and Wq, with signs that alternate over the samples.
    pub(super) components: f32,
    /// Factor on the plate gain K1 in configurations without controller gains.
    pub(super) gain: f32,
}

impl Variation {
    pub(super) const NONE: Self = Self { components: 0.0, gain: 1.0 };
}

#[derive(Debug, Clone)]
pub(super) struct Exchange {
    /// Silence before the exchange.
    pub(super) wait: Duration,
    pub(super) bytes: Vec<u8>,
}

#[derive(Debug)]
pub(super) struct Builder {
    script: Script,
    variation: Variation,
    period_us: u32,
    sequence: u8,
    time_us: u32,
    unanswered: Vec<u8>,
    wait: Duration,
    last_sample: Vec<u8>,
}

impl Builder {
    fn new(name: &'static str, variation: Variation) -> Self {
        Self {
            script: Script { name, stall: STALL, exchanges: Vec::new() },
            variation,
            period_us: 0,
            // The sequence numbers start at 248, so that they wrap within the first messages.
            sequence: 248,
            time_us: 0,
            unanswered: Vec::new(),
            wait: Duration::ZERO,
            last_sample: Vec::new(),
        }
    }

    pub(super) fn has_variation(&self) -> bool {
        self.variation != Variation::NONE
    }

    /// Removes all exchanges, so that the script is not played.
    pub(super) fn discard(&mut self) {
        self.script.exchanges.clear();
    }

    pub(super) fn set_stall_us(&mut self, us: u64) {
        self.script.stall = Duration::from_micros(us);
    }

    pub(super) fn wait_us(&mut self, us: u64) {
        self.wait = Duration::from_micros(us);
    }

    pub(super) fn wait_ms(&mut self, ms: u64) {
        self.wait_us(ms * 1_000);
    }

    pub(super) fn add_wait_ms(&mut self, ms: u64) {
        self.wait_ms(ms);
        self.close(&[]);
    }

    /// Adds bytes before the next message.
    pub(super) fn add(&mut self, bytes: &[u8]) {
        self.unanswered.extend_from_slice(bytes);
    }

    /// Adds a frame with a valid CRC before the next message.
    pub(super) fn add_body(&mut self, body: &[u8]) {
        if let Some(frame) = EncodedFrame::new(body) {
            self.add(frame.as_bytes());
        }
    }

    pub(super) fn add_message(&mut self, message: Message) {
        let sequence = self.next_sequence();
        self.add(Packet { sequence, message }.encode().as_bytes());
    }

    pub(super) fn add_rejected(&mut self, count: usize) {
        for _ in 0..count {
            self.add_damaged(5);
        }
    }

    /// Adds a sample that is invalid, because one bit of byte `position` is flipped. Its values
    /// differ from those of the script's other samples.
    pub(super) fn add_damaged(&mut self, position: usize) {
        let sequence = self.next_sequence();
        let sample = Sample { time_us: self.time_us, setpoint_um: 3.0, wd_um: 0.7, wq_um: -0.3 };
        let mut frame = Packet { sequence, message: Message::Sample(sample) }.encode().as_bytes().to_vec();
        let data = frame.len() - 1;
        if let Some(byte) = frame.get_mut(position % data) {
            // The byte must not become 0, because 0 is the delimiter of frames.
            *byte ^= if *byte == 1 { 2 } else { 1 };
        }
        self.add(&frame);
    }

    pub(super) fn ask_body(&mut self, body: &[u8]) {
        if let Some(frame) = EncodedFrame::new(body) {
            self.close(frame.as_bytes());
        }
    }

    pub(super) fn ask(&mut self, message: Message) {
        let sequence = self.next_sequence();
        self.close(Packet { sequence, message }.encode().as_bytes());
    }

    pub(super) fn configure(&mut self, configure: Configure) {
        (self.period_us, self.time_us) = (configure.period_us, 0);
        let gain = if configure.gains.is_none() { self.variation.gain } else { 1.0 };
        let gain_um_per_vpp = configure.gain_um_per_vpp * gain;
        self.ask(Message::Configure(Configure { gain_um_per_vpp, ..configure }));
    }

    pub(super) fn sample(&mut self, setpoint_um: f32, wd_um: f32, wq_um: f32) {
        let sequence = self.next_sequence();
        self.sample_with(sequence, setpoint_um, wd_um, wq_um);
    }

    /// Adds a sample with the number of the last message plus `ahead`, and with a time that is
    /// `ahead` periods later.
    pub(super) fn sample_after(&mut self, ahead: u8, setpoint_um: f32, wd_um: f32, wq_um: f32) {
        self.sequence = self.sequence.wrapping_add(ahead);
        self.time_us = self.time_us.wrapping_add(self.period_us.wrapping_mul(ahead.into()));
        self.sample_with(self.sequence, setpoint_um, wd_um, wq_um);
    }

    /// Adds a sample in two pieces, with a silence after the first `at` bytes.
    pub(super) fn sample_in_pieces(&mut self, at: usize, setpoint_um: f32, wd_um: f32, wq_um: f32) {
        self.sample(setpoint_um, wd_um, wq_um);
        if let Some(whole) = self.script.exchanges.pop() {
            let (first, second) = whole.bytes.split_at(at.min(whole.bytes.len()));
            self.script.exchanges.push(Exchange { wait: whole.wait, bytes: first.to_vec() });
            self.script.exchanges.push(Exchange { wait: PAUSE, bytes: second.to_vec() });
        }
    }

    pub(super) fn repeat_sample(&mut self) {
        let bytes = self.last_sample.clone();
        self.close(&bytes);
    }

    fn sample_with(&mut self, sequence: u8, setpoint_um: f32, wd_um: f32, wq_um: f32) {
        let components = self.variation.components;
        let change = |number: u8| if number.is_multiple_of(2) { components } else { -components };
        let (wd_um, wq_um) = (wd_um * (1.0 + change(sequence)), wq_um * (1.0 + change(sequence / 2)));
        let sample = Sample { time_us: self.time_us, setpoint_um, wd_um, wq_um };
        self.time_us = self.time_us.wrapping_add(self.period_us);
        self.last_sample = Packet { sequence, message: Message::Sample(sample) }.encode().as_bytes().to_vec();
        self.repeat_sample();
    }

    fn close(&mut self, request: &[u8]) {
        let mut bytes = std::mem::take(&mut self.unanswered);
        bytes.extend_from_slice(request);
        self.script.exchanges.push(Exchange { wait: std::mem::take(&mut self.wait), bytes });
    }

    fn next_sequence(&mut self) -> u8 {
        self.sequence = self.sequence.wrapping_add(1);
        self.sequence
    }
}

/// Returns a configuration with the number 80. `values` are the floats from byte 14 on.
pub(super) fn configuration_body(configure: &Configure, bits: u8, values: [f32; 10]) -> Vec<u8> {
    let mut body = vec![0x13, 80, configure.law as u8, bits];
    body.extend_from_slice(&configure.watchdog_timeout_ms.to_le_bytes());
    for number in [configure.period_us, configure.start_frequency_mhz] {
        body.extend_from_slice(&number.to_le_bytes());
    }
    for value in values {
        body.extend_from_slice(&value.to_le_bytes());
    }
    body
}
