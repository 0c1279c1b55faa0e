//! Defines the steps of a script and turns them into exchanges. An exchange consists of frames that
//! the controller does not answer and one frame that it answers.

use platebench_controller::design::default_response_time_s;
use platebench_model::scenario::{ConfigurationChange, ScenarioMessage, WireNumber};
use platebench_wire::{Configure, EncodedFrame, Gains, LawId, Message, Packet, Sample};
use std::borrow::Cow;
use std::collections::VecDeque;
use std::time::Duration;

/// Silence between the two pieces of [`Step::InPieces`].
const PAUSE: Duration = Duration::from_millis(5);
const STALL: Duration = Duration::from_millis(80);
/// Setpoint, Wd and Wq of [`Step::Damaged`], µm.
const DAMAGED_SAMPLE: [f32; 3] = [3.0, 0.7, -0.3];

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
    /// Sends nothing for this time, ms. Earlier steps without an exchange are sent before it, with a
    /// hello.
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

    /// Plays the last `steps` steps `times` more times.
    Again {
        steps: usize,
        times: u32,
    },
}

impl Step {
    /// `base` is the configuration that the keys of a `configure` change.
    pub(super) fn of_message(message: &ScenarioMessage, base: &Configure) -> Self {
        let bytes = |hex: &str| ScenarioMessage::bytes_of(hex).unwrap_or_default();
        match message {
            ScenarioMessage::Configure(change) => Self::Setup(configuration(change, base)),
            ScenarioMessage::Sample { setpoint_um, wd_um, wq_um, ahead, split_at } => {
                let [setpoint, wd, wq] = [setpoint_um, wd_um, wq_um].map(|number| number.value());
                match (split_at, ahead) {
                    (Some(at), _) => Self::InPieces(usize::from(*at), setpoint, wd, wq),
                    (None, 1) => Self::Sample(setpoint, wd, wq),
                    (None, ahead) => Self::Ahead(*ahead, setpoint, wd, wq),
                }
            }
            ScenarioMessage::Repeat {} => Self::Repeat,
            ScenarioMessage::Hello {} => Self::Ask(Message::Hello),
            ScenarioMessage::Safe {} => Self::Ask(Message::Safe),
            ScenarioMessage::Wait { ms } => Self::WaitUs((ms * 1e3).round() as u64),
            ScenarioMessage::Body { hex } => Self::Body(bytes(hex)),
            ScenarioMessage::Bytes { hex } => Self::Bytes(bytes(hex)),
            ScenarioMessage::Damaged { byte } => Self::Damaged(usize::from(*byte)),
            ScenarioMessage::Again { messages, times } => Self::Again { steps: *messages as usize, times: *times },
        }
    }
}

fn configuration(change: &ConfigurationChange, base: &Configure) -> Configure {
    let ConfigurationChange {
        law,
        watchdog_timeout_ms,
        period_us,
        start_frequency_mhz,
        gain_um_per_vpp,
        time_constant_s,
        response_time_s,
        drive_limit_vpp,
        frequency_range_hz,
        frequency_slew_hz,
        gains,
        loop_delay_us,
        own_plate,
    } = *change;
    let float = |number: Option<WireNumber>, base: f32| number.map_or(base, WireNumber::value);
    let law = law.and_then(|law| LawId::ALL.into_iter().find(|known| *known as u8 == law));
    let gains = gains.map(|gains| {
        let [amplitude_kp, amplitude_ki, frequency_kp, frequency_ki] = gains.map(WireNumber::value);
        Gains { amplitude_kp, amplitude_ki, frequency_kp, frequency_ki }
    });
    Configure {
        law: law.unwrap_or(base.law),
        paced_by_target: false,
        drives_own_plate: own_plate,
        watchdog_timeout_ms: watchdog_timeout_ms.unwrap_or(base.watchdog_timeout_ms),
        period_us: period_us.unwrap_or(base.period_us),
        loop_delay_us: loop_delay_us.unwrap_or(base.loop_delay_us),
        start_frequency_mhz: start_frequency_mhz.unwrap_or(base.start_frequency_mhz),
        gain_um_per_vpp: float(gain_um_per_vpp, base.gain_um_per_vpp),
        time_constant_s: float(time_constant_s, base.time_constant_s),
        response_time_s: float(response_time_s, base.response_time_s),
        drive_limit_vpp: float(drive_limit_vpp, base.drive_limit_vpp),
        frequency_range_hz: float(frequency_range_hz, base.frequency_range_hz),
        frequency_slew_hz: float(frequency_slew_hz, base.frequency_slew_hz),
        gains: gains.or(base.gains),
    }
}

/// Returns the response time for which a `dq-pi` law designs gains that are larger by `factor`, from
/// Kp ∝ 1 − e^(−3 Ts/tr), and from Kp ∝ 1/tr for `dq-pi-euler`.
pub(super) fn scaled_response_time(configure: &Configure, factor: f32) -> f32 {
    let Configure { law, period_us, response_time_s, .. } = *configure;
    if factor == 1.0 || !response_time_s.is_finite() || response_time_s < 0.0 || period_us == 0 {
        return response_time_s;
    }
    let usual = if response_time_s > 0.0 { response_time_s } else { default_response_time_s(law) as f32 };
    if law == LawId::DqPiEuler {
        return usual / factor;
    }
    let periods = 3.0 * period_us as f32 * 1e-6;
    let rest = 1.0 - factor * (1.0 - (-periods / usual).exp());
    // The shortest response time has the largest gains.
    -periods / rest.clamp(1e-6, 0.999_999).ln()
}

#[derive(Debug, Clone)]
pub(super) struct Script {
    pub(super) name: Cow<'static, str>,
    /// If an exchange is later than planned by more than this time, the watchdog may act.
    pub(super) stall: Duration,
    /// False if rounding and the design of the gains decide nothing, so that the variations are not
    /// played.
    pub(super) is_varied: bool,
    /// True if the message after a silence arrives before the controller has noticed the end of the
    /// silence.
    pub(super) ends_silences: bool,
    pub(super) steps: Vec<Step>,
}

#[derive(Debug, Clone)]
pub(super) struct Exchange {
    /// Silence before the exchange.
    pub(super) wait: Duration,
    pub(super) bytes: Vec<u8>,
    /// False if the controller may answer later, so that its answers belong to the next exchange.
    pub(super) is_complete: bool,
}

/// Change of the values in a script's messages. It does not change the number of exchanges.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Variation {
    /// Relative change of Wd and Wq, with signs that alternate over the samples.
    pub(super) components: f32,
    /// Factor on the plate gain K1 in configurations without controller gains.
    pub(super) gain: f32,
    /// Factor on all gains of the law's own design.
    pub(super) design: f32,
}

impl Variation {
    pub(super) const NONE: Self = Self { components: 0.0, gain: 1.0, design: 1.0 };
}

impl Script {
    pub(super) fn new(name: impl Into<Cow<'static, str>>, steps: impl IntoIterator<Item = Step>) -> Self {
        let steps = steps.into_iter().collect();
        Self { name: name.into(), stall: STALL, is_varied: true, ends_silences: false, steps }
    }

    /// Number of steps, repetitions included.
    pub(super) fn length(&self) -> u64 {
        let length = |step: &Step| match step {
            Step::Again { steps, times } => *steps as u64 * u64::from(*times),
            _ => 1,
        };
        self.steps.iter().map(length).sum()
    }

    /// Makes the exchanges one after the other, because a long script does not fit in memory.
    pub(super) fn exchanges(&self, variation: Variation) -> Encoder<'_> {
        Encoder {
            steps: &self.steps,
            position: 0,
            repetition: 0,
            ready: VecDeque::new(),
            variation,
            period_us: 0,
            // The sequence numbers start at 248, so that they wrap within the first messages.
            sequence: 248,
            time_us: 0,
            // Ends a frame that the previous script did not end.
            unanswered: vec![0],
            wait: Duration::ZERO,
            last_sample: Vec::new(),
        }
    }
}

#[derive(Debug)]
pub(super) struct Encoder<'a> {
    steps: &'a [Step],
    /// The next step.
    position: usize,
    /// Number of the repetition by the next [`Step::Again`].
    repetition: u32,
    ready: VecDeque<Exchange>,
    variation: Variation,
    period_us: u32,
    sequence: u8,
    time_us: u32,
    unanswered: Vec<u8>,
    wait: Duration,
    last_sample: Vec<u8>,
}

impl Iterator for Encoder<'_> {
    type Item = Exchange;

    fn next(&mut self) -> Option<Exchange> {
        while self.ready.is_empty() {
            let Some(step) = self.steps.get(self.position) else {
                if self.unanswered.is_empty() {
                    return None;
                }
                self.add(Step::Ask(Message::Hello));
                break;
            };
            self.position += 1;
            match step {
                Step::Again { steps, times } if self.repetition < *times => {
                    self.repetition += 1;
                    self.position = self.position.saturating_sub(steps + 1);
                }
                Step::Again { .. } => self.repetition = 0,
                step => self.add(step.clone()),
            }
        }
        self.ready.pop_front()
    }
}

impl Encoder<'_> {
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
                if let Some(whole) = self.ready.pop_back() {
                    let frame = whole.bytes.len().saturating_sub(self.last_sample.len());
                    let (first, second) = whole.bytes.split_at((frame + at).min(whole.bytes.len()));
                    self.ready.push_back(Exchange { bytes: first.to_vec(), is_complete: false, ..whole });
                    self.ready.push_back(Exchange { wait: PAUSE, bytes: second.to_vec(), is_complete: true });
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
                self.add(Step::Wait(ms));
                self.close(&[]);
            }
            Step::Wait(ms) => self.add(Step::WaitUs(ms * 1_000)),
            Step::WaitUs(us) => {
                if !self.unanswered.is_empty() {
                    // Its answer ends the exchange, and it changes nothing.
                    self.add(Step::Ask(Message::Hello));
                }
                self.wait += Duration::from_micros(us);
            }
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
            Step::Again { .. } => {}
        }
    }

    fn configure(&mut self, configure: Configure) {
        (self.period_us, self.time_us) = (configure.period_us, 0);
        let Variation { gain, design, .. } = self.variation;
        let varied = if configure.gains.is_none() {
            let gain_um_per_vpp = configure.gain_um_per_vpp * gain;
            Configure { gain_um_per_vpp, response_time_s: scaled_response_time(&configure, design), ..configure }
        } else {
            configure
        };
        self.add(Step::Ask(Message::Configure(varied)));
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
        let [setpoint_um, wd_um, wq_um] = DAMAGED_SAMPLE;
        let sample = Sample { time_us: self.time_us, setpoint_um, wd_um, wq_um };
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
        self.ready.push_back(Exchange { wait: std::mem::take(&mut self.wait), bytes, is_complete: true });
    }

    fn next_sequence(&mut self) -> u8 {
        self.sequence = self.sequence.wrapping_add(1);
        self.sequence
    }
}
