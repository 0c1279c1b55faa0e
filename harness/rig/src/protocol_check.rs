//! Checks the rules of the protocol that no plate shows: plays scripts of messages and compares each answer with that of
//! the hosted reference (docs/wire-protocol.md).

mod builder;
mod scripts;

use crate::hosted::HostedLink;
use crate::link::{Link, LinkError};
use builder::{Script, Variation};
use platebench_wire::{
    Command, Configure, ControllerState, Gains, Identity, Message, Packet, PacketReader, StateCause,
};
use std::thread;
use std::time::{Duration, Instant};

/// Further references, and the share of the tolerance by which their commands may differ. If they differ more, no command
/// is compared until the next configuration: rounding decides, or a design that is 5 % off.
const VARIATIONS: [(Variation, f64); 3] = [
    (Variation { components: 1.0 + 2e-6, gain: 1.0 }, 0.05),
    (Variation { components: 1.0, gain: 1.05 }, 0.5),
    (Variation { components: 1.0, gain: 0.95 }, 0.5),
];
/// Relative difference of reported gains.
const GAIN_TOLERANCE: f32 = 1e-5;
/// A script with a lost answer or a stall of the host is played again.
const ATTEMPTS: usize = 3;
/// Longest time of an exchange beyond its wait; later the controller's watchdog may act.
const STALL: Duration = Duration::from_millis(80);

/// Plays every script on `link`, which stays in any state without a drive or with another configuration; samples have no
/// plate. `base` gives law, watchdog timeout and plate. `own_clock` is true if the controller's clock runs while the
/// bench waits. Returns one sentence per script whose answers differ from the reference.
/// Fails if the link is lost.
pub fn protocol_differences(
    link: &mut dyn Link,
    identity: &Identity,
    base: &Configure,
    own_clock: bool,
) -> Result<Vec<String>, LinkError> {
    if !link.restart()? {
        link.continue_trial();
    }
    let base = Configure { paced_by_target: false, drives_own_plate: false, loop_delay_us: 0, gains: None, ..*base };
    let period = Duration::from_micros(base.period_us.into());
    let mut player = Player { link, identity, period, own_clock, now: Duration::ZERO };
    let mut differences = Vec::new();
    let varied = VARIATIONS.map(|(variation, _)| scripts::scripts(&base, identity, variation));
    for (position, script) in scripts::scripts(&base, identity, Variation::NONE).iter().enumerate() {
        let varied: Vec<_> = varied.iter().filter_map(|scripts| scripts.get(position)).collect();
        let mut difference = None;
        for _ in 0..ATTEMPTS {
            difference = player.play(script, &varied)?;
            if difference.as_ref().is_none_or(|difference| difference.doubt.is_none()) {
                break;
            }
        }
        // Without a stall the silence is the controller's.
        let is_certain = |difference: &Difference| difference.doubt != Some(Doubt::Stall);
        let difference = difference.filter(is_certain);
        differences.extend(difference.map(|difference| format!("{}: {}", script.name, difference.text)));
    }
    Ok(differences)
}

struct Difference {
    text: String,
    doubt: Option<Doubt>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Doubt {
    /// The line may have lost an answer.
    NoAnswer,
    /// The host was late.
    Stall,
}

struct Player<'a> {
    link: &'a mut dyn Link,
    identity: &'a Identity,
    period: Duration,
    own_clock: bool,
    now: Duration,
}

impl Player<'_> {
    fn play(&mut self, script: &Script, varied: &[&Script]) -> Result<Option<Difference>, LinkError> {
        let scripts: Vec<_> = [script].into_iter().chain(varied.iter().copied()).collect();
        let mut references = vec![HostedLink::new(); scripts.len()];
        let mut comparison = Comparison::new(self.identity, script.tolerance);
        let (mut since_start, mut is_stalled) = (Duration::ZERO, false);
        for (number, exchange) in script.exchanges.iter().enumerate() {
            let began = Instant::now();
            let mut answer = Vec::new();
            let mut expected = vec![Vec::new(); scripts.len()];
            self.now += exchange.wait;
            since_start += exchange.wait;
            if !exchange.wait.is_zero() {
                if self.own_clock {
                    thread::sleep(exchange.wait);
                }
                self.link.advance_to(self.now, &mut answer)?;
                for (reference, expected) in references.iter_mut().zip(&mut expected) {
                    reference.advance_to(since_start, expected)?;
                }
            }
            self.now += self.period;
            since_start += self.period;
            self.link.exchange(self.now, &exchange.bytes, &mut answer)?;
            let requests = scripts.iter().filter_map(|script| script.exchanges.get(number));
            for ((reference, request), expected) in references.iter_mut().zip(requests).zip(&mut expected) {
                reference.exchange(since_start, &request.bytes, expected)?;
            }
            is_stalled |= self.own_clock && began.elapsed() > exchange.wait + STALL;
            let number_of_request = comparison.observe_requests(&exchange.bytes);
            let expected: Vec<_> = expected.iter().map(|bytes| answers(bytes, number_of_request)).collect();
            let compared = comparison.compare(&answers(&answer, number_of_request), &expected);
            if let Err(Difference { text, doubt }) = compared {
                let doubt = if is_stalled { Some(Doubt::Stall) } else { doubt };
                return Ok(Some(Difference { text: format!("exchange {}: {text}", number + 1), doubt }));
            }
        }
        Ok(None)
    }
}

/// Without the report of the watchdog: a controller that receives a sample first reports the stop in its answer.
fn answers(bytes: &[u8], request: u8) -> Vec<Packet> {
    let is_report = |packet: &Packet| {
        matches!(packet.message, Message::Command(command) if command.cause == StateCause::SampleTimeout)
            && packet.sequence != request
    };
    packets(bytes).into_iter().filter(|packet| !is_report(packet)).collect()
}

fn packets(bytes: &[u8]) -> Vec<Packet> {
    PacketReader::new().packets(bytes).flatten().collect()
}

struct Comparison<'a> {
    identity: &'a Identity,
    tolerance: f64,
    configuration: Option<Configure>,
    /// Frequency of the last running command of target and reference, mHz.
    last_mhz: Option<[u32; 2]>,
    /// True if a variation of the reference differs.
    is_doubtful: bool,
}

impl<'a> Comparison<'a> {
    fn new(identity: &'a Identity, tolerance: f64) -> Self {
        Self { identity, tolerance, configuration: None, last_mhz: None, is_doubtful: false }
    }

    /// Returns the number of the last request.
    fn observe_requests(&mut self, bytes: &[u8]) -> u8 {
        let requests = packets(bytes);
        let last = requests.last().map_or(0, |packet| packet.sequence);
        for packet in requests {
            if let Message::Configure(configure) = packet.message {
                (self.configuration, self.is_doubtful) = (Some(configure), false);
            }
        }
        last
    }

    /// `expected`: the answers of the reference, then those of its variations.
    fn compare(&mut self, answers: &[Packet], expected: &[Vec<Packet>]) -> Result<(), Difference> {
        let Some((expected, varied)) = expected.split_first() else { return Ok(()) };
        let differs = |text: String| Err(Difference { text, doubt: None });
        for (position, expected) in expected.iter().enumerate() {
            let Some(answer) = answers.get(position) else {
                let text = format!("no answer, expected {}", show(expected));
                return Err(Difference { text, doubt: Some(Doubt::NoAnswer) });
            };
            for (other, (_, share)) in varied.iter().zip(VARIATIONS) {
                self.is_doubtful |= other.get(position).is_none_or(|other| self.is_far(expected, other, share));
            }
            if !self.is_equal(answer, expected) {
                return differs(format!("{}, expected {}", show(answer), show(expected)));
            }
            if let (Message::Command(answer), Message::Command(expected)) = (&answer.message, &expected.message)
                && expected.state == ControllerState::Running
            {
                self.last_mhz = Some([answer.frequency_mhz, expected.frequency_mhz]);
            }
        }
        match answers.get(expected.len()) {
            Some(answer) => differs(format!("{}, expected no further message", show(answer))),
            None => Ok(()),
        }
    }

    fn is_far(&self, expected: &Packet, other: &Packet, share: f64) -> bool {
        match (&expected.message, &other.message) {
            (Message::Command(expected), Message::Command(other)) => {
                expected.state != other.state || self.distance(expected, other) > self.tolerance * share
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
                        (Ok(answer), Ok(expected)) => {
                            let is_close =
                                |(one, other): (f32, f32)| (one - other).abs() <= GAIN_TOLERANCE * other.abs();
                            let numbers = |gains: Gains| {
                                [gains.amplitude_kp, gains.amplitude_ki, gains.frequency_kp, gains.frequency_ki]
                            };
                            // The design is the law's own.
                            self.configuration.is_none_or(|configuration| configuration.gains.is_none())
                                || numbers(answer).into_iter().zip(numbers(expected)).all(is_close)
                        }
                        _ => false,
                    }
                }
                (Message::Command(answer), Message::Command(expected)) => self.is_equal_command(answer, expected),
                _ => false,
            }
    }

    fn is_equal_command(&self, answer: &Command, expected: &Command) -> bool {
        if (answer.state, answer.cause) != (expected.state, expected.cause) {
            return self.is_doubtful && expected.state == ControllerState::Running;
        }
        if expected.state == ControllerState::Running {
            return self.is_doubtful || self.distance(answer, expected) <= self.tolerance;
        }
        let expected_mhz = match self.last_mhz {
            // The last one is that of the controller itself.
            Some([own, reference]) if expected.frequency_mhz == reference => own,
            _ => expected.frequency_mhz,
        };
        answer.drive_vpp == 0.0 && answer.frequency_mhz == expected_mhz
    }

    /// The larger one of drive relative to its limit and frequency relative to its range.
    fn distance(&self, one: &Command, other: &Command) -> f64 {
        let Some(configuration) = self.configuration else { return 0.0 };
        let drive = f64::from(one.drive_vpp - other.drive_vpp).abs() / f64::from(configuration.drive_limit_vpp);
        let frequency_hz = f64::from(one.frequency_mhz.abs_diff(other.frequency_mhz)) * 1e-3;
        let frequency = frequency_hz / f64::from(configuration.frequency_range_hz);
        if drive.is_finite() { drive.max(frequency) } else { f64::INFINITY }
    }
}

fn show(packet: &Packet) -> String {
    match &packet.message {
        Message::Command(Command { drive_vpp, frequency_mhz, state, cause, .. }) => {
            let frequency_hz = f64::from(*frequency_mhz) / 1e3;
            let number = packet.sequence;
            format!("command {number} ({state:?}, cause {cause:?}, {drive_vpp:.3} Vpp, {frequency_hz:.3} Hz)")
        }
        Message::Configured(configured) => match configured.outcome {
            Ok(gains) => format!("accepted with {gains:?}"),
            Err(rejection) => format!("rejected as {rejection:?}"),
        },
        Message::Identity(_) => "identity".to_owned(),
        other => format!("{other:?}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::Session;
    use platebench_test_kit::CONFIGURE;
    use rstest::rstest;

    /// Changes the answers of the reference, or loses them.
    struct Changed<F> {
        device: HostedLink,
        exchanges: usize,
        change: F,
    }

    impl<F: FnMut(usize, &mut Vec<Packet>) + Send> Link for Changed<F> {
        fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
            let mut own = Vec::new();
            self.device.exchange(now, bytes, &mut own)?;
            self.exchanges += 1;
            let mut packets = packets(&own);
            (self.change)(self.exchanges, &mut packets);
            for packet in packets {
                answer.extend_from_slice(packet.encode().as_bytes());
            }
            Ok(Duration::ZERO)
        }

        fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
            self.device.advance_to(now, received)
        }
    }

    fn differences(change: impl FnMut(usize, &mut Vec<Packet>) + Send) -> Vec<String> {
        let identity = *Session::open(HostedLink::new()).unwrap().identity();
        let mut link = Changed { device: HostedLink::new(), exchanges: 0, change };
        protocol_differences(&mut link, &identity, &CONFIGURE, false).unwrap()
    }

    fn scale_drive(packets: &mut [Packet], factor: f32) {
        for packet in packets {
            if let Message::Command(command) = &mut packet.message {
                command.drive_vpp *= factor;
            }
        }
    }

    #[rstest]
    #[case::same(1.0, false)]
    #[case::just_inside(0.9951, false)]
    #[case::just_outside(0.994, true)]
    fn a_drive_may_differ_by_half_a_percent_of_its_limit(#[case] factor: f32, #[case] differs: bool) {
        let found = differences(|_, packets| scale_drive(packets, factor));
        assert_eq!(!found.is_empty(), differs, "{found:?}");
    }

    #[test]
    fn one_lost_answer_is_the_lines() {
        assert_eq!(differences(|number, packets| packets.retain(|_| number != 7)), Vec::<String>::new());
    }

    #[test]
    fn an_answer_that_never_comes_is_the_controllers() {
        let is_fault = |packet: &Packet| matches!(packet.message, Message::Command(command) if command.cause == StateCause::NonFinite);
        let found = differences(|_, packets| packets.retain(|packet| !is_fault(packet)));
        assert!(found.iter().any(|text| text.contains("no answer, expected command")), "{found:?}");
    }

    #[test]
    fn a_second_answer_differs() {
        let found = differences(|number, packets| {
            if number == 3 {
                packets.extend_from_within(..);
            }
        });
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(found[0].ends_with("expected no further message"), "{found:?}");
    }

    #[test]
    fn a_stopped_controller_keeps_its_frequency() {
        let found = differences(|_, packets| {
            for packet in packets {
                if let Message::Command(command) = &mut packet.message
                    && command.state == ControllerState::Fault
                {
                    command.frequency_mhz += 1;
                }
            }
        });
        assert!(!found.is_empty());
    }
}
