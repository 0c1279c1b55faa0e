//! Compares the answers of a controller with those of the hosted reference, and the number and the
//! send times of its ticks.

use crate::compared_link::{FREQUENCY_TOLERANCE_MHZ, command_difference};
use crate::handshake::HELLO_NUMBER;
use platebench_wire::{
    Command, Configure, Configured, ControllerState, Gains, Identity, LawId, Message, Packet, PacketReader, Sample,
    StateCause, flags,
};
use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::ops::RangeInclusive;
use std::time::Duration;

/// Largest relative difference of reported gains from configured ones.
const GAIN_TOLERANCE: f32 = 1e-5;
/// Largest relative difference of the gains that a `dq-pi` law designs from those of
/// `docs/wire-protocol.md`.
const DESIGN_TOLERANCE: f32 = 0.12;
/// If gains differ by at most this share, target and reference have the same design.
const SAME_DESIGN: f32 = 1e-4;
/// Largest difference of a *running* command, if target and reference have the same gains: drive
/// relative to its limit, frequency relative to its range. Rounding causes less.
pub(super) const SAME_GAINS_TOLERANCE: f64 = 1e-3;
/// The same tolerance if the target's gains have another design. An error of 10 % in the gains
/// changes a drive by about this share of its limit.
const OTHER_DESIGN_TOLERANCE: f64 = 0.15;
/// If a variation of the script changes a command by more than this share of the tolerance, the
/// command is not compared. The first share is for rounding, the second for another design.
const ROUNDING_SHARE: f64 = 0.25;
const OTHER_DESIGN_SHARE: f64 = 0.5;
/// Largest number of stored commands of [`CommandHistory`].
const MAX_HISTORY: usize = 50_000;
/// Number of variations by rounding. They precede the variations of the design.
const ROUNDING_VARIATIONS: usize = 2;
/// Shortest time between two commands whose time stamps are compared, and the relative tolerance of
/// the difference of their time stamps.
const COMPARED_SILENCE: Duration = Duration::from_millis(100);
const CLOCK_TOLERANCE: f64 = 0.1;

pub(super) struct CommandDifference {
    pub(super) text: String,
    /// Rule of the protocol that differences in several scripts have in common.
    pub(super) rule: Option<&'static str>,
    pub(super) other_cause: Option<BenchCause>,
}

/// A cause other than the controller that may explain a difference.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum BenchCause {
    /// The line may have lost an answer.
    NoAnswer,
    /// The host may have delayed a controller that is a program on it.
    LateAnswer,
    /// The host may have sent the ticks late.
    LateTicks,
    /// The host may have been late with an exchange.
    Stall,
}

/// Answer to a configuration.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Outcome {
    Accepted,
    Rejected,
}

pub(super) struct ReceivedPackets {
    answers: Vec<Packet>,
    ticks: Vec<Packet>,
}

impl ReceivedPackets {
    /// Omits the watchdog's own report of a stop, because it is sent only if no sample arrives
    /// first. If a sample arrives first, its answer reports the stop. Omits ticks before the answer
    /// to a configuration, because they belong to the previous configuration.
    pub(super) fn new(bytes: &[u8], request: u8) -> Self {
        let is_report = |packet: &Packet| {
            matches!(packet.message, Message::Command(command) if command.cause == StateCause::SampleTimeout)
                && packet.sequence != request
        };
        // An answer to a hello of the handshake.
        let is_late_identity = |packet: &Packet| {
            matches!(packet.message, Message::Identity(_)) && packet.sequence == HELLO_NUMBER && request != HELLO_NUMBER
        };
        let is_tick = |packet: &Packet| matches!(packet.message, Message::Tick(_));
        let mut packets = packets(bytes);
        if let Some(at) = packets.iter().position(|packet| matches!(packet.message, Message::Configured(_))) {
            let earlier: Vec<_> = packets.drain(..at).filter(|packet| !is_tick(packet)).collect();
            packets.splice(0..0, earlier);
        }
        let (ticks, answers): (Vec<_>, Vec<_>) = packets.into_iter().partition(is_tick);
        let answers = answers.into_iter().filter(|packet| !is_report(packet) && !is_late_identity(packet));
        Self { answers: answers.collect(), ticks }
    }
}

pub(super) fn packets(bytes: &[u8]) -> Vec<Packet> {
    PacketReader::new().packets(bytes).flatten().collect()
}

/// Commands of a controller by everything that its law received since the configuration. A
/// configuration clears the whole state, so the same samples must give the same commands.
#[derive(Debug, Default)]
pub(super) struct CommandHistory(HashMap<u64, (f32, u32)>);

/// The configuration and the samples of the law since then, relative to `scale`.
#[derive(Debug)]
struct LawInputs {
    hash: u64,
    /// Power of two at most the drive limit, if the law is linear below its limit: with the limit, the
    /// setpoint and the components multiplied by a power of two its drive is too. Otherwise 1.
    scale: f32,
    first_us: Option<u32>,
    last_number: Option<u8>,
}

impl LawInputs {
    const NONE: Self = Self { hash: 0, scale: 1.0, first_us: None, last_number: None };

    fn configure(configure: &Configure, is_linear: bool) -> Self {
        let limit_vpp = configure.drive_limit_vpp;
        let scale =
            if is_linear && limit_vpp.is_normal() && limit_vpp > 0.0 { limit_vpp.log2().floor().exp2() } else { 1.0 };
        let scaled = Configure { drive_limit_vpp: limit_vpp / scale, ..*configure };
        // `Debug` writes every digit of a float.
        Self { hash: hash_of(&format!("{scaled:?}")), scale, ..Self::NONE }
    }

    /// A repeated sample does not reach the law.
    fn add(&mut self, number: u8, sample: &Sample) {
        if self.last_number.replace(number) == Some(number) {
            return;
        }
        let since_us = sample.time_us.wrapping_sub(*self.first_us.get_or_insert(sample.time_us));
        let values = [sample.setpoint_um, sample.wd_um, sample.wq_um].map(|value| (value / self.scale).to_bits());
        self.hash = hash_of(&(self.hash, since_us, values));
    }
}

/// True for a law that `docs/wire-protocol.md` defines, so that its commands can be compared.
pub const fn is_defined_law(law: LawId) -> bool {
    matches!(law, LawId::OpenLoop | LawId::DqPi | LawId::DqPiEuler | LawId::DqPiFixed)
}

fn hash_of(value: &impl Hash) -> u64 {
    let mut hasher = DefaultHasher::new();
    value.hash(&mut hasher);
    hasher.finish()
}

/// What is compared with the reference.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ComparisonScope {
    /// The rules of the protocol, and drive and frequency of a *running* command of a law that
    /// `docs/wire-protocol.md` defines.
    Numbers,
    Rules,
    /// The rules, for a law of the controller's own, whose number means nothing.
    OwnLaw,
}

pub(super) struct ScriptComparison<'a> {
    identity: &'a Identity,
    scope: ComparisonScope,
    requests: PacketReader,
    inputs: LawInputs,
    last_command: Option<Command>,
    configuration: Option<Configure>,
    has_other_design: bool,
    /// Outcome of the last configuration, if the target accepted what the reference rejected, or the
    /// reverse, and may do so. Only the rules for every law are compared then.
    own_outcome: Option<Outcome>,
    /// True if a variation changed a command too much, so that commands are not compared.
    is_ambiguous: bool,
    /// Last commands of target and reference in the state *running*.
    running: Option<[Command; 2]>,
    /// Value of `running` if its commands belong to the previous exchange.
    previous: Option<[Command; 2]>,
    ticks: TickComparison,
}

impl<'a> ScriptComparison<'a> {
    pub(super) fn new(identity: &'a Identity, scope: ComparisonScope) -> Self {
        Self {
            identity,
            scope,
            requests: PacketReader::new(),
            inputs: LawInputs::NONE,
            last_command: None,
            configuration: None,
            has_other_design: false,
            own_outcome: None,
            is_ambiguous: false,
            running: None,
            previous: None,
            ticks: TickComparison::default(),
        }
    }

    pub(super) fn observe_requests(&mut self, bytes: &[u8]) -> u8 {
        let requests: Vec<_> = self.requests.packets(bytes).flatten().collect();
        let last = requests.last().map_or(0, |packet| packet.sequence);
        for packet in requests {
            match packet.message {
                Message::Configure(configure) => {
                    self.configuration = Some(configure);
                    (self.has_other_design, self.is_ambiguous, self.own_outcome) = (false, false, None);
                    self.previous = None;
                    let is_linear = self.scope != ComparisonScope::OwnLaw && is_defined_law(configure.law);
                    self.inputs = LawInputs::configure(&configure, is_linear);
                    self.ticks = TickComparison::new(&configure);
                }
                Message::Sample(sample) => self.inputs.add(packet.sequence, &sample),
                _ => {}
            }
        }
        last
    }

    /// `expected` contains the packets of the reference, then of its variations. `silence` is the
    /// range of the time since the previous exchange on the controller's clock.
    pub(super) fn compare(
        &mut self,
        received: &ReceivedPackets,
        expected: &[ReceivedPackets],
        silence: RangeInclusive<Duration>,
        history: &mut CommandHistory,
    ) -> Result<(), CommandDifference> {
        let Some((reference, varied)) = expected.split_first() else { return Ok(()) };
        let previous = self.previous.take();
        let late = silence.end().saturating_sub(*silence.start());
        if let Some(text) = self.ticks.add(&received.ticks, reference.ticks.len(), late) {
            return Err(CommandDifference { text, rule: None, other_cause: Some(BenchCause::LateTicks) });
        }
        if let Some(drift) = self.ticks.drift() {
            let text =
                format!("the ticks of the controller drifted by {drift:.1?}, expected at most a quarter of the period");
            return Err(CommandDifference { text, rule: None, other_cause: Some(BenchCause::LateTicks) });
        }
        for (position, expected) in reference.answers.iter().enumerate() {
            let Some(answer) = received.answers.get(position) else {
                let text = format!("no answer, expected {}", show(expected));
                return Err(CommandDifference { text, rule: None, other_cause: Some(BenchCause::NoAnswer) });
            };
            self.observe_design(answer, expected);
            let varied = if self.compares_numbers() { varied } else { &[] };
            for (number, other) in varied.iter().enumerate() {
                self.is_ambiguous |=
                    other.answers.get(position).is_none_or(|other| self.is_far(expected, other, number));
            }
            self.own_outcome = self.own_outcome.or_else(|| self.permitted_outcome(answer, expected));
            if let Some(outcome) = self.own_outcome.filter(|_| answer.sequence == expected.sequence) {
                self.check_own_outcome(answer, outcome, history)?;
                continue;
            }
            if !self.is_equal(answer, expected) {
                let configured = self.configuration.and_then(|configuration| configuration.gains);
                let (text, rule) = describe(answer, expected, configured);
                let other_cause = (answer.sequence != expected.sequence).then_some(BenchCause::NoAnswer);
                return Err(CommandDifference { text, rule, other_cause });
            }
            if matches!(answer.message, Message::Configured(configured) if configured.outcome.is_ok()) {
                (self.running, self.last_command) = (None, None);
            }
            if let Message::Command(command) = &answer.message {
                self.check_flags(command)?;
            }
            if let (Message::Command(answer), Message::Command(expected)) = (&answer.message, &expected.message)
                && expected.state == ControllerState::Running
            {
                self.check_rules(answer, history)?;
                let commands = [*answer, *expected];
                if let Some(previous) = previous {
                    compare_clocks(previous, commands, &silence)?;
                }
                (self.running, self.previous) = (Some(commands), Some(commands));
            }
        }
        match received.answers.get(reference.answers.len()) {
            Some(answer) => differs(format!("{}, expected no further message", show(answer))),
            None => Ok(()),
        }
    }

    /// The target's answer to a gain that is not finite, if it differs from the reference and one of
    /// both laws may not use this gain. Target and reference then have different states until the next
    /// configuration.
    fn permitted_outcome(&self, answer: &Packet, expected: &Packet) -> Option<Outcome> {
        let (Message::Configured(answer), Message::Configured(expected)) = (&answer.message, &expected.message) else {
            return None;
        };
        let is_unusable = !are_finite(self.configuration?.gains?);
        let outcome = if answer.outcome.is_ok() { Outcome::Accepted } else { Outcome::Rejected };
        let is_permitted = outcome == Outcome::Rejected || self.scope == ComparisonScope::OwnLaw;
        (is_unusable && is_permitted && answer.outcome.is_ok() != expected.outcome.is_ok()).then_some(outcome)
    }

    fn check_own_outcome(
        &mut self,
        answer: &Packet,
        outcome: Outcome,
        history: &mut CommandHistory,
    ) -> Result<(), CommandDifference> {
        let Message::Command(command) = &answer.message else { return Ok(()) };
        self.check_flags(command)?;
        match (outcome, command.state) {
            (Outcome::Accepted, ControllerState::Running) => self.check_rules(command, history),
            (_, state) if state != ControllerState::Running && command.drive_vpp == 0.0 => Ok(()),
            _ => differs(format!("{}, expected 0 Vpp and not running", show(answer))),
        }
    }

    fn observe_design(&mut self, answer: &Packet, expected: &Packet) {
        if let (Message::Configured(answer), Message::Configured(expected)) = (&answer.message, &expected.message)
            && let (Ok(answer), Ok(expected)) = (answer.outcome, expected.outcome)
        {
            self.has_other_design = !are_close(answer, expected, SAME_DESIGN);
        }
    }

    /// Checks the rules for the flags that hold for every law.
    fn check_flags(&self, answer: &Command) -> Result<(), CommandDifference> {
        let Command { drive_vpp, flags: set, state, .. } = *answer;
        if state != ControllerState::Running {
            let text = format!("flags {set} in the state {state:?}, expected 0 without a control step");
            return if set == 0 { Ok(()) } else { breaks(FLAGS, text) };
        }
        let limit_vpp = self.configuration.map_or(f32::INFINITY, |configuration| configuration.drive_limit_vpp);
        let is_saturated = set & flags::SATURATED != 0;
        if drive_vpp == limit_vpp && !is_saturated {
            return breaks(FLAGS, format!("flags {set} at the drive limit of {limit_vpp} Vpp, expected flag 1"));
        }
        if is_saturated && drive_vpp < limit_vpp * (1.0 - SAME_GAINS_TOLERANCE as f32) {
            return breaks(
                FLAGS,
                format!("flag 1 at {drive_vpp} Vpp, expected it at the drive limit of {limit_vpp} Vpp only"),
            );
        }
        let both = flags::FREQUENCY_LIMITED | flags::FREQUENCY_HELD;
        if set & both == both {
            return breaks(FLAGS, format!("flags {set}, expected 2 or 4 but not both"));
        }
        Ok(())
    }

    /// Checks the rules for a *running* command that hold for every law.
    fn check_rules(&mut self, answer: &Command, history: &mut CommandHistory) -> Result<(), CommandDifference> {
        let (Some(configuration), ControllerState::Running) = (self.configuration, answer.state) else {
            return Ok(());
        };
        let Command { drive_vpp, frequency_mhz, .. } = *answer;
        if !(0.0..=configuration.drive_limit_vpp).contains(&drive_vpp) {
            return breaks(
                DRIVE_RANGE,
                format!("a drive of {drive_vpp} Vpp, expected 0 to {} Vpp", configuration.drive_limit_vpp),
            );
        }
        let distance_hz = |from: u32| (f64::from(frequency_mhz) - f64::from(from)).abs() * 1e-3;
        let tolerance_hz = f64::from(FREQUENCY_TOLERANCE_MHZ) * 1e-3;
        let [range, slew] = [configuration.frequency_range_hz, configuration.frequency_slew_hz].map(f64::from);
        let offset = distance_hz(configuration.start_frequency_mhz);
        if offset > range + tolerance_hz {
            return breaks(
                FREQUENCY_RANGE,
                format!("a frequency {offset:.3} Hz from its start, expected at most {range} Hz"),
            );
        }
        let previous = self.last_command.replace(*answer);
        let change = distance_hz(previous.map_or(configuration.start_frequency_mhz, |last| last.frequency_mhz));
        if change > slew + tolerance_hz {
            return breaks(FREQUENCY_SLEW, format!("a frequency step of {change:.3} Hz, expected at most {slew} Hz"));
        }
        let CommandHistory(commands) = history;
        let Some((drive, frequency)) = commands.get(&self.inputs.hash).copied() else {
            if commands.len() < MAX_HISTORY {
                commands.insert(self.inputs.hash, (drive_vpp / self.inputs.scale, frequency_mhz));
            }
            return Ok(());
        };
        let earlier = Command { drive_vpp: drive * self.inputs.scale, frequency_mhz: frequency, ..*answer };
        if self.distance(answer, &earlier) <= SAME_GAINS_TOLERANCE {
            return Ok(());
        }
        let [answer, earlier] = [*answer, earlier].map(|command| show_command(0, &command));
        breaks(
            NO_MEMORY,
            format!(
                "{answer}, but after an earlier configuration with the same samples, or all in proportion to the \
                 limit, {earlier}"
            ),
        )
    }

    /// The law of the last configuration decides, whatever the law of the scenario is.
    fn compares_numbers(&self) -> bool {
        self.scope == ComparisonScope::Numbers
            && self.configuration.is_none_or(|configuration| is_defined_law(configuration.law))
    }

    fn tolerance(&self) -> f64 {
        if self.has_other_design { OTHER_DESIGN_TOLERANCE } else { SAME_GAINS_TOLERANCE }
    }

    fn is_far(&self, expected: &Packet, other: &Packet, variation: usize) -> bool {
        let share = if variation < ROUNDING_VARIATIONS { ROUNDING_SHARE } else { OTHER_DESIGN_SHARE };
        if variation >= ROUNDING_VARIATIONS && !self.has_other_design {
            return false;
        }
        match (&expected.message, &other.message) {
            (Message::Command(expected), Message::Command(other)) => {
                expected.state != other.state || self.distance(expected, other) > self.tolerance() * share
            }
            _ => false,
        }
    }

    fn is_equal(&self, answer: &Packet, expected: &Packet) -> bool {
        let has_number = answer.sequence == expected.sequence;
        has_number
            && match (&answer.message, &expected.message) {
                (Message::Identity(answer), Message::Identity(_)) => answer == self.identity,
                (Message::Configured(answer), Message::Configured(expected)) => {
                    match (answer.outcome, expected.outcome) {
                        (Err(_), Err(_)) => true,
                        (Ok(answer), Ok(expected)) => self.are_gains_equal(answer, expected),
                        _ => false,
                    }
                }
                (Message::Command(answer), Message::Command(expected)) => self.is_equal_command(answer, expected),
                _ => false,
            }
    }

    fn are_gains_equal(&self, answer: Gains, expected: Gains) -> bool {
        let Some(configuration) = self.configuration else { return true };
        let uses_four = self.scope != ComparisonScope::OwnLaw
            && matches!(configuration.law, LawId::DqPi | LawId::DqPiEuler | LawId::DqPiFixed);
        are_finite(answer)
            && match configuration.gains {
                Some(configured) => {
                    are_close(answer, configured, GAIN_TOLERANCE) || {
                        // A law may report 0 for a gain that it does not use.
                        let mut pairs = numbers(answer).into_iter().zip(numbers(configured));
                        let is_close = |(one, other): (f32, f32)| (one - other).abs() <= GAIN_TOLERANCE * other.abs();
                        !uses_four && pairs.all(|(own, configured)| own == 0.0 || is_close((own, configured)))
                    }
                }
                None => !uses_four || !self.compares_numbers() || are_close(answer, expected, DESIGN_TOLERANCE),
            }
    }

    fn is_equal_command(&self, answer: &Command, expected: &Command) -> bool {
        if (answer.state, answer.cause) != (expected.state, expected.cause) {
            return self.is_ambiguous && expected.state == ControllerState::Running;
        }
        if expected.state == ControllerState::Running {
            return !self.compares_numbers()
                || self.is_ambiguous
                || self.distance(answer, expected) <= self.tolerance();
        }
        let has_frequency = match &self.running {
            // A stopped controller keeps its own last frequency, not that of the reference.
            Some([own, reference]) if expected.frequency_mhz == reference.frequency_mhz => {
                answer.frequency_mhz == own.frequency_mhz
            }
            _ => answer.frequency_mhz.abs_diff(expected.frequency_mhz) <= FREQUENCY_TOLERANCE_MHZ,
        };
        answer.drive_vpp == 0.0 && has_frequency
    }

    /// Returns the larger difference of [`command_difference`]; infinite if a drive is not finite.
    fn distance(&self, one: &Command, other: &Command) -> f64 {
        let Some(configuration) = self.configuration else { return 0.0 };
        let [drive, frequency] = command_difference(one, other, &configuration);
        if drive.is_finite() { drive.max(frequency) } else { f64::INFINITY }
    }
}

fn differs<T>(text: String) -> Result<T, CommandDifference> {
    Err(CommandDifference { text, rule: None, other_cause: None })
}

/// Rules for every command. A controller breaks them in many scripts with other numbers.
const FLAGS: &str = "flags";
const DRIVE_RANGE: &str = "range of the drive";
const FREQUENCY_RANGE: &str = "range of the frequency";
const FREQUENCY_SLEW: &str = "slew of the frequency";
const NO_MEMORY: &str = "a configuration clears the state";

fn breaks<T>(rule: &'static str, text: String) -> Result<T, CommandDifference> {
    Err(CommandDifference { text, rule: Some(rule), other_cause: None })
}

fn compare_clocks(
    previous: [Command; 2],
    present: [Command; 2],
    silence: &RangeInclusive<Duration>,
) -> Result<(), CommandDifference> {
    let (shortest, longest) = (*silence.start(), *silence.end());
    let mut advances = previous.into_iter().zip(present).map(|(previous, present)| {
        Duration::from_micros(present.target_time_us.wrapping_sub(previous.target_time_us).into())
    });
    let (own, expected) = (advances.next().unwrap_or_default(), advances.next().unwrap_or_default());
    // The answer to a repeated sample has the time stamp of the first answer.
    if shortest < COMPARED_SILENCE || expected < shortest {
        return Ok(());
    }
    if own >= shortest.mul_f64(1.0 - CLOCK_TOLERANCE) && own <= longest.mul_f64(1.0 + CLOCK_TOLERANCE) {
        return Ok(());
    }
    differs(format!("the controller's clock advanced by {own:.1?}, expected {shortest:.1?} to {longest:.1?}"))
}

fn numbers(gains: Gains) -> [f32; 4] {
    [gains.amplitude_kp, gains.amplitude_ki, gains.frequency_kp, gains.frequency_ki]
}

fn are_finite(gains: Gains) -> bool {
    numbers(gains).into_iter().all(f32::is_finite)
}

fn are_close(one: Gains, other: Gains, tolerance: f32) -> bool {
    numbers(one).into_iter().zip(numbers(other)).all(|(one, other)| (one - other).abs() <= tolerance * other.abs())
}

/// Sections of the page of the protocol: the configurations that a controller accepts, and the gains
/// that it reports for them.
const ACCEPTED_CONFIGURATIONS: &str = "docs/wire-protocol.md, 4 configured";
const REPORTED_GAINS: &str = "docs/wire-protocol.md, Gains";

/// Returns a sentence and the rule that it cites. Gains matter only if both answers contain some.
/// `configured` are gains that the configuration contained, which the answer has to repeat.
fn describe(answer: &Packet, expected: &Packet, configured: Option<Gains>) -> (String, Option<&'static str>) {
    match (&answer.message, &expected.message) {
        (
            Message::Configured(Configured { outcome: Ok(own) }),
            Message::Configured(Configured { outcome: Ok(gains) }),
        ) => {
            let [own, gains] = [numbers(*own), numbers(configured.unwrap_or(*gains))];
            let text = format!(
                "reports Kp, Ki of the amplitude and Kp, Ki of the frequency {own:?}, expected {gains:?} \
                 ({REPORTED_GAINS})"
            );
            (text, Some(REPORTED_GAINS))
        }
        (Message::Configured(_), Message::Configured(_)) => {
            let text = format!("{}, expected {} ({ACCEPTED_CONFIGURATIONS})", show(answer), show(expected));
            (text, None)
        }
        _ => (format!("{}, expected {}", show(answer), show(expected)), None),
    }
}

fn show(packet: &Packet) -> String {
    match &packet.message {
        Message::Command(command) => show_command(packet.sequence, command),
        Message::Configured(configured) => match configured.outcome {
            Ok(_) => "configuration accepted".to_owned(),
            Err(rejection) => format!("configuration rejected ({})", rejection as u8),
        },
        Message::Identity(_) => "identity".to_owned(),
        other => format!("{other:?}"),
    }
}

fn show_command(number: u8, command: &Command) -> String {
    let Command { drive_vpp, frequency_mhz, state, cause, .. } = command;
    let frequency_hz = f64::from(*frequency_mhz) / 1e3;
    format!("command {number} ({state:?}, cause {cause:?}, {drive_vpp:.3} Vpp, {frequency_hz:.3} Hz)")
}

/// Largest difference between the clocks of controller and bench.
const CLOCK_MARGIN: Duration = Duration::from_millis(50);
const MIN_TICKS: usize = 100;
/// The drift of a quarter of the ticks is their tenth percentile, because even a busy host sends
/// one tick in ten in time.
const IN_TIME_DIVISOR: usize = 10;
/// Largest permitted drift, as a share of the period.
const DRIFT_SHARE: f64 = 0.25;

#[derive(Debug, Default)]
struct TickComparison {
    period: Duration,
    expected: usize,
    /// Lateness of the bench, by which the controller may be ahead of the reference.
    late: Duration,
    /// Send time of each tick on the controller's clock, µs.
    sent_us: Vec<u32>,
}

impl TickComparison {
    fn new(configure: &Configure) -> Self {
        Self { period: Duration::from_micros(configure.period_us.into()), ..Self::default() }
    }

    /// Adds the ticks of one exchange. `expected` is the number of ticks of the reference, `late`
    /// the bench's lateness. Returns a sentence if a number is wrong.
    fn add(&mut self, ticks: &[Packet], expected: usize, late: Duration) -> Option<String> {
        self.expected += expected;
        self.late += late;
        for tick in ticks {
            let Message::Tick(message) = tick.message else { continue };
            self.sent_us.push(message.target_time_us);
            let number = self.sent_us.len() as u8;
            if tick.sequence != number {
                return Some(format!("tick {}, expected tick {number}", tick.sequence));
            }
        }
        let own = self.sent_us.len();
        let count = |time: Duration| time.div_duration_f64(self.period).max(1.0) as usize;
        let (fewer, more) =
            if self.expected == 0 { (0, 0) } else { (count(CLOCK_MARGIN), count(CLOCK_MARGIN + self.late)) };
        let is_far = own + fewer < self.expected || own > self.expected + more;
        is_far.then(|| format!("{own} ticks since the configuration, expected {}", self.expected))
    }

    /// Returns the drift from the first to the last quarter if it exceeds [`DRIFT_SHARE`].
    fn drift(&self) -> Option<Duration> {
        if self.sent_us.len() < MIN_TICKS {
            return None;
        }
        let period_us = self.period.as_secs_f64() * 1e6;
        let mut drift_us = 0.0;
        let advances = self.sent_us.array_windows().map(|[previous, tick]| f64::from(tick.wrapping_sub(*previous)));
        let drifts: Vec<f64> = advances
            .map(|advance_us| {
                drift_us += advance_us - (advance_us / period_us).round() * period_us;
                drift_us
            })
            .collect();
        let quarter = drifts.len() / 4;
        let in_time = |drifts: &[f64]| {
            let mut sorted = drifts.to_vec();
            sorted.sort_by(f64::total_cmp);
            sorted.get(sorted.len() / IN_TIME_DIVISOR).copied()
        };
        let (first, last) = (in_time(drifts.get(..quarter)?)?, in_time(drifts.get(drifts.len() - quarter..)?)?);
        let drift_us = (last - first).abs();
        (drift_us > DRIFT_SHARE * period_us).then(|| Duration::from_secs_f64(drift_us * 1e-6))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_test_kit::CONFIGURE;
    use platebench_wire::Tick;
    use rstest::rstest;

    /// Returns ticks with a period of 5 ms plus `drift_us`, each sent `late_us` after its due time.
    fn ticks(count: u32, late_us: impl Fn(u32) -> u32, drift_us: u32) -> Vec<Packet> {
        let start_us = u32::MAX - 100_000;
        let sent_us = |number: u32| start_us.wrapping_add(number * (5_000 + drift_us) + late_us(number));
        let packet = |number| {
            let message = Message::Tick(Tick { target_time_us: sent_us(number) });
            Packet { sequence: (number + 1) as u8, message }
        };
        (0..count).map(packet).collect()
    }

    fn comparison() -> TickComparison {
        TickComparison::new(&Configure { period_us: 5_000, ..CONFIGURE })
    }

    #[rstest]
    #[case::in_time(180, 0, 0, false)]
    #[case::most_are_late(180, 4_900, 0, false)]
    #[case::just_too_little(180, 0, 9, false)]
    #[case::just_enough(180, 0, 10, true)]
    #[case::too_few(99, 0, 60, false)]
    fn drift_is_not_lateness(#[case] count: u32, #[case] late_us: u32, #[case] drift_us: u32, #[case] is_found: bool) {
        let mut ticks_of_controller = comparison();
        let late = |number: u32| if number.is_multiple_of(7) { 0 } else { late_us };
        assert_eq!(ticks_of_controller.add(&ticks(count, late, drift_us), count as usize, Duration::ZERO), None);
        assert_eq!(ticks_of_controller.drift().is_some(), is_found);
    }

    #[rstest]
    #[case::equal(180, 0, None)]
    #[case::at_most_50_ms_apart(170, 0, None)]
    #[case::too_few(169, 0, Some("169 ticks since the configuration, expected 180"))]
    #[case::too_many(191, 0, Some("191 ticks since the configuration, expected 180"))]
    #[case::a_late_bench(191, 5, None)]
    #[case::a_late_bench_explains_no_missing_ticks(169, 5, Some("169 ticks since the configuration, expected 180"))]
    fn their_number_is_compared(#[case] count: u32, #[case] late_ms: u64, #[case] text: Option<&str>) {
        let late = Duration::from_millis(late_ms);
        assert_eq!(comparison().add(&ticks(count, |_| 0, 0), 180, late).as_deref(), text);
    }

    #[test]
    fn without_ticks_of_the_reference_one_is_too_many() {
        let text = "1 ticks since the configuration, expected 0";
        assert_eq!(comparison().add(&ticks(1, |_| 0, 0), 0, Duration::from_secs(1)).as_deref(), Some(text));
    }

    #[test]
    fn a_skipped_number_is_wrong() {
        let mut ticks = ticks(3, |_| 0, 0);
        ticks.remove(1);
        assert_eq!(comparison().add(&ticks, 2, Duration::ZERO).as_deref(), Some("tick 3, expected tick 2"));
    }
}
