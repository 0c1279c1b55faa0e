//! Counts which rules and thresholds of the protocol a sequence of messages exercises, by the
//! answers of the hosted reference.

use super::comparison::packets;
use super::script::ScriptVariation;
use super::{message_script, script_base, silence_step};
use crate::link::{Link, LinkError};
use crate::rigs::hosted::HostedLink;
use platebench_model::scenario::ScenarioMessage;
use platebench_wire::{Configure, ControllerState, Message, Packet, PacketReader, StateCause};
use std::collections::BTreeMap;
use std::time::Duration;
use strum::VariantArray;

/// A message that the rules of a state apply to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, VariantArray, strum::IntoStaticStr)]
#[strum(const_into_str)]
enum Event {
    #[strum(serialize = "hello")]
    Hello,
    #[strum(serialize = "safe")]
    Safe,
    #[strum(serialize = "an accepted configuration")]
    Accepted,
    #[strum(serialize = "an unusable configuration")]
    Unusable,
    #[strum(serialize = "a sample")]
    Sample,
    #[strum(serialize = "a repeated sample")]
    Repeated,
    #[strum(serialize = "a sample that is not finite")]
    NotFinite,
    #[strum(serialize = "a rejected frame")]
    Rejected,
    #[strum(serialize = "an ignored message")]
    Ignored,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, VariantArray, strum::IntoStaticStr)]
#[strum(const_into_str)]
enum State {
    #[strum(serialize = "idle without a design")]
    Idle,
    #[strum(serialize = "idle with a design")]
    Configured,
    #[strum(serialize = "running")]
    Running,
    #[strum(serialize = "fault after a timeout")]
    TimedOut,
    #[strum(serialize = "fault after rejected frames")]
    Noise,
    #[strum(serialize = "fault after a value that is not finite")]
    NotFinite,
    #[strum(serialize = "safe")]
    Safe,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, VariantArray, strum::IntoStaticStr)]
#[strum(const_into_str)]
enum Threshold {
    #[strum(serialize = "rejected frames just below the stop (score 8 or 9)")]
    BelowNoiseStop,
    #[strum(serialize = "rejected frames that stop (score 10)")]
    NoiseStop,
    #[strum(serialize = "a silence of more than a third of the timeout without a stop")]
    BelowTimeout,
    #[strum(serialize = "a silence longer than the timeout after the first sample")]
    TimeoutAfterFirst,
    #[strum(serialize = "a silence longer than the timeout after more samples")]
    Timeout,
    #[strum(serialize = "a silence longer than the timeout before the first sample")]
    IdleSilence,
    #[strum(serialize = "the default watchdog timeout")]
    DefaultTimeout,
    #[strum(serialize = "a watchdog timeout of more than 15 bits")]
    LongTimeout,
    #[strum(serialize = "a loop delay below a tenth of the period")]
    ShortDelay,
    #[strum(serialize = "a loop delay of one period")]
    LongestDelay,
    #[strum(serialize = "256 samples of a trial")]
    Samples8,
    #[strum(serialize = "65,536 samples of a trial")]
    Samples16,
    #[strum(serialize = "100,000 samples of a trial")]
    Samples100k,
    #[strum(serialize = "256 rejected frames")]
    Rejected8,
    #[strum(serialize = "256 configurations")]
    Configurations8,
    #[strum(serialize = "1000 configurations")]
    Configurations1000,
}

/// How often each rule and threshold was exercised.
#[derive(Debug, Clone, Default)]
pub struct ProtocolCoverage {
    rules: BTreeMap<(Event, State), u64>,
    thresholds: BTreeMap<Threshold, u64>,
}

impl ProtocolCoverage {
    /// Plays `messages` on the reference. `base` is the configuration of the trial.
    pub fn add(&mut self, messages: &[ScenarioMessage], base: &Configure) -> Result<(), LinkError> {
        let base = script_base(base);
        let period = Duration::from_micros(base.period_us.into());
        let mut observer = Observer::new(self);
        for exchange in message_script(messages, base).exchanges(ScriptVariation::NONE) {
            observer.advance(exchange.wait.max(period))?;
            for byte in exchange.bytes {
                observer.add_byte(byte)?;
            }
        }
        Ok(())
    }

    /// Name and count of every rule and threshold, the rules first.
    pub fn counts(&self) -> Vec<(String, u64)> {
        // No sample is repeated in *idle*, because a configuration forgets the number, except by a
        // sample that was answered there.
        let rules = State::VARIANTS.iter().flat_map(|state| Event::VARIANTS.iter().map(move |event| (*event, *state)));
        let is_possible =
            |(event, state): &(Event, State)| !matches!((event, state), (Event::Repeated, State::Configured));
        let name = |(event, state): (Event, State)| -> String {
            let [event, state]: [&str; 2] = [event.into_str(), state.into_str()];
            format!("{event} in {state}")
        };
        let count = |rule: &(Event, State)| self.rules.get(rule).copied().unwrap_or(0);
        let rules = rules.filter(is_possible).map(|rule| (name(rule), count(&rule)));
        let thresholds = Threshold::VARIANTS
            .iter()
            .map(|threshold| (threshold.into_str().to_owned(), self.thresholds.get(threshold).copied().unwrap_or(0)));
        rules.chain(thresholds).collect()
    }
}

struct Observer<'a> {
    coverage: &'a mut ProtocolCoverage,
    reference: HostedLink,
    now: Duration,
    frame: Vec<u8>,
    state: State,
    timeout: Duration,
    /// Instant of the configuration or of the last sample with a control step.
    since: Duration,
    last_number: Option<u8>,
    score: u32,
    samples: u64,
    rejected: u64,
    configurations: u64,
}

impl<'a> Observer<'a> {
    fn new(coverage: &'a mut ProtocolCoverage) -> Self {
        Self {
            coverage,
            reference: HostedLink::new(),
            now: Duration::ZERO,
            frame: Vec::new(),
            state: State::Idle,
            timeout: Duration::ZERO,
            since: Duration::ZERO,
            last_number: None,
            score: 0,
            samples: 0,
            rejected: 0,
            configurations: 0,
        }
    }

    fn cross(&mut self, threshold: Threshold) {
        *self.coverage.thresholds.entry(threshold).or_default() += 1;
    }

    fn advance(&mut self, mut rest: Duration) -> Result<(), LinkError> {
        let mut received = Vec::new();
        let longest_step = silence_step(rest);
        while !rest.is_zero() {
            let step = rest.min(longest_step);
            rest -= step;
            self.now += step;
            self.reference.advance_to(self.now, &mut received)?;
        }
        self.observe_answers(&received);
        Ok(())
    }

    fn add_byte(&mut self, byte: u8) -> Result<(), LinkError> {
        self.frame.push(byte);
        if byte != 0 {
            return Ok(());
        }
        let frame = std::mem::take(&mut self.frame);
        let before = self.state;
        let mut answer = Vec::new();
        self.reference.exchange(self.now, &frame, &mut answer)?;
        let event = match PacketReader::new().packets(&frame).next() {
            None => return Ok(()),
            Some(Err(_)) => Event::Rejected,
            Some(Ok(packet)) => self.event(&packet, &answer),
        };
        *self.coverage.rules.entry((event, before)).or_default() += 1;
        if event == Event::Rejected {
            self.rejected += 1;
            self.score += if before == State::Running { 2 } else { 0 };
            match self.score {
                8 | 9 => self.cross(Threshold::BelowNoiseStop),
                10.. if before == State::Running => self.cross(Threshold::NoiseStop),
                _ => {}
            }
            if self.rejected == 256 {
                self.cross(Threshold::Rejected8);
            }
        }
        self.observe_answers(&answer);
        if event == Event::Sample && self.state == State::Running {
            self.observe_step();
        }
        Ok(())
    }

    fn event(&mut self, packet: &Packet, answer: &[u8]) -> Event {
        match &packet.message {
            Message::Hello => Event::Hello,
            Message::Safe => Event::Safe,
            Message::Configure(configure) => {
                self.last_number = None;
                let is_accepted = packets(answer).iter().any(
                    |answer| matches!(answer.message, Message::Configured(configured) if configured.outcome.is_ok()),
                );
                if is_accepted { self.accept(configure) } else { Event::Unusable }
            }
            Message::Sample(sample) => {
                if self.last_number.replace(packet.sequence) == Some(packet.sequence) {
                    return Event::Repeated;
                }
                self.observe_silence();
                let values = [sample.setpoint_um, sample.wd_um, sample.wq_um];
                if values.into_iter().all(f32::is_finite) { Event::Sample } else { Event::NotFinite }
            }
            _ => Event::Ignored,
        }
    }

    fn accept(&mut self, configure: &Configure) -> Event {
        self.timeout = match configure.watchdog_timeout_ms {
            0 => Duration::from_micros(5 * u64::from(configure.period_us)),
            timeout_ms => Duration::from_millis(timeout_ms.into()),
        };
        (self.since, self.samples, self.score) = (self.now, 0, 0);
        self.configurations += 1;
        match self.configurations {
            256 => self.cross(Threshold::Configurations8),
            1_000 => self.cross(Threshold::Configurations1000),
            _ => {}
        }
        match configure.watchdog_timeout_ms {
            0 => self.cross(Threshold::DefaultTimeout),
            0x8000.. => self.cross(Threshold::LongTimeout),
            _ => {}
        }
        match configure.loop_delay_us {
            0 => {}
            delay if delay == configure.period_us => self.cross(Threshold::LongestDelay),
            delay if delay < configure.period_us / 10 => self.cross(Threshold::ShortDelay),
            _ => {}
        }
        Event::Accepted
    }

    /// Observes the silence before a sample.
    fn observe_silence(&mut self) {
        let silence = self.now.saturating_sub(self.since);
        let is_long = silence >= self.timeout;
        match self.state {
            State::Configured if is_long => self.cross(Threshold::IdleSilence),
            State::Running if !is_long && silence > self.timeout / 3 => self.cross(Threshold::BelowTimeout),
            State::TimedOut if self.samples == 1 => self.cross(Threshold::TimeoutAfterFirst),
            State::TimedOut if self.samples > 1 => self.cross(Threshold::Timeout),
            _ => {}
        }
    }

    fn observe_answers(&mut self, bytes: &[u8]) {
        for packet in packets(bytes) {
            match packet.message {
                Message::Configured(configured) => {
                    self.state = if configured.outcome.is_ok() { State::Configured } else { State::Idle };
                }
                Message::Command(command) => {
                    self.state = match (command.state, command.cause) {
                        (ControllerState::Running, _) => State::Running,
                        (ControllerState::Safe, _) => State::Safe,
                        (ControllerState::Fault, StateCause::SampleTimeout) => State::TimedOut,
                        (ControllerState::Fault, StateCause::LineNoise) => State::Noise,
                        (ControllerState::Fault, _) => State::NotFinite,
                        (ControllerState::Idle, _) => self.state,
                    };
                }
                _ => {}
            }
        }
    }

    fn observe_step(&mut self) {
        self.since = self.now;
        self.score = self.score.saturating_sub(1);
        self.samples += 1;
        match self.samples {
            256 => self.cross(Threshold::Samples8),
            65_536 => self.cross(Threshold::Samples16),
            100_000 => self.cross(Threshold::Samples100k),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_model::scenario::ConfigurationChange;
    use platebench_test_kit::CONFIGURE;

    #[test]
    fn counts_rules_by_message_and_state() {
        let mut coverage = ProtocolCoverage::default();
        let damaged = ScenarioMessage::Damaged { byte: 5 };
        let mut messages = vec![
            ScenarioMessage::Configure(ConfigurationChange { watchdog_timeout_ms: Some(100), ..Default::default() }),
            ScenarioMessage::sample(2.0, 1.2, -0.2),
            ScenarioMessage::Wait { ms: 120.0 },
            ScenarioMessage::sample(2.0, 1.2, -0.2),
            ScenarioMessage::Configure(ConfigurationChange::default()),
            ScenarioMessage::sample(2.0, 1.2, -0.2),
        ];
        messages.extend(vec![damaged; 5]);
        messages.push(ScenarioMessage::Safe {});
        coverage.add(&messages, &CONFIGURE).unwrap();
        let counts = coverage.counts();
        let count = |name: &str| counts.iter().find(|(rule, _)| rule == name).unwrap().1;
        assert_eq!(count("a sample in idle with a design"), 2);
        assert_eq!(count("a sample in fault after a timeout"), 1);
        assert_eq!(count("a silence longer than the timeout after the first sample"), 1);
        assert_eq!(count("a rejected frame in running"), 5);
        assert_eq!(count("rejected frames that stop (score 10)"), 1);
        assert_eq!(count("safe in fault after rejected frames"), 1);
        assert_eq!(count("hello in running"), 0);
    }
}
