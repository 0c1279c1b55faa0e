//! Defines the steps of a script and turns them into exchanges. An exchange consists of frames that
//! the controller does not answer and one frame that it answers.

use platebench_wire::{Configure, EncodedFrame, Message, Packet, Sample};
use std::time::Duration;

/// Silence between the two pieces of [`Step::InPieces`].
const PAUSE: Duration = Duration::from_millis(5);
const STALL: Duration = Duration::from_millis(80);

/// A step of a script. The three `f32` of a step are setpoint, Wd and Wq of a sample, µm.
#[derive(Debug, Clone)]
pub(super) enum Step {
    // Exchanges.
    Setup(Configure),
    Sample(f32, f32, f32),
    /// Sends the bytes of the last sample again.
    Repeat,
    /// Sends a sample with the number of the last message plus the first field, and with a time that
    /// is as many periods later.
    Ahead(u8, f32, f32, f32),
    /// Sends a sample in two pieces, with a silence after the first `usize` bytes.
    InPieces(usize, f32, f32, f32),
    Ask(Message),
    /// Sends a frame with a valid CRC.
    AskBody(Vec<u8>),
    /// Sends nothing for this time, ms.
    Silence(u64),

    // Before the next exchange.
    /// Sends nothing for this time, ms.
    Wait(u64),
    WaitUs(u64),
    Send(Message),
    Bytes(Vec<u8>),
    /// Sends a frame with a valid CRC.
    Body(Vec<u8>),
    /// Sends a sample that is invalid, because one bit of this byte is flipped. Its values differ
    /// from those of the script's other samples.
    Damaged(usize),
    /// Sends as many damaged samples.
    Rejected(usize),
}

#[derive(Debug, Clone)]
pub(super) struct Script {
    pub(super) name: &'static str,
    /// If an exchange is later than planned by more than this time, the watchdog may act.
    pub(super) stall: Duration,
    pub(super) exchanges: Vec<Exchange>,
}

#[derive(Debug, Clone)]
pub(super) struct Exchange {
    /// Silence before the exchange.
    pub(super) wait: Duration,
    pub(super) bytes: Vec<u8>,
}

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

impl Script {
    pub(super) fn new(name: &'static str, variation: Variation, steps: impl IntoIterator<Item = Step>) -> Self {
        let mut encoder = Encoder {
            exchanges: Vec::new(),
            variation,
            period_us: 0,
            // The sequence numbers start at 248, so that they wrap within the first messages.
            sequence: 248,
            time_us: 0,
            unanswered: Vec::new(),
            wait: Duration::ZERO,
            last_sample: Vec::new(),
        };
        for step in steps {
            encoder.add(step);
        }
        Self { name, stall: STALL, exchanges: encoder.exchanges }
    }
}

struct Encoder {
    exchanges: Vec<Exchange>,
    variation: Variation,
    period_us: u32,
    sequence: u8,
    time_us: u32,
    unanswered: Vec<u8>,
    wait: Duration,
    last_sample: Vec<u8>,
}

impl Encoder {
    fn add(&mut self, step: Step) {
        match step {
            Step::Setup(configure) => self.configure(configure),
            Step::Sample(setpoint, wd, wq) => {
                let sequence = self.next_sequence();
                self.sample(sequence, [setpoint, wd, wq]);
            }
            Step::Repeat => {
                let bytes = self.last_sample.clone();
                self.close(&bytes);
            }
            Step::Ahead(ahead, setpoint, wd, wq) => {
                self.sequence = self.sequence.wrapping_add(ahead);
                self.time_us = self.time_us.wrapping_add(self.period_us.wrapping_mul(ahead.into()));
                self.sample(self.sequence, [setpoint, wd, wq]);
            }
            Step::InPieces(at, setpoint, wd, wq) => {
                self.add(Step::Sample(setpoint, wd, wq));
                if let Some(whole) = self.exchanges.pop() {
                    let (first, second) = whole.bytes.split_at(at.min(whole.bytes.len()));
                    self.exchanges.push(Exchange { wait: whole.wait, bytes: first.to_vec() });
                    self.exchanges.push(Exchange { wait: PAUSE, bytes: second.to_vec() });
                }
            }
            Step::Ask(message) => {
                let frame = self.frame(message);
                self.close(&frame);
            }
            Step::AskBody(body) => {
                if let Some(frame) = EncodedFrame::new(&body) {
                    self.close(frame.as_bytes());
                }
            }
            Step::Silence(ms) => {
                self.wait = Duration::from_millis(ms);
                self.close(&[]);
            }
            Step::Wait(ms) => self.wait = Duration::from_millis(ms),
            Step::WaitUs(us) => self.wait = Duration::from_micros(us),
            Step::Send(message) => {
                let frame = self.frame(message);
                self.unanswered.extend(frame);
            }
            Step::Bytes(bytes) => self.unanswered.extend(bytes),
            Step::Body(body) => {
                if let Some(frame) = EncodedFrame::new(&body) {
                    self.unanswered.extend_from_slice(frame.as_bytes());
                }
            }
            Step::Damaged(position) => self.damaged(position),
            Step::Rejected(count) => (0..count).for_each(|_| self.damaged(5)),
        }
    }

    fn configure(&mut self, configure: Configure) {
        (self.period_us, self.time_us) = (configure.period_us, 0);
        let gain = if configure.gains.is_none() { self.variation.gain } else { 1.0 };
        let gain_um_per_vpp = configure.gain_um_per_vpp * gain;
        self.add(Step::Ask(Message::Configure(Configure { gain_um_per_vpp, ..configure })));
    }

    fn sample(&mut self, sequence: u8, [setpoint_um, wd_um, wq_um]: [f32; 3]) {
        let components = self.variation.components;
        let change = |number: u8| if number.is_multiple_of(2) { components } else { -components };
        let (wd_um, wq_um) = (wd_um * (1.0 + change(sequence)), wq_um * (1.0 + change(sequence / 2)));
        let sample = Sample { time_us: self.time_us, setpoint_um, wd_um, wq_um };
        self.time_us = self.time_us.wrapping_add(self.period_us);
        self.last_sample = Packet { sequence, message: Message::Sample(sample) }.encode().as_bytes().to_vec();
        self.add(Step::Repeat);
    }

    fn damaged(&mut self, position: usize) {
        let sample = Sample { time_us: self.time_us, setpoint_um: 3.0, wd_um: 0.7, wq_um: -0.3 };
        let mut frame = self.frame(Message::Sample(sample));
        let data = frame.len() - 1;
        if let Some(byte) = frame.get_mut(position % data) {
            // The byte must not become 0, because 0 is the delimiter of frames.
            *byte ^= if *byte == 1 { 2 } else { 1 };
        }
        self.unanswered.extend(frame);
    }

    fn frame(&mut self, message: Message) -> Vec<u8> {
        let sequence = self.next_sequence();
        Packet { sequence, message }.encode().as_bytes().to_vec()
    }

    fn close(&mut self, request: &[u8]) {
        let mut bytes = std::mem::take(&mut self.unanswered);
        bytes.extend_from_slice(request);
        self.exchanges.push(Exchange { wait: std::mem::take(&mut self.wait), bytes });
    }

    fn next_sequence(&mut self) -> u8 {
        self.sequence = self.sequence.wrapping_add(1);
        self.sequence
    }
}
