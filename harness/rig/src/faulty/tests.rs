//! Every kind of fault on a device in process, with a log of what reached it and when.

use super::*;
use crate::hosted::Hosted;
use crate::session::Session;
use platebench_wire::{Command, Configure, LawId, Sample, State, StateCause};
use std::sync::{Arc, Mutex};
use std::time::Instant;

const CONFIGURE: Configure = Configure {
    paced_by_target: false,
    drives_own_plate: false,
    patience_ms: 0,
    law: LawId::DqPi,
    period_us: 1_000,
    loop_delay_us: 0,
    start_frequency_mhz: 32_307_600,
    gain_um_per_vpp: 0.00698,
    time_constant_s: 1.88e-3,
    response_time_s: 0.0,
    drive_limit_vpp: 900.0,
    frequency_range_hz: 250.0,
    frequency_slew_hz: 100.0,
    gains: None,
};

const ALWAYS: WireFault = WireFault {
    kind: WireFaultKind::Drop,
    from: Duration::ZERO,
    until: None,
    direction: Direction::Both,
    every: 1,
    seed: 1,
};

/// Bytes that the device was given and when, or nothing where only time passed.
type Log = Arc<Mutex<Vec<(Duration, Vec<u8>)>>>;

struct Watched {
    device: Hosted,
    log: Log,
    /// In real time: what the device answered and nobody has fetched yet.
    waiting: Vec<u8>,
}

impl Link for Watched {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.log.lock().unwrap().push((now, bytes.to_vec()));
        self.device.exchange(now, bytes, answer)
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.log.lock().unwrap().push((now, Vec::new()));
        self.device.pass(now, said)
    }

    fn line(&mut self) -> Option<&mut dyn Line> {
        Some(self)
    }
}

impl Line for Watched {
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        let mut waiting = std::mem::take(&mut self.waiting);
        self.exchange(Duration::ZERO, bytes, &mut waiting)?;
        self.waiting = waiting;
        Ok(())
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        if self.waiting.is_empty() {
            std::thread::sleep(until.saturating_duration_since(Instant::now()));
            return Ok(None);
        }
        // In pieces, as a line does.
        let piece = self.waiting.len().min(7);
        bytes.extend(self.waiting.drain(..piece));
        Ok(Some(Instant::now()))
    }
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

struct Bench {
    session: Session<Faulty<Watched>>,
    log: Log,
}

fn bench(faults: &[WireFault]) -> Bench {
    let log = Log::default();
    let watched = Watched { device: Hosted::new(), log: log.clone(), waiting: Vec::new() };
    let mut session = Session::open(Faulty::new(watched)).unwrap();
    session.link_mut().arm(faults);
    session.begin(&CONFIGURE).unwrap();
    log.lock().unwrap().clear();
    Bench { session, log }
}

impl Bench {
    fn sample(&mut self, now: Duration, wd_um: f32) -> Option<Command> {
        self.session.sample(now, &sample(wd_um)).unwrap().map(|reply| reply.command)
    }

    fn pass(&mut self, now: Duration) -> Option<Command> {
        self.session.pass(now).unwrap()
    }

    /// What the device was given, time alone left out.
    fn given(&self) -> Vec<(Duration, Vec<u8>)> {
        self.log.lock().unwrap().iter().filter(|(_, bytes)| !bytes.is_empty()).cloned().collect()
    }

    fn counts(&self) -> Vec<(&'static str, u64)> {
        self.session.link().counts().collect()
    }
}

fn sampled(bytes: &[u8]) -> Sample {
    match decode(bytes).unwrap().message {
        Message::Sample(sample) => sample,
        other => panic!("{other:?}"),
    }
}

#[test]
fn without_faults_everything_passes_as_it_is() {
    let mut bench = bench(&[]);
    assert!(bench.sample(ms(0), 0.5).is_some());
    assert_eq!(bench.given(), [(ms(0), frame(3, 0.5))]);
    assert_eq!((bench.session.link().given(), bench.session.link().due()), (None, None));
}

#[test]
fn a_window_is_half_open_and_every_second_message_is_the_second() {
    let drop = WireFault { from: ms(2), until: Some(ms(6)), every: 2, direction: Direction::ToController, ..ALWAYS };
    let mut bench = bench(&[drop]);
    let answered: Vec<_> = (0..9).filter(|at| bench.sample(ms(*at), 1.0).is_some()).collect();
    assert_eq!(answered, [0, 1, 2, 4, 6, 7, 8]);
    assert_eq!(bench.counts(), [("drop", 2)]);

    let edges = WireFault { from: us(2_000), until: Some(us(4_000)), ..ALWAYS };
    for (at, passes) in [(us(1_999), true), (us(2_000), false), (us(3_999), false), (us(4_000), true)] {
        let mut bench = super::tests::bench(&[edges]);
        assert_eq!(bench.sample(at, 1.0).is_some(), passes, "{at:?}");
    }
    let never = WireFault { every: 0, ..ALWAYS };
    assert!(super::tests::bench(&[never]).sample(ms(0), 1.0).is_some());
}

#[test]
fn both_directions_are_counted_by_themselves() {
    let mut bench = bench(&[WireFault { every: 3, ..ALWAYS }]);
    let answered: Vec<_> = (0..9).filter(|at| bench.sample(ms(*at), 1.0).is_some()).collect();
    // Samples 2, 5, 8 are lost; of the commands to the others 0, 1, 3, 4, 6, 7 the third and the sixth are.
    assert_eq!(answered, [0, 1, 4, 6]);
    assert_eq!(bench.given().len(), 6);
    assert_eq!(bench.counts(), [("drop", 5)]);
}

#[test]
fn a_lost_sample_lets_time_pass_and_the_target_s_own_word_comes_back() {
    let drop = WireFault { from: ms(1), direction: Direction::ToController, ..ALWAYS };
    let mut bench = bench(&[drop]);
    bench.sample(ms(0), 1.0).unwrap();
    for at in 1..5 {
        assert_eq!((bench.sample(ms(at), 1.0), bench.pass(ms(at))), (None, None));
    }
    assert_eq!(bench.sample(ms(5), 1.0), None);
    let said = bench.pass(ms(5)).unwrap();
    assert_eq!((said.state, said.cause, said.drive_vpp), (State::Fault, StateCause::SampleTimeout, 0.0));
    assert!(!bench.session.is_answered());
    assert_eq!(bench.pass(ms(6)), None, "said once");

    // The same word does not come over a line that is dead both ways.
    let mut dead = super::tests::bench(&[WireFault { from: ms(1), kind: WireFaultKind::Disconnect, ..ALWAYS }]);
    dead.sample(ms(0), 1.0).unwrap();
    assert!((1..30).all(|at| dead.sample(ms(at), 1.0).is_none() && dead.pass(ms(at)).is_none()));
}

#[test]
fn handshake_configuration_and_safe_pass_unharmed() {
    let kinds = [WireFaultKind::Drop, WireFaultKind::Disconnect, WireFaultKind::Truncate, WireFaultKind::Delay(ms(1))];
    let ways = [Direction::ToController, Direction::FromController];
    for (kind, direction) in kinds.into_iter().flat_map(|kind| ways.map(|way| (kind, way))) {
        let mut bench = bench(&[WireFault { kind, direction, ..ALWAYS }]);
        assert_eq!(bench.sample(ms(0), 1.0), None);
        assert!(bench.session.configure(ms(1), &CONFIGURE).is_ok(), "{kind:?}");
        assert_eq!(bench.sample(ms(1), 1.0), None);
        assert!(bench.session.safe(), "{kind:?}");
        assert_eq!(bench.session.link().due(), None, "what is held belongs to what is over");
    }
}

#[test]
fn one_bit_is_flipped_and_the_seed_says_which() {
    let flipped = |seed| {
        let flip =
            WireFault { kind: WireFaultKind::Flip, seed, direction: Direction::ToController, every: 2, ..ALWAYS };
        let mut bench = bench(&[flip]);
        let answers = [0, 1, 2].map(|at| bench.sample(ms(at), 1.0).is_some());
        let given = bench.given();
        assert_eq!((given.len(), answers[0], answers[1]), (3, true, false));
        let (sent, struck) = (frame(4, 1.0), &given[1].1);
        let bits = sent.iter().zip(struck).map(|(a, b)| (a ^ b).count_ones()).sum::<u32>();
        assert_eq!((bits, struck.len()), (1, sent.len()));
        struck.clone()
    };
    assert_eq!(flipped(1), flipped(1));
    assert!((2..12).any(|seed| flipped(seed) != flipped(1)));
    // Every bit may be meant, the delimiter's too.
    assert!((0..400).any(|seed| flipped(seed).last() != Some(&0)));
}

/// `scenarios/faults/flipped-bit.toml`: a controller that acted on this frame would see.
#[test]
fn the_seed_of_the_scenario_flips_the_highest_bit_of_an_exponent() {
    let flip = WireFault { kind: WireFaultKind::Flip, seed: SCENARIO_SEED, ..ALWAYS };
    let mut bench = bench(&[flip]);
    bench.sample(ms(0), 1.0);
    let (sent, struck) = (frame(3, 1.0), bench.given()[0].1.clone());
    // Stuffing byte, version and kind, number, time, setpoint: Wd is bytes 11 to 14.
    let changed: Vec<_> = (0..sent.len()).filter(|at| sent[*at] != struck[*at]).collect();
    assert_eq!((changed, sent[14] ^ struck[14]), (vec![14], 0x40));
}

const SCENARIO_SEED: u64 = 22;

#[test]
fn a_doubled_sample_is_not_controlled_with_twice() {
    let double = WireFault { kind: WireFaultKind::Duplicate, ..ALWAYS };
    let (mut doubled, mut single) = (bench(&[double]), bench(&[]));
    for at in 0..20 {
        let wd = 0.1 * at as f32;
        assert_eq!(doubled.sample(ms(at), wd), single.sample(ms(at), wd), "at {at} ms");
    }
    assert_eq!(doubled.given()[0].1, [frame(3, 0.0), frame(3, 0.0)].concat());
    // The device answers a doubled sample twice.
    assert_eq!(doubled.counts(), [("duplicate", 20 + 2 * 20)]);
}

#[test]
fn a_delayed_sample_is_held_until_it_is_due() {
    let delay = WireFault { kind: WireFaultKind::Delay(us(1_500)), direction: Direction::ToController, ..ALWAYS };
    let mut bench = bench(&[WireFault { until: Some(ms(1)), ..delay }]);
    assert_eq!(bench.sample(ms(0), 0.5), None);
    assert_eq!((bench.session.link().due(), bench.session.link().given()), (Some(us(1_500)), Some([0.0; 2])));
    // The next one is not struck, but a line does not reorder.
    assert_eq!(bench.sample(ms(1), 0.75), None);
    assert_eq!(bench.pass(us(1_499)), None);
    assert_eq!(bench.given(), []);
    let late = bench.pass(us(1_500)).unwrap();
    assert_eq!(bench.given(), [(us(1_500), frame(3, 0.5)), (us(1_500), frame(4, 0.75))]);
    assert_eq!((late.state, bench.session.is_answered()), (State::Running, true));
    assert_eq!(bench.session.link().given(), Some([0.75, 0.75 / 8.0]));
    assert!(bench.sample(ms(2), 1.0).is_some());
}

#[test]
fn a_delayed_command_comes_when_it_is_due() {
    let delay = WireFault { kind: WireFaultKind::Delay(us(500)), direction: Direction::FromController, ..ALWAYS };
    let (mut late, mut prompt) = (bench(&[delay]), bench(&[]));
    for at in 0..5 {
        let expected = prompt.sample(ms(at), 1.0);
        assert_eq!(late.sample(ms(at), 1.0), None);
        assert_eq!(late.pass(ms(at) + us(499)), None);
        assert!(!late.session.is_answered());
        assert_eq!(late.pass(ms(at) + us(500)), expected);
        assert!(late.session.is_answered());
    }
}

#[test]
fn a_command_that_is_later_than_the_next_one_is_not_heard_any_more() {
    let delay = WireFault { kind: WireFaultKind::Delay(us(1_500)), direction: Direction::FromController, ..ALWAYS };
    let (mut late, mut prompt) = (bench(&[WireFault { until: Some(ms(2)), ..delay }]), bench(&[]));
    let expected: Vec<_> = (0..4).map(|at| prompt.sample(ms(at), 1.0)).collect();
    assert_eq!((late.sample(ms(0), 1.0), late.sample(ms(1), 1.0)), (None, None));
    // In order, so that the first comes alone and what is newest wins where several come at once.
    assert_eq!(late.pass(us(1_500)), expected[0]);
    assert_eq!(late.sample(ms(2), 1.0), None, "behind the one from 1 ms");
    assert_eq!(late.pass(us(2_500)), expected[2]);
    assert_eq!(late.sample(ms(3), 1.0), expected[3]);
    assert_eq!(late.pass(ms(3)), None);
}

#[test]
fn a_truncated_message_loses_half_and_takes_the_next_with_it() {
    let truncate = WireFault { kind: WireFaultKind::Truncate, until: Some(ms(1)), ..ALWAYS };
    for direction in [Direction::ToController, Direction::FromController] {
        let mut bench = bench(&[WireFault { direction, ..truncate }]);
        assert_eq!([0, 1, 2].map(|at| bench.sample(ms(at), 1.0).is_some()), [false, false, true], "{direction:?}");
        if direction == Direction::ToController {
            assert_eq!(bench.given()[0].1, frame(3, 1.0)[..12]);
        }
    }
}

#[test]
fn noise_is_four_frames_to_be_refused_and_the_message_behind_it_is_whole() {
    let babble = WireFault { kind: WireFaultKind::Babble, ..ALWAYS };
    let mut bench = bench(&[WireFault { direction: Direction::ToController, ..babble }]);
    assert_eq!(bench.sample(ms(0), 1.0).unwrap().state, State::Running);
    let bytes = bench.given()[0].1.clone();
    assert_eq!((&bytes[64..], bytes.len()), (&frame(3, 1.0)[..], 88));
    for seed in 0..20 {
        let mut seeded = super::tests::bench(&[WireFault { seed, direction: Direction::ToController, ..babble }]);
        seeded.sample(ms(0), 1.0);
        let noise = &seeded.given()[0].1[..64];
        assert_eq!((0..64).filter(|at| noise[*at] == 0).collect::<Vec<_>>(), [15, 31, 47, 63]);
    }
    // Not running yet it bears the first burst. The second is good for 8 of 10, the third is the storm.
    assert_eq!(bench.sample(ms(1), 1.0).unwrap().state, State::Running);
    let stopped = bench.sample(ms(2), 1.0).unwrap();
    assert_eq!((stopped.state, stopped.cause), (State::Fault, StateCause::LineNoise));

    let mut other_way = super::tests::bench(&[WireFault { direction: Direction::FromController, ..babble }]);
    assert!((0..20).all(|at| other_way.sample(ms(at), 1.0).unwrap().state == State::Running));
}

#[test]
fn a_frozen_sensor_shows_what_it_showed_before_the_window() {
    let freeze = WireFault { kind: WireFaultKind::Freeze, from: ms(2), until: Some(ms(5)), ..ALWAYS };
    let seen = |fault| {
        let mut bench = bench(&[fault]);
        for at in 0..6 {
            bench.sample(ms(at), at as f32);
        }
        let seen = bench.given().iter().map(|(_, bytes)| sampled(bytes).wd_um).collect::<Vec<_>>();
        assert_eq!(bench.session.link().given(), Some([5.0, 5.0 / 8.0]));
        seen
    };
    assert_eq!(seen(freeze), [0.0, 1.0, 1.0, 1.0, 1.0, 5.0]);
    assert_eq!(seen(WireFault { every: 2, ..freeze }), [0.0, 1.0, 2.0, 1.0, 4.0, 5.0]);
    assert_eq!(seen(WireFault { from: ms(0), until: Some(ms(2)), ..freeze }), [0.0, 0.0, 2.0, 3.0, 4.0, 5.0]);
}

#[test]
fn a_scaled_sensor_is_scaled_in_both_components_and_before_the_line() {
    let scale = WireFault { kind: WireFaultKind::Scale(-0.5), ..ALWAYS };
    let flip = WireFault { kind: WireFaultKind::Flip, direction: Direction::ToController, from: ms(1), ..ALWAYS };
    // Behind the flip in the list, before it on the way.
    let mut bench = bench(&[flip, scale]);
    bench.sample(ms(0), 2.0);
    bench.sample(ms(1), 2.0);
    let given = bench.given();
    assert_eq!(sampled(&given[0].1), Sample { wd_um: -1.0, wq_um: -0.125, ..sample(2.0) });
    let wished = Packet { sequence: 4, message: Message::Sample(sampled(&given[0].1)) }.encode();
    assert_eq!(wished.as_bytes().iter().zip(&given[1].1).map(|(a, b)| (a ^ b).count_ones()).sum::<u32>(), 1);
    assert_eq!(bench.session.link().given(), Some([-1.0, -0.125]), "the flipped one told it nothing");
}

#[test]
fn what_is_armed_anew_has_forgotten_everything() {
    let delay = WireFault { kind: WireFaultKind::Delay(ms(9)), ..ALWAYS };
    let mut bench = bench(&[delay]);
    bench.sample(ms(0), 1.0);
    bench.session.link_mut().arm(&[WireFault { every: 2, ..ALWAYS }]);
    assert_eq!((bench.counts(), bench.session.link().due()), (Vec::new(), None));
    bench.session.begin(&CONFIGURE).unwrap();
    assert!(bench.sample(ms(0), 1.0).is_some());
}

#[test]
fn no_more_is_held_than_there_is_room_for() {
    let delay = WireFault { kind: WireFaultKind::Delay(ms(10_000)), direction: Direction::ToController, ..ALWAYS };
    let mut bench = bench(&[delay]);
    for at in 0..MOST_HELD as u64 + 2 {
        assert_eq!(bench.sample(ms(at), 1.0), None);
    }
    assert_eq!(bench.counts(), [("delay", MOST_HELD as u64 + 2), ("overflow", 2)]);
    bench.pass(ms(20_000));
    assert_eq!(bench.given().len(), MOST_HELD);
}

/// A faulty line in real time, ten times as fast as the wall.
fn real_time(faults: &[WireFault]) -> Bench {
    let mut bench = bench(faults);
    bench.session.link_mut().run_from(Instant::now(), 10.0);
    bench
}

fn soon() -> Instant {
    Instant::now() + Duration::from_secs(20)
}

#[test]
fn a_line_in_real_time_hands_over_what_is_due_and_not_before() {
    let from = WireFault { kind: WireFaultKind::Delay(ms(200)), direction: Direction::FromController, ..ALWAYS };
    for delay in [from, WireFault { direction: Direction::ToController, ..from }] {
        let mut bench = real_time(&[delay]);
        let line = bench.session.link_mut().line().unwrap();
        let sent = Instant::now();
        line.send(&frame(3, 1.0)).unwrap();
        let mut bytes = Vec::new();
        assert_eq!(line.receive(sent, &mut bytes).unwrap(), None);
        let at = line.receive(soon(), &mut bytes).unwrap().unwrap();
        // 200 ms of the trial are 20 ms of the wall.
        assert!(at >= sent + ms(20) && Instant::now() >= at, "{:?}", at - sent);
        assert!(matches!(decode(&bytes), Some(Packet { sequence: 3, message: Message::Command(_) })));
        assert_eq!(bench.given().len(), 1);
    }
}

#[test]
fn a_clock_translates_both_ways() {
    let start = Instant::now();
    let clock = Clock { start, scale: 10.0 };
    assert_eq!((clock.trial(start + ms(20)), clock.wall(ms(200))), (ms(200), start + ms(20)));
    assert_eq!(clock.trial(start.checked_sub(ms(20)).unwrap()), Duration::ZERO);
    // Nothing that a trial could hold leads to an instant that does not exist.
    let still = Clock { start, scale: f64::MIN_POSITIVE };
    assert!(still.wall(Duration::MAX) > start && clock.wall(Duration::MAX) > start);
}

#[test]
fn a_line_in_real_time_waits_no_longer_than_it_is_told_to() {
    let mut bench = real_time(&[WireFault { direction: Direction::FromController, ..ALWAYS }]);
    let line = bench.session.link_mut().line().unwrap();
    line.send(&frame(3, 1.0)).unwrap();
    let mut bytes = Vec::new();
    assert_eq!(line.receive(Instant::now() + ms(5), &mut bytes).unwrap(), None);
    assert_eq!((bytes.len(), bench.counts()), (0, vec![("drop", 1)]));
}

#[test]
fn what_is_no_sample_passes_a_line_in_real_time_at_once() {
    let mut bench = real_time(&[ALWAYS]);
    let line = bench.session.link_mut().line().unwrap();
    line.send(&frame(3, 1.0)).unwrap();
    let safe = Packet { sequence: 9, message: Message::Safe }.encode();
    line.send(safe.as_bytes()).unwrap();
    let mut bytes = Vec::new();
    while decode(&bytes).is_none() {
        assert!(line.receive(soon(), &mut bytes).unwrap().is_some());
    }
    let Message::Command(command) = decode(&bytes).unwrap().message else { panic!("{bytes:?}") };
    assert_eq!((command.state, command.drive_vpp), (State::Safe, 0.0));
    // Half a frame that is still on the line ends first.
    let given: Vec<u8> = bench.given().into_iter().flat_map(|(_, bytes)| bytes).collect();
    assert_eq!(given, [&[DELIMITER], safe.as_bytes()].concat());
}
