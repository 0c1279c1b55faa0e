//! Turns the messages of a script into exchanges. An exchange consists of frames that the controller
//! does not answer and one frame that it answers.

use platebench_controller::design::default_response_time_s;
use platebench_model::scenario::{ConfigurationChange, ScenarioMessage, WireNumber};
use platebench_wire::{Configure, EncodedFrame, Gains, LawId, Message, Packet, Sample};
use std::collections::VecDeque;
use std::time::Duration;

/// Silence between the two pieces of a sample that is split.
const PAUSE: Duration = Duration::from_millis(5);
const STALL: Duration = Duration::from_millis(80);
/// Setpoint, Wd and Wq of a damaged sample, µm. They differ from those of the other samples of a
/// script.
const DAMAGED_SAMPLE: [f32; 3] = [3.0, 0.7, -0.3];

/// Applies `change` to `base`.
pub(super) fn configuration(change: &ConfigurationChange, base: &Configure) -> Configure {
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
        paced_by_target,
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
        paced_by_target,
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
    pub(super) name: String,
    /// The configuration that a message changes.
    pub(super) base: Configure,
    /// If an exchange is later than planned by more than this time, the watchdog may act.
    pub(super) stall: Duration,
    /// False if rounding and the design of the gains decide nothing, so that the variations are not
    /// played.
    pub(super) is_varied: bool,
    /// True if the message after a silence arrives before the controller has noticed the end of the
    /// silence.
    pub(super) ends_silences: bool,
    pub(super) messages: Vec<ScenarioMessage>,
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
pub(super) struct ScriptVariation {
    /// Relative change of Wd and Wq, with signs that alternate over the samples.
    pub(super) components: f32,
    /// Factor on the plate gain K1 in configurations without controller gains.
    pub(super) gain: f32,
    /// Factor on all gains of the law's own design.
    pub(super) design: f32,
}

impl ScriptVariation {
    pub(super) const NONE: Self = Self { components: 0.0, gain: 1.0, design: 1.0 };
}

impl Script {
    pub(super) fn new(name: impl Into<String>, base: Configure, messages: Vec<ScenarioMessage>) -> Self {
        Self { name: name.into(), base, stall: STALL, is_varied: true, ends_silences: false, messages }
    }

    /// Makes the exchanges one after the other, because a long script does not fit in memory.
    pub(super) fn exchanges(&self, variation: ScriptVariation) -> Encoder<'_> {
        Encoder {
            script: self,
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
    script: &'a Script,
    /// The next message.
    position: usize,
    /// Number of the repetition by the next `again`.
    repetition: u32,
    ready: VecDeque<Exchange>,
    variation: ScriptVariation,
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
        let messages = &self.script.messages;
        while self.ready.is_empty() {
            let Some(message) = messages.get(self.position) else {
                if self.unanswered.is_empty() {
                    return None;
                }
                self.ask(Message::Hello);
                break;
            };
            self.position += 1;
            match message {
                ScenarioMessage::Again { messages, times } if self.repetition < *times => {
                    self.repetition += 1;
                    self.position = self.position.saturating_sub(*messages as usize + 1);
                }
                ScenarioMessage::Again { .. } => self.repetition = 0,
                message => self.add(message),
            }
        }
        self.ready.pop_front()
    }
}

impl Encoder<'_> {
    fn add(&mut self, message: &ScenarioMessage) {
        match message {
            ScenarioMessage::Configure(change) => self.configure(configuration(change, &self.script.base)),
            ScenarioMessage::Sample { setpoint_um, wd_um, wq_um, ahead, split_at } => {
                let values = [setpoint_um, wd_um, wq_um].map(|number| number.value());
                match (split_at, ahead) {
                    (Some(at), _) => self.sample_in_pieces(usize::from(*at), values),
                    (None, 1) => self.sample(1, values),
                    (None, &ahead) => {
                        self.time_us = self.time_us.wrapping_add(self.period_us.wrapping_mul(ahead.into()));
                        self.sample(ahead, values);
                    }
                }
            }
            ScenarioMessage::Repeat {} => self.close(&self.last_sample.clone()),
            ScenarioMessage::Hello {} => self.ask(Message::Hello),
            ScenarioMessage::Safe {} => self.ask(Message::Safe),
            ScenarioMessage::Compare {} => self.close(&[]),
            ScenarioMessage::Wait { ms } => {
                if !self.unanswered.is_empty() {
                    // Its answer ends the exchange, and it changes nothing.
                    self.ask(Message::Hello);
                }
                self.wait += Duration::from_micros((ms * 1e3).round() as u64);
            }
            ScenarioMessage::Body { hex } => {
                let number = ScenarioMessage::has_number(hex).then(|| self.next_sequence());
                let body = ScenarioMessage::bytes_of(hex, number).unwrap_or_default();
                if let Some(frame) = EncodedFrame::new(&body) {
                    self.unanswered.extend_from_slice(frame.as_bytes());
                }
            }
            ScenarioMessage::Bytes { hex } => {
                self.unanswered.extend(ScenarioMessage::bytes_of(hex, None).unwrap_or_default());
            }
            ScenarioMessage::Damaged { byte } => self.damaged(usize::from(*byte)),
            ScenarioMessage::Again { .. } => {}
        }
    }

    fn configure(&mut self, configure: Configure) {
        (self.period_us, self.time_us) = (configure.period_us, 0);
        let ScriptVariation { gain, design, .. } = self.variation;
        let varied = if configure.gains.is_none() {
            let gain_um_per_vpp = configure.gain_um_per_vpp * gain;
            Configure { gain_um_per_vpp, response_time_s: scaled_response_time(&configure, design), ..configure }
        } else {
            configure
        };
        self.ask(Message::Configure(varied));
    }

    /// `ahead` is the distance of the sequence number from that of the last message.
    fn sample(&mut self, ahead: u8, [setpoint_um, wd_um, wq_um]: [f32; 3]) {
        self.sequence = self.sequence.wrapping_add(ahead);
        let sequence = self.sequence;
        let components = self.variation.components;
        let change = |number: u8| if number.is_multiple_of(2) { components } else { -components };
        let (wd_um, wq_um) = (wd_um * (1.0 + change(sequence)), wq_um * (1.0 + change(sequence / 2)));
        let sample = Sample { time_us: self.time_us, setpoint_um, wd_um, wq_um };
        self.time_us = self.time_us.wrapping_add(self.period_us);
        self.last_sample = Packet { sequence, message: Message::Sample(sample) }.encode().as_bytes().to_vec();
        self.close(&self.last_sample.clone());
    }

    fn sample_in_pieces(&mut self, at: usize, values: [f32; 3]) {
        self.sample(1, values);
        if let Some(whole) = self.ready.pop_back() {
            let frame = whole.bytes.len().saturating_sub(self.last_sample.len());
            let (first, second) = whole.bytes.split_at((frame + at).min(whole.bytes.len()));
            self.ready.push_back(Exchange { bytes: first.to_vec(), is_complete: false, ..whole });
            self.ready.push_back(Exchange { wait: PAUSE, bytes: second.to_vec(), is_complete: true });
        }
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

    fn ask(&mut self, message: Message) {
        let frame = self.frame(message);
        self.close(&frame);
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
