//! Draws sequences of messages. Sequence i depends on the seed, i and the announced features only;
//! a derived one also on those that it is derived from.
//!
//! A sequence starts with a reference trial: a configuration and samples. Blocks of messages
//! follow, and the reference trial again after some of them. The answers are compared with those of
//! the hosted reference, and equal trials with each other.

use crate::explore::choices::{Choice, Choices, DrawLists, Drawn, Part};
use crate::explore::guidance::random_numbers;
use crate::explore::messages::{DAMAGED, GAINS, NONE, configure, number};
use platebench_model::scenario::{ConfigurationChange, ScenarioMessage};
use platebench_wire::{Identity, LawId, capabilities};
use std::ops::RangeInclusive;

/// Number of blocks of a sequence.
const BLOCKS: RangeInclusive<u32> = 5..=11;
const BLOCK_KINDS: u64 = 9;
const BLOCK_NUMBERS: RangeInclusive<i32> = 0..=8;
/// A sequence with more messages has no further block; a scenario has at most 1000.
const ENOUGH_MESSAGES: usize = 500;
/// Number of states that a message may meet, of kinds of messages, and of these pairs per sequence.
const STATES: u64 = 7;
const EVENTS: u64 = 9;
const RULES: u64 = 3;
/// Number of the state after a timeout of the watchdog.
const TIMED_OUT: u64 = 3;
/// Number of blocks with silences of a sequence in wall time.
const WATCHDOG_BLOCKS: u32 = 3;
/// A sequence of this many starts before the first configuration.
const FIRST_MESSAGES_EVERY: u64 = 11;
/// A sequence of this many has a long run.
const LONG_RUN_EVERY: u64 = 7;
const LONG_RUN_KINDS: u64 = 5;
/// Numbers of repetitions around which counters of a controller overflow.
const LONG_RUNS: [u32; 4] = [1 << 17, 40_000, 100_000, 1 << 16];
/// More configurations than 9 or 16 bits count.
const MANY_CONFIGURATIONS: [u32; 2] = [1_000, 66_000];
/// More rounds of four setpoints than 12 or 16 bits count.
const MANY_SETPOINTS: [u32; 2] = [1_100, 17_000];
/// More rejected frames than eight bits count.
const MANY_REJECTED: u32 = 300;
/// Short timeouts of the watchdog, ms, only in simulated time.
const SHORT_TIMEOUTS_MS: [u16; 6] = [50, 100, 254, 255, 256, 257];
/// Timeouts whose microseconds, or cycles of a clock of some 100 MHz, need 32 bits, ms.
const WATCHED_TIMEOUTS_MS: [u16; 6] = [40_000, 16_384, 25_570, 32_767, 32_768, 65_535];
/// Control periods, µs. Five of each need more than 32 bits. The last is the longest.
const LONG_PERIODS_US: [u32; 3] = [860_000_000, 1_000_000_000, u32::MAX];
/// Distances of the end of a silence from the timeout, ms; near ones only on a rig with exact time.
const NEAR_MS: [f64; 2] = [-6.0, 6.0];
const NEAREST_MS: [f64; 7] = [0.0, -6.0, -0.1, 0.0, 0.1, 1.0, 6.0];
/// Instants at which a clock in ms, in cycles of 168 MHz, or in µs wraps, ms.
const CLOCK_WRAPS_MS: [u32; 5] = [4_294_967, 65_536, 2_147_483, 134_217, 25_565];
/// The clock runs are this time before the wrap, ms.
const BEFORE_WRAP_MS: i32 = 20_000;
/// Longest wait of one message, ms.
const LONGEST_WAIT_MS: u32 = 65_000;
/// Step of a slow ramp of the setpoint, µm. The setpoint moves by less than the sensor resolves.
const RAMP_STEPS_UM: [f32; 4] = [9e-5, 3e-5, 5e-4, 5e-5];
/// Factors of two, which change no digit of a float, and the drive limit for the factor 1, Vpp.
const SCALES: [f32; 3] = [1.0, 2.0, 0.5];
const SCALED_LIMIT_VPP: f32 = 450.0;
/// A silence of this time, ms, costs as much as one message where time is simulated.
const SILENCE_PER_MESSAGE_MS: f64 = 100.0;
/// Timeouts of the watchdog's own blocks in wall time, ms. They are long, because a busy host is
/// late, and need more than eight bits in part.
const WALL_TIMEOUTS_MS: [u16; 5] = [180, 220, 260, 300, 700];

/// Features of the controller and the rig that decide which messages are sent.
#[derive(Debug, Clone)]
#[expect(clippy::struct_excessive_bools, reason = "each is a feature of its own")]
pub struct SequenceLimits {
    /// Largest number of messages of a sequence, from the speed of the rig.
    pub longest: u64,
    pub own_clock: bool,
    /// True if a message arrives exactly at its simulated time.
    pub exact_time: bool,
    pub has_loop_delay: bool,
    pub has_own_plate: bool,
    pub laws: Vec<LawId>,
    /// True if the rig can start a new controller.
    pub starts_controllers: bool,
    /// True for an own law, which may ignore configured gains.
    pub is_own_law: bool,
}

impl SequenceLimits {
    /// `exact_time` as in the field.
    pub fn new(identity: &Identity, own_clock: bool, exact_time: bool, longest: u64) -> Self {
        Self {
            longest,
            own_clock,
            exact_time,
            has_loop_delay: identity.has_capability(capabilities::LOOP_DELAY),
            has_own_plate: identity.has_capability(capabilities::OWN_PLATE),
            laws: LawId::ALL.into_iter().filter(|law| identity.has_law(*law)).collect(),
            starts_controllers: true,
            is_own_law: identity.laws == 0,
        }
    }

    /// Cost of a sequence in messages, repetitions and silences included.
    pub fn cost(messages: &[ScenarioMessage]) -> u64 {
        let single = |message: &ScenarioMessage| match message {
            ScenarioMessage::Wait { ms } => 1 + (ms / SILENCE_PER_MESSAGE_MS) as u64,
            ScenarioMessage::Again { .. } => 0,
            _ => 1,
        };
        let cost = |(at, message): (usize, &ScenarioMessage)| match message {
            ScenarioMessage::Again { messages: count, times } => {
                let repeated = messages.get(at.saturating_sub(*count as usize)..at).unwrap_or_default();
                repeated.iter().map(single).sum::<u64>() * u64::from(*times)
            }
            message => single(message),
        };
        messages.iter().enumerate().map(cost).sum()
    }

    /// Sequence `index` of an exploration with this seed.
    pub fn sequence(&self, seed: u64, index: u64) -> Drawn<Vec<ScenarioMessage>> {
        self.draw(Choices::new(random_numbers("messages", seed, index), index))
    }

    /// The sequence of recorded choices.
    pub fn replay(&self, choices: &[Choice]) -> Drawn<Vec<ScenarioMessage>> {
        self.draw(Choices::replay(choices))
    }

    fn draw(&self, mut choices: Choices) -> Drawn<Vec<ScenarioMessage>> {
        let mut draw = SequenceDraw { limits: self, choices: &mut choices, messages: Vec::new(), trial: Vec::new() };
        draw.play();
        let messages = draw.messages;
        choices.finish(messages)
    }

    /// True if others may be derived from the sequence. Long runs and messages before the first
    /// configuration are played in their turn, and silences cost wall time.
    pub fn may_be_parent(&self, messages: &[ScenarioMessage]) -> bool {
        let is_usable = |message: &ScenarioMessage| match message {
            ScenarioMessage::Again { .. } => false,
            ScenarioMessage::Wait { .. } => !self.own_clock,
            _ => true,
        };
        matches!(messages.first(), Some(ScenarioMessage::Configure(_))) && messages.iter().all(is_usable)
    }
}

/// Kinds of blocks. A sequence prefers one of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Block {
    Boundary,
    Unusable,
    Rejected,
    Ignored,
    Watchdog,
    NotFinite,
    Numbers,
    Scaled,
    Stop,
}

const ALL_BLOCKS: [Block; BLOCK_KINDS as usize] = [
    Block::Boundary,
    Block::Unusable,
    Block::Rejected,
    Block::Ignored,
    Block::Watchdog,
    Block::NotFinite,
    Block::Numbers,
    Block::Scaled,
    Block::Stop,
];

fn block(number: i32) -> Block {
    ALL_BLOCKS.get(number as usize).copied().unwrap_or(Block::Stop)
}

pub(crate) struct SequenceDraw<'a> {
    pub(crate) limits: &'a SequenceLimits,
    pub(crate) choices: &'a mut Choices,
    messages: Vec<ScenarioMessage>,
    /// The reference trial.
    trial: Vec<ScenarioMessage>,
}

impl DrawLists for SequenceDraw<'_> {
    fn choices(&mut self) -> &mut Choices {
        self.choices
    }
}

impl SequenceDraw<'_> {
    /// Draws messages and sends them.
    fn repeat(&mut self, counts: RangeInclusive<u32>, mut message: impl FnMut(&mut Self) -> ScenarioMessage) {
        self.list(Part::Message, counts, |draw, _| {
            let message = message(draw);
            draw.messages.push(message);
        });
    }

    /// Each message is in a list, so that shrinking can remove it.
    fn send(&mut self, message: impl FnMut(&mut Self) -> ScenarioMessage) {
        self.repeat(1..=1, message);
    }

    /// Sends a message in one of `count` cases.
    fn one_of(&mut self, count: u32, message: impl FnMut(&mut Self) -> ScenarioMessage) {
        if self.choices.one_in(count) {
            self.send(message);
        }
    }

    fn samples(&mut self, count: u32) {
        self.repeat(count..=count, Self::sample);
    }

    fn send_trial(&mut self) {
        for message in self.trial.clone() {
            self.send(|_| message.clone());
        }
    }

    fn play(&mut self) {
        let index = self.choices.index();
        let change = self.usable();
        self.trial = vec![configure(change)];
        self.list(Part::Message, 3..=6, |draw, _| {
            let sample = draw.sample();
            draw.trial.push(sample);
        });
        let is_first = self.limits.starts_controllers && index % FIRST_MESSAGES_EVERY == FIRST_MESSAGES_EVERY - 1;
        // 0: none; otherwise the order of the kinds.
        let order = if is_first { 1 + (index / FIRST_MESSAGES_EVERY % 6) as i32 } else { 0 };
        let order = self.choices.given(Some(order), 0..=6);
        if order > 0 {
            self.before_configuration((order - 1).unsigned_abs());
        }
        self.send_trial();
        let number = index / LONG_RUN_EVERY;
        let is_long = index % LONG_RUN_EVERY == LONG_RUN_EVERY - 1;
        // 0: none; otherwise the kind of the run.
        let kind = if is_long { 1 + (number % LONG_RUN_KINDS) as i32 } else { 0 };
        match self.choices.given(Some(kind), 0..=LONG_RUN_KINDS as i32) {
            0 => self.blocks(index),
            kind => self.long_run(kind, number / LONG_RUN_KINDS),
        }
        self.send_trial();
    }

    fn blocks(&mut self, index: u64) {
        let preferred = self.choices.given(Some((index % BLOCK_KINDS) as i32), BLOCK_NUMBERS);
        let is_slow = self.limits.own_clock && block(preferred) == Block::Watchdog;
        let count = if is_slow { WATCHDOG_BLOCKS..=WATCHDOG_BLOCKS } else { BLOCKS };
        self.list(Part::Block, count, |draw, _| {
            let others = u32::from(!is_slow);
            let kind = draw.choices.mostly(preferred, [1, others], BLOCK_NUMBERS);
            if draw.messages.len() > ENOUGH_MESSAGES {
                return;
            }
            // Silences cost wall time, so only the sequences that prefer them have them in wall time.
            match block(kind) {
                Block::Watchdog if draw.limits.own_clock && !is_slow => draw.add(Block::Rejected),
                block => draw.add(block),
            }
            if !is_slow && draw.choices.one_in(2) {
                draw.send_trial();
            }
        });
        let rules = if is_slow { 1 } else { RULES as u32 };
        self.list(Part::Rule, rules..=rules, |draw, number| {
            let number = index * RULES + number as u64;
            let (state, event) =
                if is_slow { (TIMED_OUT, index / BLOCK_KINDS) } else { (number % STATES, number / STATES) };
            let state = draw.choices.given(Some(state as i32), 0..=STATES as i32 - 1) as u64;
            let event = draw.choices.given(Some((event % EVENTS) as i32), 0..=EVENTS as i32 - 1);
            if state != TIMED_OUT || is_slow || !draw.limits.own_clock {
                draw.rule(state, event);
            }
        });
    }

    /// Messages to a controller that was never configured, in every order of the kinds.
    fn before_configuration(&mut self, order: u32) {
        let (first, turn) = (order % 3, 1 + order / 3);
        for kind in (0..6).map(|number| (first + turn * number) % 3) {
            self.send(|draw| match kind {
                0 => draw.sample(),
                1 => ScenarioMessage::Safe {},
                _ => ScenarioMessage::Hello {},
            });
        }
        match self.choices.below(4) {
            0 => self.send(|_| ScenarioMessage::Repeat {}),
            1 => self.send(Self::not_finite),
            2 => self.send(Self::unusable),
            _ => self.repeat(6..=6, |_| DAMAGED),
        }
        self.samples(2);
    }

    /// Sends one kind of message in one state, so that every rule of the protocol has its turn.
    fn rule(&mut self, state: u64, event: i32) {
        match state {
            0 => self.send(Self::unusable),
            1 => self.send(|_| configure(NONE)),
            _ => self.send_trial(),
        }
        match state {
            TIMED_OUT => {
                let timeout = if self.limits.own_clock { WALL_TIMEOUTS_MS[0] } else { SHORT_TIMEOUTS_MS[0] };
                self.send(|_| configure(ConfigurationChange { watchdog_timeout_ms: Some(timeout), ..NONE }));
                self.samples(1);
                self.send(|_| ScenarioMessage::Wait { ms: 1.7 * f64::from(timeout) });
            }
            4 => {
                self.repeat(5..=5, |_| DAMAGED);
                self.send(|_| ScenarioMessage::Hello {});
            }
            5 => self.send(Self::not_finite),
            6 => self.send(|_| ScenarioMessage::Safe {}),
            _ => {}
        }
        match event {
            0 => self.send(|_| ScenarioMessage::Hello {}),
            1 => self.send(|_| ScenarioMessage::Safe {}),
            2 => self.send(|draw| configure(draw.usable())),
            3 => self.send(Self::unusable),
            4 => self.samples(1),
            5 => {
                // A configuration forgets the number of the last sample, a stop does not.
                self.repeat(0..=1, Self::sample);
                self.send(|_| ScenarioMessage::Repeat {});
            }
            6 => self.send(Self::not_finite),
            7 => self.send(Self::rejected),
            _ => self.send(Self::ignored),
        }
        self.samples(1);
    }

    fn long_run(&mut self, kind: i32, round: u64) {
        let again = |draw: &mut Self, messages, times: &[u32]| {
            let times = draw.choices.given(Some(in_turn(times, round)), 1..=i32::MAX).unsigned_abs();
            draw.send(|_| ScenarioMessage::Again { messages, times });
        };
        match kind {
            1 => {
                self.send(Self::rejected);
                self.samples(2);
                again(self, 3, &[MANY_REJECTED]);
                self.repeat(5..=5, |_| DAMAGED);
                self.samples(2);
            }
            2 => {
                self.messages.truncate(3);
                again(self, 3, &MANY_CONFIGURATIONS);
                self.samples(2);
            }
            3 => {
                again(self, 1, &LONG_RUNS);
                self.samples(4);
            }
            4 if !self.limits.own_clock => self.clock_wrap(round),
            _ => {
                self.steady_gains(None);
                // The mean error is 0, so that the drive stays between its limits.
                for setpoint in [1.0, 1.5, 0.75, 1.75] {
                    self.send(|_| ScenarioMessage::sample(setpoint, 1.25, 0.0));
                }
                again(self, 4, &MANY_SETPOINTS);
                self.samples(2);
            }
        }
    }

    /// A configuration with gains, and a law that does not adapt them if there is one.
    fn steady_gains(&mut self, drive_limit_vpp: Option<f32>) {
        let is_fixed = self.limits.laws.contains(&LawId::DqPiFixed);
        let law = is_fixed.then_some(LawId::DqPiFixed as u8);
        let drive_limit_vpp = drive_limit_vpp.map(number);
        self.send(|_| configure(ConfigurationChange { law, gains: Some(GAINS.map(number)), drive_limit_vpp, ..NONE }));
    }

    /// Samples at several scales, with the drive limit in proportion: drawn ones, or a setpoint that
    /// moves by less than the sensor resolves. Its Wd stays, so that the drive follows the sum of the
    /// moves.
    fn scaled(&mut self) {
        let mut samples = Vec::new();
        if self.choices.one_in(3) {
            self.list(Part::Message, 4..=10, |draw, _| {
                let setpoint = draw.choices.pick(&[2.0, 0.5, 1.5, 0.75, 0.0], 1.5);
                let [wd, wq] = [0..=1_100, -400..=400].map(|range| draw.thousandths(range) * setpoint);
                samples.push([setpoint, wd, wq]);
            });
        } else {
            let (start, step) = (self.choices.pick(&[2.0, 0.5, 1.5], 2.0), self.choices.pick(&RAMP_STEPS_UM, 5e-5));
            self.list(Part::Message, 30..=40, |_, number| samples.push([start + step * number as f32, start, 0.0]));
        }
        for scale in SCALES {
            self.steady_gains(Some(SCALED_LIMIT_VPP * scale));
            for sample in &samples {
                let [setpoint, wd, wq] = sample.map(|value| value * scale);
                self.send(|_| ScenarioMessage::sample(setpoint, wd, wq));
            }
        }
    }

    /// Waits without a sample.
    fn wait(&mut self, ms: u32) {
        let whole = ms / LONGEST_WAIT_MS;
        if whole > 0 {
            self.send(|_| ScenarioMessage::Wait { ms: LONGEST_WAIT_MS.into() });
        }
        if whole > 1 {
            self.send(|_| ScenarioMessage::Again { messages: 1, times: whole - 1 });
        }
        self.send(|_| ScenarioMessage::Wait { ms: (ms % LONGEST_WAIT_MS).into() });
    }

    /// Samples before and after the instant at which a clock wraps, with silences shorter than the
    /// timeout.
    fn clock_wrap(&mut self, round: u64) {
        self.send(|_| configure(ConfigurationChange { watchdog_timeout_ms: Some(u16::MAX), ..NONE }));
        let before_ms = BEFORE_WRAP_MS..=i32::MAX;
        let at_ms = self.choices.given(Some(in_turn(&CLOCK_WRAPS_MS, round)), before_ms);
        self.wait((at_ms - BEFORE_WRAP_MS).unsigned_abs());
        self.samples(2);
        for ms in [5_000.0, 10_000.0, 10_000.0] {
            self.send(|_| ScenarioMessage::Wait { ms });
            self.samples(2);
        }
    }

    fn add(&mut self, block: Block) {
        match block {
            Block::Boundary => self.boundary(),
            Block::Unusable => {
                self.send(Self::unusable);
                self.samples(2);
                self.repeat(0..=1, |_| ScenarioMessage::Hello {});
            }
            Block::Rejected => self.list(Part::Message, 1..=4, |draw, _| {
                draw.repeat(1..=7, |draw| if draw.choices.one_in(4) { draw.uncounted() } else { draw.rejected() });
                draw.repeat(1..=6, Self::sample);
            }),
            Block::Ignored => {
                let body = self.ignored();
                self.repeat(1..=7, |_| body.clone());
                self.samples(1);
                self.repeat(0..=4, Self::rejected);
                self.samples(2);
            }
            Block::Watchdog => self.watchdog(),
            Block::NotFinite => {
                self.send(Self::not_finite);
                self.one_of(3, |_| ScenarioMessage::Repeat {});
                self.repeat(0..=6, Self::rejected);
                self.samples(2);
            }
            Block::Numbers => self.numbers(),
            Block::Scaled => self.scaled(),
            Block::Stop => self.stop(),
        }
    }

    fn numbers(&mut self) {
        self.list(Part::Message, 2..=6, |draw, _| {
            let kind = draw.choices.below(4);
            draw.send(|draw| {
                let mut sample = draw.sample();
                if let ScenarioMessage::Sample { ahead, split_at, .. } = &mut sample {
                    match kind {
                        1 | 2 => *ahead = draw.choices.pick(&[0, 2, 127, 128, 129, 255], 0),
                        3 => *split_at = Some(draw.choices.integer(1..=23) as u8),
                        _ => {}
                    }
                }
                sample
            });
            match draw.choices.below(5) {
                2 => draw.send(|_| ScenarioMessage::Repeat {}),
                3 => draw.send(|_| ScenarioMessage::Hello {}),
                4 => draw.send(Self::rejected),
                _ => {}
            }
        });
    }

    /// Ends the trial in one of the ways of the protocol.
    fn stop(&mut self) {
        match self.choices.below(5) {
            0 => self.send(|_| ScenarioMessage::Safe {}),
            1 => self.repeat(2..=2, |_| ScenarioMessage::Safe {}),
            2 => self.send(Self::not_finite),
            3 => self.send(Self::unusable),
            _ => {
                self.repeat(5..=6, |_| DAMAGED);
                self.send(|_| ScenarioMessage::Hello {});
            }
        }
        // The sample from before the stop.
        self.repeat(0..=1, |_| ScenarioMessage::Repeat {});
        self.list(Part::Message, 0..=2, |draw, _| {
            draw.samples(1);
            draw.repeat(0..=1, |_| ScenarioMessage::Repeat {});
        });
        self.one_of(3, |_| ScenarioMessage::Hello {});
    }

    /// Silences shorter and longer than the timeout, with messages that do not restart it.
    fn watchdog(&mut self) {
        let SequenceLimits { own_clock, exact_time, .. } = *self.limits;
        let timeouts = match own_clock {
            true => &WALL_TIMEOUTS_MS[..],
            false if self.choices.one_in(2) => &WATCHED_TIMEOUTS_MS,
            false => &SHORT_TIMEOUTS_MS,
        };
        let timeout = self.choices.pick(timeouts, 200);
        let is_default = self.choices.one_in(4);
        if is_default && !own_clock && self.choices.one_in(2) {
            self.long_period();
            return;
        }
        let (watchdog_timeout_ms, period_us) = if is_default {
            (0, u32::from(timeout) * 200)
        } else {
            (timeout, self.choices.pick(&[1_000, 500, 4_000], 1_000))
        };
        self.send(|_| {
            configure(ConfigurationChange {
                watchdog_timeout_ms: Some(watchdog_timeout_ms),
                period_us: Some(period_us),
                gains: Some(GAINS.map(number)),
                ..NONE
            })
        });
        if self.choices.one_in(3) {
            // The watchdog starts with the first sample.
            self.wait(u32::from(timeout) * 3 / 2);
        }
        self.repeat(1..=3, Self::sample);
        let timeout = f64::from(timeout);
        let shares: &[f64] = match self.choices.below(6) {
            0 | 1 => &[0.4],
            2 | 3 => &[0.55, 0.6],
            // A host may be 80 ms late.
            4 if timeout > 600.0 || !own_clock => &[0.85],
            4 => &[0.4, 1.7],
            _ => &[1.7],
        };
        let between = self.choices.below(5);
        for (number, share) in shares.iter().enumerate() {
            // In simulated time a silence may end next to the timeout.
            let is_near = !own_clock && shares.len() == 1 && self.choices.one_in(2);
            let ms = if is_near {
                timeout + self.choices.pick(if exact_time { &NEAREST_MS[..] } else { &NEAR_MS }, 6.0)
            } else {
                share * timeout
            };
            let whole = (ms - ms.rem_euclid(1e3)) as u32;
            if whole > 0 {
                self.wait(whole);
            }
            self.send(|_| ScenarioMessage::Wait { ms: ((ms - f64::from(whole)) * 10.0).round() / 10.0 });
            if number + 1 < shares.len() {
                match between {
                    0 => self.send(|_| DAMAGED),
                    1 => self.send(|_| ScenarioMessage::Hello {}),
                    2 => self.send(|_| ScenarioMessage::Repeat {}),
                    3 => self.send(Self::ignored),
                    _ => self.samples(1),
                }
            }
        }
        // The timeout decides the cause, not the values.
        self.repeat(0..=1, Self::not_finite);
        self.samples(2);
    }

    /// Silences much shorter than the default timeout of a period of many minutes.
    fn long_period(&mut self) {
        let period_us = self.choices.pick(&LONG_PERIODS_US, u32::MAX);
        let change = ConfigurationChange { watchdog_timeout_ms: Some(0), period_us: Some(period_us), ..NONE };
        self.send(|_| configure(ConfigurationChange { gains: Some(GAINS.map(number)), ..change }));
        self.samples(2);
        let ms = self.choices.pick(&[1_000, 100_000, 600_000], 1_000);
        self.wait(ms);
        self.samples(2);
    }

    /// An accepted configuration at a boundary of one field.
    fn boundary(&mut self) {
        let kind = self.choices.below(9);
        let change = self.at_boundary(kind);
        self.send(|_| configure(change));
        if kind == 2 && change.frequency_range_hz.is_none() {
            // The answer contains the start frequency.
            self.send(|_| ScenarioMessage::Hello {});
            self.send(|_| ScenarioMessage::Safe {});
        } else {
            self.repeat(2..=8, Self::sample);
        }
    }
}

fn in_turn(all: &[u32], number: u64) -> i32 {
    all.get((number % all.len().max(1) as u64) as usize).map_or(1, |value| value.cast_signed())
}
