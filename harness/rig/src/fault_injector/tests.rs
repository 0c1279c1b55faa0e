//! Tests every kind of fault on a hosted device, with a log of the bytes that reach it.

use super::*;
use crate::link::{Link, LinkError, RealTimeLine};
use crate::rigs::hosted::HostedLink;
use crate::session::Session;
use platebench_model::scenario::{FaultKind, Time};
use platebench_test_kit::CONFIGURE;
use platebench_wire::{Command, ControllerState, Message, Packet, Sample, StateCause};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

const ALWAYS: Fault = Fault {
    kind: FaultKind::Drop,
    from: Time::ZERO,
    until: None,
    direction: Direction::Both,
    every: 1,
    seed: None,
    reconfigure: false,
};

/// Seed of the trial.
const SEED: u64 = 1;

/// Time and bytes of each call. The bytes are empty if only time advances.
type Log = Arc<Mutex<Vec<(Duration, Vec<u8>)>>>;

struct LoggedDevice {
    device: HostedLink,
    log: Log,
    waiting: Vec<u8>,
    /// Time of the simulated clock. Only a wait without an answer advances it.
    now: Instant,
}

impl Link for LoggedDevice {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.log.lock().unwrap().push((now, bytes.to_vec()));
        self.device.exchange(now, bytes, answer)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.log.lock().unwrap().push((now, Vec::new()));
        self.device.advance_to(now, received)
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        Some(self)
    }
}

impl RealTimeLine for LoggedDevice {
    fn now(&mut self) -> Instant {
        self.now
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        let mut waiting = std::mem::take(&mut self.waiting);
        self.exchange(Duration::ZERO, bytes, &mut waiting)?;
        self.waiting = waiting;
        Ok(())
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        if self.waiting.is_empty() {
            self.now = until.max(self.now + us(1));
            return Ok(None);
        }
        let piece = self.waiting.len().min(7);
        bytes.extend(self.waiting.drain(..piece));
        Ok(Some(self.now))
    }
}

const fn at(time: Duration) -> Time {
    Time::from_nanos(time.as_nanos() as u64)
}

const fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

const fn us(us: u64) -> Duration {
    Duration::from_micros(us)
}

fn sample(wd_um: f32) -> Sample {
    Sample { time_us: 0, setpoint_um: 2.0, wd_um, wq_um: wd_um / 8.0 }
}

fn frame(sequence: u8, wd_um: f32) -> Vec<u8> {
    Packet { sequence, message: Message::Sample(sample(wd_um)) }.encode().as_bytes().to_vec()
}

struct Fixture {
    session: Session<FaultInjector<LoggedDevice>>,
    log: Log,
}

fn trial_with(faults: &[Fault]) -> Fixture {
    let log = Log::default();
    let device = LoggedDevice { device: HostedLink::new(), log: log.clone(), waiting: Vec::new(), now: Instant::now() };
    let mut session = Session::open(FaultInjector::new(device)).unwrap();
    session.link_mut().set_faults(faults, SEED);
    session.start_trial(&CONFIGURE).unwrap();
    log.lock().unwrap().clear();
    Fixture { session, log }
}

impl Fixture {
    fn sample(&mut self, now: Duration, wd_um: f32) -> Option<Command> {
        self.session.send_sample(now, &sample(wd_um)).unwrap().map(|reply| reply.command)
    }

    fn advance(&mut self, now: Duration) -> Option<Command> {
        self.session.advance_to(now).unwrap()
    }

    fn delivered(&self) -> Vec<(Duration, Vec<u8>)> {
        self.log.lock().unwrap().iter().filter(|(_, bytes)| !bytes.is_empty()).cloned().collect()
    }

    fn counts(&self) -> Vec<(&'static str, u64)> {
        self.session.link().fault_counts().collect()
    }
}

fn decode_sample(bytes: &[u8]) -> Sample {
    match decode_first_packet(bytes).unwrap().message {
        Message::Sample(sample) => sample,
        other => panic!("{other:?}"),
    }
}

#[test]
fn passes_everything_unchanged_without_faults() {
    let mut fixture = trial_with(&[]);
    assert!(fixture.sample(ms(0), 0.5).is_some());
    assert_eq!(fixture.delivered(), [(ms(0), frame(3, 0.5))]);
    assert_eq!((fixture.session.link().delivered_sample(), fixture.session.link().next_due()), (None, None));
}

#[test]
fn affects_every_nth_message_of_a_half_open_window() {
    let drop =
        Fault { from: at(ms(2)), until: Some(at(ms(6))), every: 2, direction: Direction::ToController, ..ALWAYS };
    let mut fixture = trial_with(&[drop]);
    let answered: Vec<_> = (0..9).filter(|at| fixture.sample(ms(*at), 1.0).is_some()).collect();
    assert_eq!(answered, [0, 1, 2, 4, 6, 7, 8]);
    assert_eq!(fixture.counts(), [("drop", 2)]);

    let edges = Fault { from: at(us(2_000)), until: Some(at(us(4_000))), ..ALWAYS };
    for (at, passes) in [(us(1_999), true), (us(2_000), false), (us(3_999), false), (us(4_000), true)] {
        let mut fixture = trial_with(&[edges]);
        assert_eq!(fixture.sample(at, 1.0).is_some(), passes, "{at:?}");
    }
    let never = Fault { every: 0, ..ALWAYS };
    assert!(trial_with(&[never]).sample(ms(0), 1.0).is_some());
}

#[test]
fn counts_both_directions_separately() {
    let mut fixture = trial_with(&[Fault { every: 3, ..ALWAYS }]);
    let answered: Vec<_> = (0..9).filter(|at| fixture.sample(ms(*at), 1.0).is_some()).collect();
    // Lost: samples 2, 5 and 8, and the third and sixth command.
    assert_eq!(answered, [0, 1, 4, 6]);
    assert_eq!(fixture.delivered().len(), 6);
    assert_eq!(fixture.counts(), [("drop", 5)]);
}

#[test]
fn advances_the_target_when_a_sample_is_lost() {
    let drop = Fault { from: at(ms(1)), direction: Direction::ToController, ..ALWAYS };
    let mut fixture = trial_with(&[drop]);
    fixture.sample(ms(0), 1.0).unwrap();
    for at in 1..5 {
        assert_eq!((fixture.sample(ms(at), 1.0), fixture.advance(ms(at))), (None, None));
    }
    assert_eq!(fixture.sample(ms(5), 1.0), None);
    let stop = fixture.advance(ms(5)).unwrap();
    assert_eq!((stop.state, stop.cause, stop.drive_vpp), (ControllerState::Fault, StateCause::SampleTimeout, 0.0));
    assert!(!fixture.session.last_sample_answered());
    assert_eq!(fixture.advance(ms(6)), None, "once only");

    // A disconnected line does not deliver the watchdog's report of the stop.
    let mut dead = trial_with(&[Fault { from: at(ms(1)), kind: FaultKind::Disconnect, ..ALWAYS }]);
    dead.sample(ms(0), 1.0).unwrap();
    assert!((1..30).all(|at| dead.sample(ms(at), 1.0).is_none() && dead.advance(ms(at)).is_none()));
}

#[test]
fn passes_handshake_configuration_and_safe() {
    let kinds = [FaultKind::Drop, FaultKind::Disconnect, FaultKind::Truncate, FaultKind::Delay(at(ms(1)))];
    let ways = [Direction::ToController, Direction::FromController];
    for (kind, direction) in kinds.into_iter().flat_map(|kind| ways.map(|way| (kind, way))) {
        let mut fixture = trial_with(&[Fault { kind, direction, ..ALWAYS }]);
        assert_eq!(fixture.sample(ms(0), 1.0), None);
        assert!(fixture.session.reconfigure(ms(1), &CONFIGURE).is_ok(), "{kind:?}");
        assert_eq!(fixture.sample(ms(1), 1.0), None);
        assert!(fixture.session.request_safe_state(), "{kind:?}");
        assert_eq!(fixture.session.link().next_due(), None, "messages in flight are discarded");
    }
}

#[test]
fn flips_one_bit_by_the_seed() {
    let flipped = |seed| {
        let flip =
            Fault { kind: FaultKind::Flip, seed: Some(seed), direction: Direction::ToController, every: 2, ..ALWAYS };
        let mut fixture = trial_with(&[flip]);
        let answers = [0, 1, 2].map(|at| fixture.sample(ms(at), 1.0).is_some());
        let delivered = fixture.delivered();
        assert_eq!((delivered.len(), answers[0], answers[1]), (3, true, false));
        let (sent, flipped) = (frame(4, 1.0), &delivered[1].1);
        let bits = sent.iter().zip(flipped).map(|(a, b)| (a ^ b).count_ones()).sum::<u32>();
        assert_eq!((bits, flipped.len()), (1, sent.len()));
        flipped.clone()
    };
    assert_eq!(flipped(1), flipped(1));
    assert!((2..12).any(|seed| flipped(seed) != flipped(1)));
    // The flipped bit may belong to the delimiter.
    assert!((0..400).any(|seed| flipped(seed).last() != Some(&0)));
}

/// With the seed of `scenarios/faults/flipped-bit.toml`, a controller that ignores the CRC receives
/// a huge Wd.
#[test]
fn flips_the_highest_exponent_bit_in_the_scenario() {
    let flip = Fault { kind: FaultKind::Flip, seed: Some(SCENARIO_SEED), ..ALWAYS };
    let mut fixture = trial_with(&[flip]);
    fixture.sample(ms(0), 1.0);
    let (sent, flipped) = (frame(3, 1.0), fixture.delivered()[0].1.clone());
    // Wd is bytes 11 to 14, after COBS byte, version and kind, number, time and setpoint.
    let changed: Vec<_> = (0..sent.len()).filter(|at| sent[*at] != flipped[*at]).collect();
    assert_eq!((changed, sent[14] ^ flipped[14]), (vec![14], 0x40));
}

const SCENARIO_SEED: u64 = 22;

#[test]
fn controls_once_with_a_duplicated_sample() {
    let duplicate = Fault { kind: FaultKind::Duplicate, ..ALWAYS };
    let (mut duplicated, mut single) = (trial_with(&[duplicate]), trial_with(&[]));
    for at in 0..20 {
        let wd = 0.1 * at as f32;
        assert_eq!(duplicated.sample(ms(at), wd), single.sample(ms(at), wd), "at {at} ms");
    }
    assert_eq!(duplicated.delivered()[0].1, [frame(3, 0.0), frame(3, 0.0)].concat());
    assert_eq!(duplicated.counts(), [("duplicate", 20 + 2 * 20)]);
}

#[test]
fn delivers_a_delayed_sample_when_due() {
    let delay = Fault { kind: FaultKind::Delay(at(us(1_500))), direction: Direction::ToController, ..ALWAYS };
    let mut fixture = trial_with(&[Fault { until: Some(at(ms(1))), ..delay }]);
    assert_eq!(fixture.sample(ms(0), 0.5), None);
    assert_eq!(
        (fixture.session.link().next_due(), fixture.session.link().delivered_sample()),
        (Some(us(1_500)), Some([0.0; 2]))
    );
    // The next sample is not delayed itself, but waits, because the line keeps the order.
    assert_eq!(fixture.sample(ms(1), 0.75), None);
    assert_eq!(fixture.advance(us(1_499)), None);
    assert!(fixture.delivered().is_empty());
    let late = fixture.advance(us(1_500)).unwrap();
    assert_eq!(fixture.delivered(), [(us(1_500), frame(3, 0.5)), (us(1_500), frame(4, 0.75))]);
    assert_eq!((late.state, fixture.session.last_sample_answered()), (ControllerState::Running, true));
    assert_eq!(fixture.session.link().delivered_sample(), Some([0.75, 0.75 / 8.0]));
    assert!(fixture.sample(ms(2), 1.0).is_some());
}

#[test]
fn delivers_a_delayed_command_when_due() {
    let delay = Fault { kind: FaultKind::Delay(at(us(500))), direction: Direction::FromController, ..ALWAYS };
    let (mut late, mut prompt) = (trial_with(&[delay]), trial_with(&[]));
    for at in 0..5 {
        let expected = prompt.sample(ms(at), 1.0);
        assert_eq!(late.sample(ms(at), 1.0), None);
        assert_eq!(late.advance(ms(at) + us(499)), None);
        assert!(!late.session.last_sample_answered());
        assert_eq!(late.advance(ms(at) + us(500)), expected);
        assert!(late.session.last_sample_answered());
    }
}

#[test]
fn ignores_a_command_that_is_later_than_the_next() {
    let delay = Fault { kind: FaultKind::Delay(at(us(1_500))), direction: Direction::FromController, ..ALWAYS };
    let (mut late, mut prompt) = (trial_with(&[Fault { until: Some(at(ms(2))), ..delay }]), trial_with(&[]));
    let expected: Vec<_> = (0..4).map(|at| prompt.sample(ms(at), 1.0)).collect();
    assert_eq!((late.sample(ms(0), 1.0), late.sample(ms(1), 1.0)), (None, None));
    // The first command arrives alone. The next two arrive together, and the newer one counts.
    assert_eq!(late.advance(us(1_500)), expected[0]);
    assert_eq!(late.sample(ms(2), 1.0), None, "behind the one from 1 ms");
    assert_eq!(late.advance(us(2_500)), expected[2]);
    assert_eq!(late.sample(ms(3), 1.0), expected[3]);
    assert_eq!(late.advance(ms(3)), None);
}

#[test]
fn loses_a_truncated_message_and_the_next() {
    let truncate = Fault { kind: FaultKind::Truncate, until: Some(at(ms(1))), ..ALWAYS };
    for direction in [Direction::ToController, Direction::FromController] {
        let mut fixture = trial_with(&[Fault { direction, ..truncate }]);
        assert_eq!([0, 1, 2].map(|at| fixture.sample(ms(at), 1.0).is_some()), [false, false, true], "{direction:?}");
        if direction == Direction::ToController {
            assert_eq!(fixture.delivered()[0].1, frame(3, 1.0)[..12]);
        }
    }
}

#[test]
fn precedes_a_message_with_four_invalid_frames() {
    let babble = Fault { kind: FaultKind::Babble, ..ALWAYS };
    let mut fixture = trial_with(&[Fault { direction: Direction::ToController, ..babble }]);
    assert_eq!(fixture.sample(ms(0), 1.0).unwrap().state, ControllerState::Running);
    let bytes = fixture.delivered()[0].1.clone();
    assert_eq!((&bytes[64..], bytes.len()), (&frame(3, 1.0)[..], 88));
    for seed in 0..20 {
        let mut seeded = trial_with(&[Fault { seed: Some(seed), direction: Direction::ToController, ..babble }]);
        seeded.sample(ms(0), 1.0);
        let noise = &seeded.delivered()[0].1[..64];
        assert_eq!((0..64).filter(|at| noise[*at] == 0).collect::<Vec<_>>(), [15, 31, 47, 63]);
    }
    // The controller counts 2 per rejected frame and stops at 10. It ignores the first burst of
    // four, because it is still idle. The second one adds 8.
    assert_eq!(fixture.sample(ms(1), 1.0).unwrap().state, ControllerState::Running);
    let stopped = fixture.sample(ms(2), 1.0).unwrap();
    assert_eq!((stopped.state, stopped.cause), (ControllerState::Fault, StateCause::LineNoise));

    let mut reverse = trial_with(&[Fault { direction: Direction::FromController, ..babble }]);
    assert!((0..20).all(|at| reverse.sample(ms(at), 1.0).unwrap().state == ControllerState::Running));
}

#[test]
fn freezes_the_sample_before_the_window() {
    let freeze = Fault { kind: FaultKind::Freeze, from: at(ms(2)), until: Some(at(ms(5))), ..ALWAYS };
    let seen = |fault| {
        let mut fixture = trial_with(&[fault]);
        for at in 0..6 {
            fixture.sample(ms(at), at as f32);
        }
        let seen = fixture.delivered().iter().map(|(_, bytes)| decode_sample(bytes).wd_um).collect::<Vec<_>>();
        assert_eq!(fixture.session.link().delivered_sample(), Some([5.0, 5.0 / 8.0]));
        seen
    };
    assert_eq!(seen(freeze), [0.0, 1.0, 1.0, 1.0, 1.0, 5.0]);
    assert_eq!(seen(Fault { every: 2, ..freeze }), [0.0, 1.0, 2.0, 1.0, 4.0, 5.0]);
    assert_eq!(seen(Fault { from: at(ms(0)), until: Some(at(ms(2))), ..freeze }), [0.0, 0.0, 2.0, 3.0, 4.0, 5.0]);
}

#[test]
fn scales_both_components_before_the_line() {
    let scale = Fault { kind: FaultKind::Scale(-0.5), ..ALWAYS };
    let flip = Fault { kind: FaultKind::Flip, direction: Direction::ToController, from: at(ms(1)), ..ALWAYS };
    // A sample passes the sensor before the line, whatever the order of the list.
    let mut fixture = trial_with(&[flip, scale]);
    fixture.sample(ms(0), 2.0);
    fixture.sample(ms(1), 2.0);
    let delivered = fixture.delivered();
    assert_eq!(decode_sample(&delivered[0].1), Sample { wd_um: -1.0, wq_um: -0.125, ..sample(2.0) });
    let intact = Packet { sequence: 4, message: Message::Sample(decode_sample(&delivered[0].1)) }.encode();
    assert_eq!(intact.as_bytes().iter().zip(&delivered[1].1).map(|(a, b)| (a ^ b).count_ones()).sum::<u32>(), 1);
    assert_eq!(fixture.session.link().delivered_sample(), Some([-1.0, -0.125]), "the flipped sample is not delivered");
}

#[test]
fn clears_everything_for_new_faults() {
    let delay = Fault { kind: FaultKind::Delay(at(ms(9))), ..ALWAYS };
    let mut fixture = trial_with(&[delay]);
    fixture.sample(ms(0), 1.0);
    fixture.session.link_mut().set_faults(&[Fault { every: 2, ..ALWAYS }], SEED);
    assert_eq!((fixture.counts(), fixture.session.link().next_due()), (Vec::new(), None));
    fixture.session.start_trial(&CONFIGURE).unwrap();
    assert!(fixture.sample(ms(0), 1.0).is_some());
}

#[test]
fn loses_messages_beyond_the_capacity() {
    let delay = Fault { kind: FaultKind::Delay(at(ms(10_000))), direction: Direction::ToController, ..ALWAYS };
    let mut fixture = trial_with(&[delay]);
    for at in 0..MAX_QUEUED as u64 + 2 {
        assert_eq!(fixture.sample(ms(at), 1.0), None);
    }
    assert_eq!(fixture.counts(), [("delay", MAX_QUEUED as u64 + 2), ("overflow", 2)]);
    fixture.advance(ms(20_000));
    assert_eq!(fixture.delivered().len(), MAX_QUEUED);
}

fn real_time_trial_with(faults: &[Fault]) -> Fixture {
    let mut fixture = trial_with(faults);
    let start = fixture.session.line_time();
    fixture.session.link_mut().start_real_time(start, 10.0);
    fixture
}

#[test]
fn delivers_when_due_in_real_time() {
    let from = Fault { kind: FaultKind::Delay(at(ms(200))), direction: Direction::FromController, ..ALWAYS };
    for delay in [from, Fault { direction: Direction::ToController, ..from }] {
        let mut fixture = real_time_trial_with(&[delay]);
        let line = fixture.session.link_mut().real_time_line().unwrap();
        let sent = line.now();
        line.send(&frame(3, 1.0)).unwrap();
        let mut bytes = Vec::new();
        assert_eq!(line.receive(sent, &mut bytes).unwrap(), None);
        let at = line.receive(sent + ms(20_000), &mut bytes).unwrap().unwrap();
        // 200 ms of the trial are 20 ms of wall time.
        assert_eq!((at, line.now()), (sent + ms(20), sent + ms(20)));
        assert!(matches!(decode_first_packet(&bytes), Some(Packet { sequence: 3, message: Message::Command(_) })));
        assert_eq!(fixture.delivered().len(), 1);
    }
}

#[test]
fn waits_no_longer_than_the_deadline_in_real_time() {
    let mut fixture = real_time_trial_with(&[Fault { direction: Direction::FromController, ..ALWAYS }]);
    let line = fixture.session.link_mut().real_time_line().unwrap();
    line.send(&frame(3, 1.0)).unwrap();
    let mut bytes = Vec::new();
    let deadline = line.now() + ms(5);
    assert_eq!((line.receive(deadline, &mut bytes).unwrap(), line.now()), (None, deadline));
    assert_eq!((bytes.len(), fixture.counts()), (0, vec![("drop", 1)]));
}

#[test]
fn passes_other_messages_at_once_in_real_time() {
    let mut fixture = real_time_trial_with(&[ALWAYS]);
    let line = fixture.session.link_mut().real_time_line().unwrap();
    line.send(&frame(3, 1.0)).unwrap();
    let safe = Packet { sequence: 9, message: Message::Safe }.encode();
    line.send(safe.as_bytes()).unwrap();
    let mut bytes = Vec::new();
    while decode_first_packet(&bytes).is_none() {
        let deadline = line.now() + ms(20_000);
        assert!(line.receive(deadline, &mut bytes).unwrap().is_some());
    }
    let Message::Command(command) = decode_first_packet(&bytes).unwrap().message else { panic!("{bytes:?}") };
    assert_eq!((command.state, command.drive_vpp), (ControllerState::Safe, 0.0));
    let delivered: Vec<u8> = fixture.delivered().into_iter().flat_map(|(_, bytes)| bytes).collect();
    assert_eq!(delivered, [&[DELIMITER], safe.as_bytes()].concat());
}

#[test]
fn converts_both_ways_without_overflow() {
    let (start, ms) = (Instant::now(), Duration::from_millis);
    let clock = TrialClock { start, scale: 10.0 };
    assert_eq!((clock.trial_time(start + ms(20)), clock.wall_instant(ms(200))), (ms(200), start + ms(20)));
    assert_eq!(clock.trial_time(start.checked_sub(ms(20)).unwrap()), Duration::ZERO);
    let still = TrialClock { start, scale: f64::MIN_POSITIVE };
    assert!(still.wall_instant(Duration::MAX) > start && clock.wall_instant(Duration::MAX) > start);
}
