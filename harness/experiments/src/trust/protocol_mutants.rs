//! Implements faults of counters, kept state, frames and values of the protocol.

use crate::trust::mutant_controller::{Inner, Mutant};
use crate::trust::mutants::NoChecksumCheck;
use platebench_controller::{Law, Measurement};
use platebench_rig::LinkError;
use platebench_wire::{
    Command, Configure, Configured, ControllerState, EncodedFrame, FrameReader, Gains, Message, Packet, Rejection,
    Sample, StateCause, VERSION, flags,
};
use std::time::Duration;

pub(super) type Answers = Result<Option<Vec<Packet>>, LinkError>;

/// No valid COBS code, so every receiver rejects it.
const REJECTED_FRAME: &[u8] = &[5, 0];
/// Rejected frames after which a controller stops in any case.
const STOPPING_FRAMES: usize = 5;
const CONFIGURE_HEADER: u8 = VERSION << 4 | 3;
/// Positions in the body of a configuration.
const LAW: usize = 2;
const BITS: usize = 3;
const PERIOD: std::ops::Range<usize> = 6..10;
const GAINS: std::ops::Range<usize> = 38..54;
const HAS_GAINS: u8 = 1;
const HAS_LOOP_DELAY: u8 = 4;

/// Changes the configuration into one that every controller answers with 1.
pub(crate) fn refuse(configure: &mut Configure) {
    configure.period_us = 0;
}

/// Returns the body of a frame with a valid CRC.
fn body_of(frame: &[u8]) -> Option<Vec<u8>> {
    FrameReader::new().read(&mut &*frame)?.ok().map(<[u8]>::to_vec)
}

pub(super) fn packet_of(frame: &[u8]) -> Option<Packet> {
    Packet::decode(&body_of(frame)?).ok()
}

fn is_rejected(frame: &[u8]) -> bool {
    frame.len() > 1 && packet_of(frame).is_none()
}

const fn is_stopped(packet: &Packet) -> bool {
    matches!(packet.message, Message::Command(Command { state: ControllerState::Fault, .. }))
}

// Counters

/// Answers samples with *idle* if the number of the configuration, modulo `marks`, is 0.
pub(crate) struct ConfigurationMark {
    pub(crate) marks: u32,
    pub(crate) accepted: u32,
}

impl Mutant for ConfigurationMark {
    fn handle(&mut self, frame: &[u8], inner: &mut Inner<'_>) -> Answers {
        let Some(Packet { sequence, message: Message::Configure(mut configure) }) = packet_of(frame) else {
            return Ok(None);
        };
        let answers = inner.send(frame)?;
        if answers.iter().any(|packet| matches!(packet.message, Message::Configured(Configured { outcome: Ok(_) }))) {
            self.accepted += 1;
            if self.accepted.is_multiple_of(self.marks) {
                refuse(&mut configure);
                inner.send(Packet { sequence, message: Message::Configure(configure) }.encode().as_bytes())?;
            }
        }
        Ok(Some(answers))
    }
}

/// Runs the configured law beside the controller and sends its drive and frequency.
#[derive(Default)]
pub(crate) struct OwnLaw {
    /// Starts the law anew after this number of steps.
    restart_after: Option<u32>,
    /// Keeps the state of the law if a configuration equals the one before.
    keeps_state: bool,
    configure: Option<Configure>,
    law: Option<Law>,
    steps: u32,
    sample: Option<Sample>,
    /// The last command with its number, which answers a repeated sample.
    last: Option<(u8, Command)>,
}

impl OwnLaw {
    pub(crate) fn restarted_after(steps: u32) -> Box<dyn Mutant> {
        Box::new(Self { restart_after: Some(steps), ..Self::default() })
    }

    pub(crate) fn kept() -> Box<dyn Mutant> {
        Box::new(Self { keeps_state: true, ..Self::default() })
    }

    fn design(&mut self) {
        self.law = self.configure.as_ref().and_then(|configure| Law::design(configure).ok()).map(|(law, _)| law);
        self.steps = 0;
    }

    fn step(&mut self, command: &mut Command) {
        if self.restart_after.is_some_and(|steps| self.steps == steps) {
            self.design();
        }
        let (Some(configure), Some(law), Some(sample)) = (&self.configure, &mut self.law, &self.sample) else { return };
        let actuation =
            law.step(&Measurement { setpoint_um: sample.setpoint_um, wd_um: sample.wd_um, wq_um: sample.wq_um });
        self.steps += 1;
        if actuation.is_finite() {
            let offset_mhz = (actuation.frequency_offset_hz * 1000.0).round() as i32;
            command.drive_vpp = actuation.drive_vpp;
            command.frequency_mhz = configure.start_frequency_mhz.saturating_add_signed(offset_mhz);
            command.flags = actuation.flags;
        }
    }
}

impl Mutant for OwnLaw {
    fn on_message(&mut self, message: &mut Message) {
        match message {
            Message::Configure(configure) => {
                self.last = None;
                if !self.keeps_state || self.configure != Some(*configure) {
                    self.configure = Some(*configure);
                    self.design();
                }
            }
            Message::Sample(sample) => self.sample = Some(*sample),
            _ => {}
        }
    }

    fn on_send(&mut self, packet: &mut Packet) {
        let Message::Command(command) = &mut packet.message else { return };
        if command.state != ControllerState::Running {
            self.last = None;
            return;
        }
        match self.last {
            Some((sequence, last)) if sequence == packet.sequence => *command = last,
            _ => self.step(command),
        }
        self.last = Some((packet.sequence, *command));
    }
}

// State that outlives a stop or a configuration

/// Keeps the counter of rejected frames across a configuration.
#[derive(Default)]
pub(crate) struct RejectedCountKept {
    score: u8,
    is_running: bool,
    last_sample: Option<u8>,
}

impl Mutant for RejectedCountKept {
    fn handle(&mut self, frame: &[u8], inner: &mut Inner<'_>) -> Answers {
        if !is_rejected(frame) || !self.is_running {
            return Ok(None);
        }
        self.score = self.score.saturating_add(2);
        if self.score < 10 {
            return Ok(None);
        }
        inner.send(&REJECTED_FRAME.repeat(STOPPING_FRAMES)).map(Some)
    }

    fn on_receive(&mut self, packet: &mut Packet) {
        if let Message::Configure(_) = packet.message {
            (self.is_running, self.last_sample) = (false, None);
        }
    }

    fn on_send(&mut self, packet: &mut Packet) {
        if let Message::Command(command) = packet.message {
            self.is_running = command.state == ControllerState::Running;
            if self.is_running && self.last_sample.replace(packet.sequence) != Some(packet.sequence) {
                self.score = self.score.saturating_sub(1);
            }
        }
    }
}

/// What leaves number and answer of the last sample in force.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum KeptAnswer {
    AfterSafe,
    AfterRefusal,
}

/// Answers a sample that repeats the number from before a stop with the command from before it.
pub(crate) struct AnswerKept {
    rule: KeptAnswer,
    last: Option<Packet>,
    is_stopped: bool,
}

impl AnswerKept {
    pub(crate) fn of(rule: KeptAnswer) -> Box<dyn Mutant> {
        Box::new(Self { rule, last: None, is_stopped: false })
    }
}

impl Mutant for AnswerKept {
    fn handle(&mut self, frame: &[u8], _inner: &mut Inner<'_>) -> Answers {
        let Some(Packet { sequence, message: Message::Sample(_) }) = packet_of(frame) else { return Ok(None) };
        let kept = self.last.filter(|last| self.is_stopped && last.sequence == sequence);
        if kept.is_none() {
            self.last = None;
        }
        Ok(kept.map(|packet| vec![packet]))
    }

    fn on_send(&mut self, packet: &mut Packet) {
        match packet.message {
            Message::Command(Command { state: ControllerState::Running, .. }) => {
                self.last = if self.is_stopped { self.last } else { Some(*packet) };
            }
            Message::Command(Command { state: ControllerState::Safe, .. }) if self.rule == KeptAnswer::AfterSafe => {
                self.is_stopped = true;
            }
            Message::Configured(Configured { outcome: Err(_) }) if self.rule == KeptAnswer::AfterRefusal => {
                self.is_stopped = true;
            }
            Message::Command(_) | Message::Configured(_) => (self.last, self.is_stopped) = (None, false),
            _ => {}
        }
    }
}

/// Sends the last frequency instead of the start frequency between a configuration and its first
/// sample.
#[derive(Default)]
pub(crate) struct FrequencyKept {
    last_mhz: Option<u32>,
    waits: bool,
}

impl Mutant for FrequencyKept {
    fn on_send(&mut self, packet: &mut Packet) {
        match &mut packet.message {
            Message::Configured(Configured { outcome: Ok(_) }) => self.waits = true,
            Message::Command(Command { state: ControllerState::Running, frequency_mhz, .. }) => {
                (self.last_mhz, self.waits) = (Some(*frequency_mhz), false);
            }
            Message::Command(command) if self.waits => {
                command.frequency_mhz = self.last_mhz.unwrap_or(command.frequency_mhz);
            }
            _ => {}
        }
    }
}

/// Reports only the first stop without a request.
#[derive(Default)]
pub(crate) struct SecondStopNotReported {
    reported: bool,
}

impl SecondStopNotReported {
    fn first_stop(&mut self, mut packets: Vec<Packet>) -> Vec<Packet> {
        packets.retain(|packet| !is_stopped(packet) || !std::mem::replace(&mut self.reported, true));
        packets
    }
}

impl Mutant for SecondStopNotReported {
    fn handle(&mut self, frame: &[u8], inner: &mut Inner<'_>) -> Answers {
        if !is_rejected(frame) {
            return Ok(None);
        }
        let answers = inner.send(frame)?;
        Ok(Some(self.first_stop(answers)))
    }

    fn wait(&mut self, inner: &mut Inner<'_>) -> Result<Vec<Packet>, LinkError> {
        let packets = inner.wait(Duration::ZERO)?;
        Ok(self.first_stop(packets))
    }
}

// Diagnosis

/// Repeats the flags of the last step in the command of a stop.
pub(crate) fn flags_kept_in_stop() -> impl FnMut(&mut Command) + Send + 'static {
    let mut last = 0;
    move |command| match command.state {
        ControllerState::Running => last = command.flags,
        ControllerState::Fault => command.flags = last,
        ControllerState::Idle | ControllerState::Safe => {}
    }
}

pub(crate) fn send_one_flag(command: &mut Command) {
    if command.flags & flags::FREQUENCY_LIMITED != 0 {
        command.flags &= !flags::SATURATED;
    }
}

// Setpoint

/// Takes a setpoint as unchanged if it differs by at most `step_um` from the sample before.
pub(crate) fn slow_ramp_lost(step_um: f32) -> impl FnMut(&mut Message) + Send + 'static {
    let mut last: Option<[f32; 2]> = None;
    move |message| match message {
        Message::Configure(_) => last = None,
        Message::Sample(sample) => {
            let now = sample.setpoint_um;
            if let Some([before, used]) = last
                && (now - before).abs() <= step_um
            {
                sample.setpoint_um = used;
            }
            last = Some([now, sample.setpoint_um]);
        }
        _ => {}
    }
}

/// Ignores changes of the setpoint after `places` of them.
pub(crate) fn setpoint_list_full(places: u32) -> impl FnMut(&mut Message) + Send + 'static {
    let (mut changes, mut used) = (0, f32::NAN);
    move |message| match message {
        Message::Configure(_) => (changes, used) = (0, f32::NAN),
        Message::Sample(sample) if sample.setpoint_um.is_finite() && sample.setpoint_um != used => {
            if changes < places {
                (changes, used) = (changes + 1, sample.setpoint_um);
            }
            sample.setpoint_um = used;
        }
        _ => {}
    }
}

// Frames and bodies

/// Does not check the CRC of a frame after a rejected one.
#[derive(Default)]
pub(crate) struct NoChecksumAfterRejected {
    after_rejected: bool,
}

impl Mutant for NoChecksumAfterRejected {
    fn on_receive(&mut self, _packet: &mut Packet) {
        self.after_rejected = false;
    }

    fn on_unreadable_frame(&mut self, frame: &[u8]) -> Option<Vec<u8>> {
        let unchecked = self.after_rejected.then(|| NoChecksumCheck.on_unreadable_frame(frame)).flatten();
        let used = unchecked.unwrap_or_else(|| frame.to_vec());
        self.after_rejected = packet_of(&used).is_none();
        Some(used)
    }
}

/// Counts messages that only a controller sends as rejected frames.
pub(crate) struct EchoCounted;

impl Mutant for EchoCounted {
    fn handle(&mut self, frame: &[u8], inner: &mut Inner<'_>) -> Answers {
        match packet_of(frame).map(|packet| packet.message) {
            None
            | Some(
                Message::Hello | Message::Configure(_) | Message::Sample(_) | Message::Safe | Message::Setpoint(_),
            ) => Ok(None),
            Some(_) => inner.send(REJECTED_FRAME).map(Some),
        }
    }
}

/// Does not count a frame with a valid CRC and an invalid body.
pub(crate) struct InvalidBodyNotCounted;

impl Mutant for InvalidBodyNotCounted {
    fn on_unreadable_frame(&mut self, frame: &[u8]) -> Option<Vec<u8>> {
        body_of(frame).is_none().then(|| frame.to_vec())
    }
}

/// Takes a first sample with number 0 as a repeated one.
pub(crate) struct Number0AsForgotten {
    is_forgotten: bool,
    start_frequency_mhz: u32,
    last: Command,
}

impl Number0AsForgotten {
    pub(crate) fn at_power_on() -> Box<dyn Mutant> {
        Box::new(Self { is_forgotten: true, start_frequency_mhz: 0, last: Self::idle(0) })
    }

    const fn idle(frequency_mhz: u32) -> Command {
        let (state, cause) = (ControllerState::Idle, StateCause::None);
        Command { target_time_us: 0, drive_vpp: 0.0, frequency_mhz, state, cause, flags: 0, compute_us: 0 }
    }
}

impl Mutant for Number0AsForgotten {
    fn handle(&mut self, frame: &[u8], _inner: &mut Inner<'_>) -> Answers {
        match packet_of(frame) {
            Some(Packet { sequence: 0, message: Message::Sample(_) }) if self.is_forgotten => {
                Ok(Some(vec![Packet { sequence: 0, message: Message::Command(self.last) }]))
            }
            Some(Packet { message: Message::Sample(_), .. }) => {
                self.is_forgotten = false;
                Ok(None)
            }
            Some(Packet { message: Message::Configure(configure), .. }) => {
                (self.is_forgotten, self.start_frequency_mhz) = (true, configure.start_frequency_mhz);
                Ok(None)
            }
            _ => Ok(None),
        }
    }

    fn on_send(&mut self, packet: &mut Packet) {
        self.last = match packet.message {
            Message::Command(command) => command,
            Message::Configured(Configured { outcome: Ok(_) }) => Self::idle(self.start_frequency_mhz),
            Message::Configured(_) => Self::idle(self.last.frequency_mhz),
            _ => return,
        };
    }
}

/// Accepts a loop delay of 0 with bit 2, as no delay.
pub(crate) struct ZeroDelayAccepted;

impl Mutant for ZeroDelayAccepted {
    fn on_unreadable_frame(&mut self, frame: &[u8]) -> Option<Vec<u8>> {
        let accepted = body_of(frame).and_then(|mut body| {
            let has_zero_delay = body.first() == Some(&CONFIGURE_HEADER) && body.get(GAINS.end..) == Some(&[0; 4]);
            *body.get_mut(BITS)? &= !HAS_LOOP_DELAY;
            body.truncate(GAINS.end);
            EncodedFrame::new(&body).filter(|_| has_zero_delay)
        });
        Some(accepted.map_or_else(|| frame.to_vec(), |frame| frame.as_bytes().to_vec()))
    }
}

/// Answers a configuration with a law number that the protocol does not list.
#[derive(Default)]
pub(crate) struct UnknownLawAnswered {
    is_unknown: bool,
}

impl Mutant for UnknownLawAnswered {
    fn on_receive(&mut self, _packet: &mut Packet) {
        self.is_unknown = false;
    }

    fn on_send(&mut self, packet: &mut Packet) {
        if let Message::Configured(Configured { outcome: Err(rejection) }) = &mut packet.message
            && self.is_unknown
        {
            *rejection = Rejection::Law;
        }
    }

    fn on_unreadable_frame(&mut self, frame: &[u8]) -> Option<Vec<u8>> {
        let refused = body_of(frame).and_then(|mut body| {
            let is_configure = body.first() == Some(&CONFIGURE_HEADER);
            // Law 0 exists, and a period of 0 is unusable. If another field is invalid too, the
            // frame stays rejected.
            *body.get_mut(LAW)? = 0;
            body.get_mut(PERIOD)?.fill(0);
            EncodedFrame::new(&body).filter(|frame| is_configure && packet_of(frame.as_bytes()).is_some())
        });
        self.is_unknown = refused.is_some();
        Some(refused.map_or_else(|| frame.to_vec(), |frame| frame.as_bytes().to_vec()))
    }
}

/// Refuses gains that are not finite although the configuration does not use them.
pub(crate) struct UnusedGainsChecked;

impl Mutant for UnusedGainsChecked {
    fn handle(&mut self, frame: &[u8], inner: &mut Inner<'_>) -> Answers {
        let Some(Packet { sequence, message: Message::Configure(mut configure) }) = packet_of(frame) else {
            return Ok(None);
        };
        let body = body_of(frame).unwrap_or_default();
        let gains = body.get(GAINS).unwrap_or_default().as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes));
        let uses_gains = body.get(BITS).is_some_and(|bits| bits & HAS_GAINS != 0);
        if uses_gains || gains.into_iter().all(f32::is_finite) {
            return Ok(None);
        }
        refuse(&mut configure);
        inner.send(Packet { sequence, message: Message::Configure(configure) }.encode().as_bytes()).map(Some)
    }
}

pub(crate) fn has_negative_gain(gains: &Gains) -> bool {
    [gains.amplitude_kp, gains.amplitude_ki, gains.frequency_kp, gains.frequency_ki].iter().any(|gain| *gain < 0.0)
}
