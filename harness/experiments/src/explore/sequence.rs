//! Draws sequences of messages and builds their scenarios. Sequence i depends on the seed, i and
//! the announced features only.
//!
//! A sequence starts with a reference trial: a configuration and samples. Blocks of messages
//! follow, and the reference trial again after some of them. The answers are compared with those of
//! the hosted reference, and equal trials with each other.

use crate::explore::envelope::Envelope;
use crate::explore::guidance::{below, random_numbers};
use crate::explore::limits::ExploredLaw;
use crate::explore::properties::{Property, REFERENCE_DIFFERENCE_PERCENT};
use crate::explore::scenario_file::{SceneScenario, raw_plate};
use platebench_model::scenario::raw::{RawController, RawExpectation, RawProfiles, RawScenario, RawTrials};
use platebench_model::scenario::{ConfigurationChange, Metric, NonFinite, ScenarioMessage, WireNumber};
use platebench_plate::RawProfile;
use platebench_wire::{Identity, LawId, capabilities};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Number of blocks of a sequence.
const BLOCKS: std::ops::RangeInclusive<u32> = 5..=11;
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
/// Watchdog timeout of trials that do not test it, ms; shorter ones only in simulated time.
const LONG_TIMEOUTS_MS: [u16; 7] = [1_000, 1_023, 1_024, 32_767, 32_768, 40_000, 65_535];
const SHORT_TIMEOUTS_MS: [u16; 6] = [50, 100, 254, 255, 256, 257];
/// Timeouts whose microseconds, or cycles of a clock of some 100 MHz, need 32 bits, ms.
const WATCHED_TIMEOUTS_MS: [u16; 6] = [1_000, 16_384, 25_570, 32_767, 32_768, 65_535];
/// Control periods, µs. Five of each need more than 32 bits. The last is the longest.
const LONG_PERIODS_US: [u32; 3] = [860_000_000, 1_000_000_000, u32::MAX];
/// Distances of the end of a silence from the timeout, ms; near ones only on a rig with exact time.
const NEAR_MS: [f64; 2] = [-6.0, 6.0];
const NEAREST_MS: [f64; 7] = [0.0, -6.0, -0.1, 0.0, 0.1, 1.0, 6.0];
/// Instants at which a clock in ms, in cycles of 168 MHz, or in µs wraps, ms.
const CLOCK_WRAPS_MS: [u32; 5] = [4_294_967, 65_536, 2_147_483, 134_217, 25_565];
/// The clock runs are this time before the wrap, ms.
const BEFORE_WRAP_MS: u32 = 20_000;
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
/// Ends of the range, and numbers that `f32` cannot hold.
const START_FREQUENCIES_MHZ: [u32; 6] = [1, u32::MAX, 1 << 24, (1 << 25) + 2, (1 << 26) + 4, 0xaaaa_aaab];
/// A usable configuration except for a loop delay of 0 with bit 2.
const ZERO_DELAY: &str = "135a0104 0000e803 000090f9 ec017cb8 e43b556a f63a0000 00000000 61440000 7a430000 \
                          c8420000 00000000 00000000 00000000 00000000 0000";
/// Lengths of garbage, around the longest frame of 70 bytes.
const GARBAGE_BYTES: [usize; 6] = [1, 24, 69, 70, 71, 200];

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

    /// Parts of `parent` and of the drawn sequence `drawn` in another order, between two reference
    /// trials of `parent`. A part begins with a configuration, which makes it independent of the
    /// parts before it.
    pub fn derive<'a>(
        &self,
        seed: u64,
        index: u64,
        parent: &'a [ScenarioMessage],
        drawn: &'a [ScenarioMessage],
    ) -> Vec<ScenarioMessage> {
        let mut random = random_numbers("derived messages", seed, index);
        // Messages before the first configuration are played in their turn.
        let is_configuration = |message: &ScenarioMessage| matches!(message, ScenarioMessage::Configure(_));
        let from_first = |all: &'a [ScenarioMessage]| all.get(all.iter().position(is_configuration)?..);
        let (parent, drawn) = (from_first(parent).unwrap_or_default(), from_first(drawn).unwrap_or_default());
        let is_usable = |part: &&[ScenarioMessage]| {
            part.iter().all(|message| match message {
                // Long runs are played in their turn, and silences cost wall time.
                ScenarioMessage::Again { .. } => false,
                ScenarioMessage::Wait { .. } => !self.own_clock,
                _ => true,
            })
        };
        let parts: Vec<_> = parts_of(parent).chain(parts_of(drawn)).filter(is_usable).collect();
        let is_trial =
            |(at, message): &(usize, &ScenarioMessage)| *at == 0 || matches!(message, ScenarioMessage::Sample { .. });
        let trial: Vec<_> =
            parent.iter().enumerate().take_while(is_trial).map(|(_, message)| message.clone()).collect();
        let mut messages = trial.clone();
        for _ in 0..DERIVED_PARTS {
            let part = parts.get(below(&mut random, parts.len())).copied().unwrap_or_default();
            if messages.len() + part.len() > ENOUGH_MESSAGES {
                break;
            }
            messages.extend_from_slice(part);
        }
        messages.extend(trial);
        messages
    }

    /// Sequence `index` of an exploration with this seed.
    pub fn sequence(&self, seed: u64, index: u64) -> Vec<ScenarioMessage> {
        let random = random_numbers("messages", seed, index);
        let mut draw = Draw { limits: self, random, messages: Vec::new(), trial: Vec::new() };
        draw.play(index);
        draw.messages
    }
}

/// Number of parts of a derived sequence.
const DERIVED_PARTS: u32 = 12;

/// Splits before each configuration.
fn parts_of(messages: &[ScenarioMessage]) -> impl Iterator<Item = &[ScenarioMessage]> {
    let is_configuration = |message: &ScenarioMessage| matches!(message, ScenarioMessage::Configure(_));
    messages.chunk_by(move |_, next| !is_configuration(next))
}

/// Kinds of blocks. A sequence prefers one of them.
#[derive(Debug, Clone, Copy)]
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

const ALL_BLOCKS: [Block; 9] = [
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

struct Draw<'a> {
    limits: &'a SequenceLimits,
    random: ChaCha8Rng,
    messages: Vec<ScenarioMessage>,
    /// The reference trial.
    trial: Vec<ScenarioMessage>,
}

impl Draw<'_> {
    fn below(&mut self, count: usize) -> usize {
        ((u64::from(self.random.next_u32()) * count as u64) >> 32) as usize
    }

    fn one_in(&mut self, count: usize) -> bool {
        self.below(count) == 0
    }

    fn range(&mut self, range: std::ops::RangeInclusive<u32>) -> u32 {
        range.start() + self.below((range.end() - range.start() + 1) as usize) as u32
    }

    /// A value with three decimals.
    fn uniform(&mut self, low: f32, high: f32) -> f32 {
        let share = self.below(1_000) as f32 / 1e3;
        ((low + (high - low) * share) * 1e3).round() / 1e3
    }

    fn pick<T: Copy>(&mut self, all: &[T], default: T) -> T {
        let index = self.below(all.len().max(1));
        all.get(index).copied().unwrap_or(default)
    }

    fn play(&mut self, index: u64) {
        let change = self.usable();
        self.trial = vec![configure(change)];
        for _ in 0..self.range(3..=6) {
            let sample = self.sample();
            self.trial.push(sample);
        }
        if self.limits.starts_controllers && index % FIRST_MESSAGES_EVERY == FIRST_MESSAGES_EVERY - 1 {
            self.before_configuration(index / FIRST_MESSAGES_EVERY);
        }
        self.messages.extend(self.trial.iter().cloned());
        if index % LONG_RUN_EVERY == LONG_RUN_EVERY - 1 {
            self.long_run(index / LONG_RUN_EVERY);
            return;
        }
        let preferred = ALL_BLOCKS.get(index as usize % ALL_BLOCKS.len()).copied().unwrap_or(Block::Stop);
        if self.limits.own_clock && matches!(preferred, Block::Watchdog) {
            (0..WATCHDOG_BLOCKS).for_each(|_| self.add(preferred));
            self.rule(TIMED_OUT, index / ALL_BLOCKS.len() as u64);
            self.messages.extend(self.trial.iter().cloned());
            return;
        }
        for _ in 0..self.range(BLOCKS) {
            if self.messages.len() > ENOUGH_MESSAGES {
                break;
            }
            let any = self.below(ALL_BLOCKS.len());
            let block = if self.one_in(2) { preferred } else { self.pick_block(any) };
            self.add(block);
            if self.one_in(2) {
                self.messages.extend(self.trial.iter().cloned());
            }
        }
        for number in (index * RULES..).take(RULES as usize) {
            let state = number % STATES;
            if state != TIMED_OUT || !self.limits.own_clock {
                self.rule(state, number / STATES);
            }
        }
        self.messages.extend(self.trial.iter().cloned());
    }

    /// Messages to a controller that was never configured, in every order of the kinds.
    fn before_configuration(&mut self, number: u64) {
        let [first, second] = [number % 3, number / 3 % 2];
        let order = if second == 0 {
            [first, (first + 1) % 3, (first + 2) % 3]
        } else {
            [first, (first + 2) % 3, (first + 1) % 3]
        };
        for kind in order.into_iter().chain(order) {
            let message = match kind {
                0 => self.sample(),
                1 => ScenarioMessage::Safe {},
                _ => ScenarioMessage::Hello {},
            };
            self.messages.push(message);
        }
        match self.below(4) {
            0 => {
                let sample = self.not_finite();
                self.messages.push(sample);
            }
            1 => self.messages.extend(vec![ScenarioMessage::Damaged { byte: 5 }; 6]),
            2 => {
                let configure = self.unusable();
                self.messages.push(configure);
            }
            _ => self.messages.push(ScenarioMessage::Repeat {}),
        }
        self.samples(2);
    }

    /// Sends one kind of message in one state, so that every rule of the protocol has its turn.
    fn rule(&mut self, state: u64, event: u64) {
        match state {
            0 => {
                let configure = self.unusable();
                self.messages.push(configure);
            }
            1 => self.messages.push(configure(NONE)),
            _ => self.messages.extend(self.trial.iter().cloned()),
        }
        match state {
            TIMED_OUT => {
                let timeout = if self.limits.own_clock { WALL_TIMEOUTS_MS[0] } else { SHORT_TIMEOUTS_MS[0] };
                self.messages.push(configure(ConfigurationChange { watchdog_timeout_ms: Some(timeout), ..NONE }));
                self.samples(1);
                self.messages.push(ScenarioMessage::Wait { ms: 1.7 * f64::from(timeout) });
            }
            4 => {
                self.messages.extend(vec![ScenarioMessage::Damaged { byte: 5 }; 5]);
                self.messages.push(ScenarioMessage::Hello {});
            }
            5 => {
                let sample = self.not_finite();
                self.messages.push(sample);
            }
            6 => self.messages.push(ScenarioMessage::Safe {}),
            _ => {}
        }
        let message = match event % EVENTS {
            0 => ScenarioMessage::Hello {},
            1 => ScenarioMessage::Safe {},
            2 => configure(self.usable()),
            3 => self.unusable(),
            4 => self.sample(),
            5 => {
                // A configuration forgets the number of the last sample, a stop does not.
                if self.one_in(2) {
                    self.samples(1);
                }
                ScenarioMessage::Repeat {}
            }
            6 => self.not_finite(),
            7 => self.rejected(),
            _ => self.ignored(),
        };
        self.messages.push(message);
        self.samples(1);
    }

    /// Silences cost wall time, so only the sequences that prefer them have them in wall time.
    fn pick_block(&mut self, index: usize) -> Block {
        let block = ALL_BLOCKS.get(index).copied().unwrap_or(Block::Stop);
        let is_slow = self.limits.own_clock && matches!(block, Block::Watchdog);
        if is_slow { Block::Rejected } else { block }
    }

    fn long_run(&mut self, number: u64) {
        let again = |messages, times| ScenarioMessage::Again { messages, times };
        let round = number / LONG_RUN_KINDS;
        match number % LONG_RUN_KINDS {
            0 => {
                let rejected = self.rejected();
                self.messages.push(rejected);
                self.samples(2);
                self.messages.push(again(3, MANY_REJECTED));
                self.messages.extend(vec![ScenarioMessage::Damaged { byte: 5 }; 5]);
                self.samples(2);
            }
            1 => {
                self.messages.truncate(3);
                self.messages.push(again(3, in_turn(&MANY_CONFIGURATIONS, round)));
                self.samples(2);
            }
            2 => {
                self.messages.push(again(1, in_turn(&LONG_RUNS, round)));
                self.samples(4);
            }
            3 if !self.limits.own_clock => self.clock_wrap(in_turn(&CLOCK_WRAPS_MS, round)),
            _ => {
                self.steady_gains(None);
                // The mean error is 0, so that the drive stays between its limits.
                let setpoints = [1.0, 1.5, 0.75, 1.75];
                let samples = setpoints.map(|setpoint| ScenarioMessage::sample(setpoint, 1.25, 0.0));
                self.messages.extend(samples);
                self.messages.push(again(4, in_turn(&MANY_SETPOINTS, round)));
                self.samples(2);
            }
        }
        self.messages.extend(self.trial.iter().cloned());
    }

    /// A configuration with gains, and a law that does not adapt them if there is one.
    fn steady_gains(&mut self, drive_limit_vpp: Option<f32>) {
        let is_fixed = self.limits.laws.contains(&LawId::DqPiFixed);
        let law = is_fixed.then_some(LawId::DqPiFixed as u8);
        let gains = Some([275.0, 110_000.0, 900.0, 400_000.0].map(number));
        let drive_limit_vpp = drive_limit_vpp.map(number);
        self.messages.push(configure(ConfigurationChange { law, gains, drive_limit_vpp, ..NONE }));
    }

    /// Samples at several scales, with the drive limit in proportion: drawn ones, or a setpoint that
    /// moves by less than the sensor resolves. Its Wd stays, so that the drive follows the sum of the
    /// moves.
    fn scaled(&mut self) {
        let mut samples = Vec::new();
        if self.one_in(3) {
            for _ in 0..self.range(4..=10) {
                let setpoint = self.pick(&[2.0, 0.5, 1.5, 0.75, 0.0], 1.5);
                samples.push([setpoint, self.uniform(0.0, 1.1) * setpoint, self.uniform(-0.4, 0.4) * setpoint]);
            }
        } else {
            let (start, step) = (self.pick(&[2.0, 0.5, 1.5], 2.0), self.pick(&RAMP_STEPS_UM, 5e-5));
            samples.extend((0..self.range(30..=40)).map(|number| [start + step * number as f32, start, 0.0]));
        }
        for scale in SCALES {
            self.steady_gains(Some(SCALED_LIMIT_VPP * scale));
            let scaled = samples.iter().map(|sample| sample.map(|value| value * scale));
            self.messages.extend(scaled.map(|[setpoint, wd, wq]| ScenarioMessage::sample(setpoint, wd, wq)));
        }
    }

    /// Waits without a sample.
    fn wait(&mut self, ms: u32) {
        let whole = ms / LONGEST_WAIT_MS;
        if whole > 0 {
            self.messages.push(ScenarioMessage::Wait { ms: LONGEST_WAIT_MS.into() });
        }
        if whole > 1 {
            self.messages.push(ScenarioMessage::Again { messages: 1, times: whole - 1 });
        }
        self.messages.push(ScenarioMessage::Wait { ms: (ms % LONGEST_WAIT_MS).into() });
    }

    /// Samples before and after the instant at which a clock wraps, with silences shorter than the
    /// timeout.
    fn clock_wrap(&mut self, at_ms: u32) {
        self.messages.push(configure(ConfigurationChange { watchdog_timeout_ms: Some(u16::MAX), ..NONE }));
        self.wait(at_ms - BEFORE_WRAP_MS);
        self.samples(2);
        for ms in [5_000.0, 10_000.0, 10_000.0] {
            self.messages.push(ScenarioMessage::Wait { ms });
            self.samples(2);
        }
    }

    fn add(&mut self, block: Block) {
        match block {
            Block::Boundary => self.boundary(),
            Block::Unusable => {
                let configure = self.unusable();
                self.messages.push(configure);
                self.samples(2);
                if self.one_in(2) {
                    self.messages.push(ScenarioMessage::Hello {});
                }
            }
            Block::Rejected => {
                for _ in 0..self.range(1..=4) {
                    for _ in 0..self.range(1..=5) {
                        let rejected = self.rejected();
                        self.messages.push(rejected);
                    }
                    let samples = self.range(1..=6);
                    self.samples(samples);
                }
            }
            Block::Ignored => {
                let body = self.ignored();
                let count = self.range(1..=7) as usize;
                self.messages.extend(vec![body; count]);
                self.samples(1);
                for _ in 0..self.range(0..=4) {
                    let rejected = self.rejected();
                    self.messages.push(rejected);
                }
                self.samples(2);
            }
            Block::Watchdog => self.watchdog(),
            Block::NotFinite => {
                let sample = self.not_finite();
                self.messages.push(sample);
                if self.one_in(3) {
                    self.messages.push(ScenarioMessage::Repeat {});
                }
                for _ in 0..self.range(0..=6) {
                    let rejected = self.rejected();
                    self.messages.push(rejected);
                }
                self.samples(2);
            }
            Block::Numbers => self.numbers(),
            Block::Scaled => self.scaled(),
            Block::Stop => self.stop(),
        }
    }

    fn samples(&mut self, count: u32) {
        for _ in 0..count {
            let sample = self.sample();
            self.messages.push(sample);
        }
    }

    fn sample(&mut self) -> ScenarioMessage {
        let setpoint = self.pick(&[2.0, 0.5, 4.0, 2.0, 0.0], 2.0);
        let scale = f32::max(setpoint, 0.5);
        ScenarioMessage::sample(setpoint, self.uniform(0.0, 1.1) * scale, self.uniform(-0.4, 0.4) * scale)
    }

    fn not_finite(&mut self) -> ScenarioMessage {
        let mut values = [2.0, 1.2, -0.2];
        let value = self.pick(&[f32::NAN, f32::INFINITY, f32::NEG_INFINITY], f32::NAN);
        let at = self.below(3);
        values.get_mut(at).into_iter().for_each(|place| *place = value);
        let [setpoint, wd, wq] = values;
        ScenarioMessage::sample(setpoint, wd, wq)
    }

    fn numbers(&mut self) {
        for _ in 0..self.range(2..=6) {
            let mut sample = self.sample();
            let ahead_of = self.pick(&[0, 2, 127, 128, 129, 255], 0);
            let split = self.range(1..=23) as u8;
            let kind = self.below(4);
            if let ScenarioMessage::Sample { ahead, split_at, .. } = &mut sample {
                match kind {
                    0 => *split_at = Some(split),
                    1 | 2 => *ahead = ahead_of,
                    _ => {}
                }
            }
            self.messages.push(sample);
            match self.below(5) {
                0 => self.messages.push(ScenarioMessage::Repeat {}),
                1 => self.messages.push(ScenarioMessage::Hello {}),
                2 => {
                    let rejected = self.rejected();
                    self.messages.push(rejected);
                }
                _ => {}
            }
        }
    }

    /// Ends the trial in one of the ways of the protocol.
    fn stop(&mut self) {
        match self.below(5) {
            0 => self.messages.push(ScenarioMessage::Safe {}),
            1 => {
                let sample = self.not_finite();
                self.messages.push(sample);
            }
            2 => {
                let count = self.range(5..=6) as usize;
                self.messages.extend(vec![ScenarioMessage::Damaged { byte: 5 }; count]);
                self.messages.push(ScenarioMessage::Hello {});
            }
            3 => {
                let configure = self.unusable();
                self.messages.push(configure);
            }
            _ => self.messages.extend([ScenarioMessage::Safe {}, ScenarioMessage::Safe {}]),
        }
        // The sample from before the stop.
        if self.one_in(2) {
            self.messages.push(ScenarioMessage::Repeat {});
        }
        for _ in 0..self.range(0..=2) {
            let sample = self.sample();
            self.messages.push(sample);
            if self.one_in(2) {
                self.messages.push(ScenarioMessage::Repeat {});
            }
        }
        if self.one_in(3) {
            self.messages.push(ScenarioMessage::Hello {});
        }
    }

    /// Silences shorter and longer than the timeout, with messages that do not restart it.
    fn watchdog(&mut self) {
        let own_clock = self.limits.own_clock;
        let timeouts = match own_clock {
            true => &WALL_TIMEOUTS_MS[..],
            false if self.one_in(2) => &WATCHED_TIMEOUTS_MS,
            false => &SHORT_TIMEOUTS_MS,
        };
        let timeout = self.pick(timeouts, 200);
        let is_default = self.one_in(4);
        if is_default && !own_clock && self.one_in(2) {
            self.long_period();
            return;
        }
        let (watchdog_timeout_ms, period_us) =
            if is_default { (0, u32::from(timeout) * 200) } else { (timeout, self.pick(&[1_000, 500, 4_000], 1_000)) };
        self.messages.push(configure(ConfigurationChange {
            watchdog_timeout_ms: Some(watchdog_timeout_ms),
            period_us: Some(period_us),
            gains: Some([275.0, 110_000.0, 900.0, 400_000.0].map(number)),
            ..NONE
        }));
        let before = self.range(0..=2);
        if before == 0 {
            // The watchdog starts with the first sample.
            self.wait(u32::from(timeout) * 3 / 2);
        }
        let samples = self.pick(&[1, 1, 2, 3], 1);
        self.samples(samples);
        let timeout = f64::from(timeout);
        let shares: &[f64] = match self.below(6) {
            0 | 1 => &[0.4],
            2 | 3 => &[0.55, 0.6],
            // A host may be 80 ms late.
            4 if timeout > 600.0 || !own_clock => &[0.85],
            4 => &[0.4, 1.7],
            _ => &[1.7],
        };
        let between = self.below(5);
        for (number, share) in shares.iter().enumerate() {
            // In simulated time a silence may end next to the timeout.
            let near = timeout + self.pick(if self.limits.exact_time { &NEAREST_MS[..] } else { &NEAR_MS }, 6.0);
            let is_near = !own_clock && shares.len() == 1 && self.one_in(2);
            let ms = if is_near { near } else { share * timeout };
            let whole = (ms - ms.rem_euclid(1e3)) as u32;
            if whole > 0 {
                self.wait(whole);
            }
            self.messages.push(ScenarioMessage::Wait { ms: ((ms - f64::from(whole)) * 10.0).round() / 10.0 });
            if number + 1 < shares.len() {
                let message = match between {
                    0 => ScenarioMessage::Damaged { byte: 5 },
                    1 => ScenarioMessage::Hello {},
                    2 => ScenarioMessage::Repeat {},
                    3 => self.ignored(),
                    _ => self.sample(),
                };
                self.messages.push(message);
            }
        }
        // The timeout decides the cause, not the values.
        if self.one_in(2) {
            let sample = self.not_finite();
            self.messages.push(sample);
        }
        self.samples(2);
    }

    /// Silences much shorter than the default timeout of a period of many minutes.
    fn long_period(&mut self) {
        let period_us = self.pick(&LONG_PERIODS_US, u32::MAX);
        let gains = Some([275.0, 110_000.0, 900.0, 400_000.0].map(number));
        self.messages.push(configure(ConfigurationChange {
            watchdog_timeout_ms: Some(0),
            period_us: Some(period_us),
            gains,
            ..NONE
        }));
        self.samples(2);
        let ms = self.pick(&[1_000, 100_000, 600_000], 1_000);
        self.wait(ms);
        self.samples(2);
    }

    /// An accepted configuration at a boundary of one field.
    fn boundary(&mut self) {
        let mut change = self.usable();
        let mut has_samples = true;
        let timeout = self.pick(&LONG_TIMEOUTS_MS, 1_000);
        match self.below(9) {
            0 => change.watchdog_timeout_ms = Some(timeout),
            1 => change.period_us = Some(self.pick(&[255, 256, 300, 4_000, 16_383, 20_000], 300)),
            2 => {
                change.start_frequency_mhz = Some(self.pick(&START_FREQUENCIES_MHZ, 1));
                has_samples = false;
            }
            3 => change.drive_limit_vpp = Some(number(self.pick(&[0.125, 1.0, 6_553.5, 65_536.25, 1e6], 1.0))),
            4 => change.frequency_range_hz = Some(number(self.pick(&[0.001, 0.05, 3.75, 65.536, 5_000.0], 3.75))),
            5 => change.frequency_slew_hz = Some(number(self.pick(&[0.001, 0.014, 1.6, 65.536, 5_000.0], 1.6))),
            6 => change.response_time_s = Some(number(self.pick(&[0.0, 0.000_9, 0.008], 0.0))),
            7 => change.gains = Some(self.pick(&[[0.0; 4], [275.0, 0.0, -900.0, 0.0]], [0.0; 4]).map(number)),
            _ if self.limits.has_loop_delay => {
                let period = self.pick(&[1_000, 3_000], 1_000);
                (change.period_us, change.gains) = (Some(period), None);
                change.loop_delay_us = Some(self.pick(&[1, period / 20, period / 12, period, period / 3, period], 1));
            }
            _ => change.watchdog_timeout_ms = Some(u16::MAX),
        }
        self.messages.push(configure(change));
        if has_samples {
            let count = self.range(2..=8);
            self.samples(count);
        } else {
            // The answer contains the start frequency.
            self.messages.extend([ScenarioMessage::Hello {}, ScenarioMessage::Safe {}]);
        }
    }

    fn usable(&mut self) -> ConfigurationChange {
        let is_other = self.limits.laws.len() > 1 && self.one_in(4);
        let law = self.pick(&self.limits.laws, LawId::OpenLoop) as u8;
        ConfigurationChange { law: is_other.then_some(law), gains: self.gains(), ..NONE }
    }

    fn gains(&mut self) -> Option<[WireNumber; 4]> {
        self.one_in(2).then(|| [275.0, 110_000.0, 900.0, 400_000.0].map(number))
    }

    /// A configuration that the controller must answer with 1.
    fn unusable(&mut self) -> ScenarioMessage {
        let wrong = number(self.pick(&[0.0, -0.0, -1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY], 0.0));
        let mut gains = [275.0, 110_000.0, 900.0, 400_000.0].map(number);
        let at = self.below(4);
        let gain = self.pick(&[NonFinite::Nan, NonFinite::Infinity, NonFinite::NegativeInfinity], NonFinite::Nan);
        gains.get_mut(at).into_iter().for_each(|place| *place = WireNumber::NonFinite(gain));
        let response = number(self.pick(&[-0.001, f32::NAN, f32::INFINITY], f32::NAN));
        match self.below(10) {
            0 => configure(ConfigurationChange { period_us: Some(0), ..NONE }),
            1 => configure(ConfigurationChange { start_frequency_mhz: Some(0), ..NONE }),
            2 => configure(ConfigurationChange { gain_um_per_vpp: Some(wrong), ..NONE }),
            3 => configure(ConfigurationChange { time_constant_s: Some(wrong), ..NONE }),
            4 => configure(ConfigurationChange { drive_limit_vpp: Some(wrong), ..NONE }),
            5 => configure(ConfigurationChange { frequency_range_hz: Some(wrong), ..NONE }),
            6 => configure(ConfigurationChange { frequency_slew_hz: Some(wrong), ..NONE }),
            7 => configure(ConfigurationChange { response_time_s: Some(response), ..NONE }),
            8 if self.limits.has_loop_delay => {
                let period = self.pick(&[1_000, 300, 4_000], 1_000);
                let loop_delay_us = Some(period + 1);
                configure(ConfigurationChange { period_us: Some(period), loop_delay_us, ..NONE })
            }
            9 if !self.limits.has_own_plate => configure(ConfigurationChange { own_plate: true, ..NONE }),
            _ if self.limits.is_own_law => configure(ConfigurationChange { response_time_s: Some(response), ..NONE }),
            _ => configure(ConfigurationChange { gains: Some(gains), ..NONE }),
        }
    }

    /// A frame that the controller rejects.
    fn rejected(&mut self) -> ScenarioMessage {
        let zeros = |first: &str, count: usize| ScenarioMessage::Body { hex: format!("{first}{}", "00".repeat(count)) };
        match self.below(10) {
            0 => ScenarioMessage::Bytes { hex: format!("{}00", "07".repeat(self.pick(&GARBAGE_BYTES, 24))) },
            1 => zeros(self.pick(&["055a", "255a", "f55a"], "255a"), 16),
            2 => zeros(self.pick(&["105a", "1c5a", "1f5a"], "1c5a"), self.below(18)),
            3 => zeros("155a", self.pick(&[0, 15, 17, 40], 15)),
            4 => zeros("175a", 1),
            5 => zeros("115a", self.pick(&[1, 16], 1)),
            // A law that the page does not list, and an unknown bit.
            6 => zeros(self.pick(&["135a09", "135a0010", "135a0080"], "135a09"), 51 - self.below(2)),
            7 => ScenarioMessage::Body { hex: ZERO_DELAY.to_owned() },
            _ => ScenarioMessage::Damaged { byte: self.range(0..=22) as u8 },
        }
    }

    /// A valid message that only a controller sends, or a setpoint for a controller without a plate.
    fn ignored(&mut self) -> ScenarioMessage {
        let command = "165ad2040000 0000c843 90f9ec01 01 00 0000";
        let configured = "145a01 00 00000000000000000000000000000000";
        let fault = "185a0200 34120008 01000000 00000000 00000000";
        let setpoint = "1a5a 00000040";
        let all = [command, configured, fault, "195a 04030201", setpoint];
        let count = if self.limits.has_own_plate { all.len() - 1 } else { all.len() };
        let hex = self.pick(all.get(..count).unwrap_or_default(), command).to_owned();
        ScenarioMessage::Body { hex }
    }
}

fn in_turn(all: &[u32], number: u64) -> u32 {
    all.get((number % all.len().max(1) as u64) as usize).copied().unwrap_or(1)
}

fn number(value: f32) -> WireNumber {
    WireNumber::from(value)
}

/// No change of the configuration.
pub(crate) const NONE: ConfigurationChange = ConfigurationChange {
    law: None,
    watchdog_timeout_ms: None,
    period_us: None,
    start_frequency_mhz: None,
    gain_um_per_vpp: None,
    time_constant_s: None,
    response_time_s: None,
    drive_limit_vpp: None,
    frequency_range_hz: None,
    frequency_slew_hz: None,
    gains: None,
    loop_delay_us: None,
    paced_by_target: false,
    own_plate: false,
};

const fn configure(change: ConfigurationChange) -> ScenarioMessage {
    ScenarioMessage::Configure(change)
}

/// Builds the scenario of a sequence. Its trial is as short as possible.
pub fn scenario(
    envelope: &Envelope,
    law: ExploredLaw,
    messages: &[ScenarioMessage],
    title: &str,
    plate_prefix: &str,
    compares_reference: bool,
) -> SceneScenario {
    let expect = |property: Property, metric: Metric, at_most| RawExpectation {
        name: Some(property.name().to_owned()),
        metric: metric.name().to_owned(),
        at_most: Some(at_most),
        ..RawExpectation::default()
    };
    let mut expectations = vec![expect(Property::Answers, Metric::ProtocolDifferences, 0.0)];
    if compares_reference {
        let metric = Metric::ReferenceDifference;
        expectations.push(expect(Property::Reference, metric, REFERENCE_DIFFERENCE_PERCENT));
    }
    let plate = PathBuf::from(format!("plates/{plate_prefix}messages.toml"));
    let raw_plate = raw_plate(&envelope.plate);
    let scenario = RawScenario {
        title: title.to_owned(),
        source: Some("platebench suite explore; the rules: docs/wire-protocol.md".to_owned()),
        plate: plate.clone(),
        duration_ms: 1.0,
        tags: vec!["explored".to_owned()],
        trace_step_ms: None,
        model: None,
        only_if_named: None,
        expected_exit: None,
        timeout_s: None,
        controller: RawController { law: Some(law.name().to_owned()), ..RawController::default() },
        profile: RawProfiles {
            setpoint_um: RawProfile::Number(2.0),
            temperature_offset_k: RawProfile::Number(0.0),
            finger_force_n: RawProfile::Number(0.0),
        },
        trials: RawTrials::default(),
        fault: Vec::new(),
        between: Vec::new(),
        other_trials: None,
        message: messages.to_vec(),
        expect: expectations,
        matrix: None,
    };
    SceneScenario { scenario, plates: BTreeMap::from([(plate, raw_plate)]) }
}
