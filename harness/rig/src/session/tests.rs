//! The session over a device in process, and over links that misbehave.

use super::*;
use crate::hosted::Hosted;
use crate::link::Line;
use platebench_wire::LawId;
use std::sync::{Arc, Mutex};

const CONFIGURE: Configure = Configure {
    law: LawId::DqPi,
    paced_by_target: false,
    drives_own_plate: false,
    patience_ms: 0,
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

const FROM_REST: Sample = Sample { time_us: 0, setpoint_um: 2.0, wd_um: 0.0, wq_um: 0.0 };

/// What passes on the way to a hosted device.
#[derive(Clone, Copy, PartialEq)]
enum Fault {
    None,
    Silent,
    FlipAnswer,
    OldAnswers,
    Doubled,
    Contradicting,
    Dead,
}

/// A hosted device behind a fault that can be switched, with a log of what it was sent.
struct Faulty {
    device: Hosted,
    fault: Arc<Mutex<Fault>>,
    sent: Arc<Mutex<Vec<Message>>>,
    before: Vec<u8>,
}

impl Link for Faulty {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let fault = *self.fault.lock().unwrap();
        if fault == Fault::Dead {
            return Err(LinkError::Disconnected("pulled".to_owned()));
        }
        let mut reader = FrameReader::new();
        let packets =
            bytes.iter().filter_map(|&byte| reader.push(byte).map(|body| Packet::decode(body.unwrap()).unwrap()));
        self.sent.lock().unwrap().extend(packets.collect::<Vec<_>>().into_iter().map(|packet| packet.message));
        let mut real = Vec::new();
        let delay = self.device.exchange(now, bytes, &mut real)?;
        match fault {
            Fault::Silent => {}
            Fault::FlipAnswer => {
                real[5] ^= 4;
                answer.extend(&real);
            }
            Fault::OldAnswers => answer.extend(&self.before),
            Fault::Doubled => answer.extend([&real[..], &real[..]].concat()),
            Fault::Contradicting => {
                answer.extend(&real);
                let mut reader = FrameReader::new();
                let body = real.iter().find_map(|&byte| reader.push(byte).map(|body| body.unwrap().to_vec())).unwrap();
                let mut packet = Packet::decode(&body).unwrap();
                if let Message::Command(command) = &mut packet.message {
                    command.drive_vpp += 1.0;
                }
                answer.extend(packet.encode().as_bytes());
            }
            _ => answer.extend(&real),
        }
        self.before = real;
        Ok(delay)
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.device.pass(now, said)
    }
}

struct Bench {
    session: Session<Faulty>,
    fault: Arc<Mutex<Fault>>,
    sent: Arc<Mutex<Vec<Message>>>,
}

fn bench() -> Bench {
    let fault = Arc::new(Mutex::new(Fault::None));
    let sent = Arc::new(Mutex::new(Vec::new()));
    let link = Faulty { device: Hosted::new(), fault: fault.clone(), sent: sent.clone(), before: Vec::new() };
    let mut session = Session::open(link).unwrap();
    session.begin(&CONFIGURE).unwrap();
    Bench { session, fault, sent }
}

#[test]
fn the_hosted_device_introduces_itself_and_controls() {
    let mut bench = bench();
    assert_eq!(bench.session.firmware_name(), "platebench-host");
    assert!(LawId::ALL.into_iter().all(|law| bench.session.identity().has(law)));
    let reply = bench.session.sample(Duration::ZERO, &FROM_REST).unwrap().unwrap();
    assert_eq!(reply.delay, Duration::ZERO);
    assert!(reply.command.drive_vpp > 500.0);
}

#[test]
fn a_name_gives_no_orders_to_a_terminal() {
    let mut bench = bench();
    bench.session.identity.name = *b"\x1b[31m a~\n\x7f\xff\0\x07xyz";
    assert_eq!(bench.session.firmware_name(), "\u{fffd}[31m a~\u{fffd}\u{fffd}\u{fffd}");
}

#[test]
fn silence_corruption_and_old_answers_are_no_answer() {
    for fault in [Fault::Silent, Fault::FlipAnswer, Fault::OldAnswers] {
        let mut bench = bench();
        bench.session.sample(Duration::ZERO, &FROM_REST).unwrap().unwrap();
        *bench.fault.lock().unwrap() = fault;
        assert_eq!(bench.session.sample(Duration::from_millis(1), &FROM_REST).unwrap(), None);
        *bench.fault.lock().unwrap() = Fault::None;
        assert!(bench.session.sample(Duration::from_millis(2), &FROM_REST).unwrap().is_some());
    }
}

#[test]
fn a_dead_line_is_an_error_and_a_silent_one_at_the_start_too() {
    let mut bench = bench();
    *bench.fault.lock().unwrap() = Fault::Dead;
    assert!(matches!(bench.session.sample(Duration::ZERO, &FROM_REST), Err(RigError::Link(_))));
    assert!(!bench.session.safe());

    let fault = Arc::new(Mutex::new(Fault::Silent));
    let link = Faulty { device: Hosted::new(), fault, sent: Arc::default(), before: Vec::new() };
    assert!(matches!(Session::open(link), Err(RigError::NoAnswer { expected: "identity" })));
}

#[test]
fn a_refused_configuration_says_why() {
    let mut bench = bench();
    let refused = bench.session.begin(&Configure { drive_limit_vpp: -1.0, ..CONFIGURE });
    assert!(matches!(refused, Err(RigError::Refused(Rejection::Value))));
}

#[test]
fn time_without_samples_ends_at_zero_volts() {
    let mut bench = bench();
    bench.session.sample(Duration::ZERO, &FROM_REST).unwrap();
    assert_eq!(bench.session.pass(Duration::from_micros(4_999)).unwrap(), None);
    let command = bench.session.pass(Duration::from_millis(5)).unwrap().unwrap();
    assert_eq!((command.state, command.drive_vpp), (State::Fault, 0.0));
}

#[test]
fn safe_is_confirmed_and_a_dropped_session_asks_for_it() {
    let mut bench = bench();
    bench.session.sample(Duration::ZERO, &FROM_REST).unwrap();
    assert!(bench.session.safe());
    bench.sent.lock().unwrap().clear();
    drop(bench.session);
    assert_eq!(*bench.sent.lock().unwrap(), [Message::Safe]);
}

#[test]
fn a_link_in_virtual_time_is_not_live() {
    let mut bench = bench();
    assert!(!bench.session.is_live());
    assert!(matches!(bench.session.post(Message::Hello), Err(RigError::NotLive)));
    assert!(matches!(bench.session.listen(Instant::now()), Err(RigError::NotLive)));
}

#[test]
fn what_cannot_be_read_is_counted_from_the_beginning_of_a_trial() {
    let mut bench = bench();
    *bench.fault.lock().unwrap() = Fault::FlipAnswer;
    for _ in 0..3 {
        bench.session.sample(Duration::ZERO, &FROM_REST).unwrap();
    }
    assert_eq!(bench.session.refused(), 3);
    *bench.fault.lock().unwrap() = Fault::None;
    bench.session.begin(&CONFIGURE).unwrap();
    assert_eq!(bench.session.refused(), 0);
}

#[test]
fn two_answers_to_one_sample_that_want_different_things_are_counted() {
    let mut bench = bench();
    let mut sample = |fault, ms| {
        *bench.fault.lock().unwrap() = fault;
        bench.session.sample(Duration::from_millis(ms), &FROM_REST).unwrap().unwrap();
        bench.session.contradictions()
    };
    assert_eq!([Fault::None, Fault::Doubled].map(|fault| sample(fault, 0)), [0, 0], "doubled by the line");
    // Each sample has a number of its own, around the end of the numbers too.
    assert!((1..=300).all(|number| sample(Fault::Contradicting, number) == number));
    assert_eq!(sample(Fault::None, 301), 300);
    *bench.fault.lock().unwrap() = Fault::None;
    bench.session.begin(&CONFIGURE).unwrap();
    assert_eq!(bench.session.contradictions(), 0);
}

#[test]
fn a_controller_that_takes_its_command_back_does_not_contradict_itself() {
    let mut bench = bench();
    bench.session.sample(Duration::ZERO, &FROM_REST).unwrap().unwrap();
    let stopped = bench.session.pass(Duration::from_millis(5)).unwrap().unwrap();
    assert_eq!((stopped.state, bench.session.contradictions()), (State::Fault, 0));
}

#[test]
fn zero_volts_are_asked_for_again_where_no_answer_comes() {
    let mut bench = bench();
    bench.sent.lock().unwrap().clear();
    *bench.fault.lock().unwrap() = Fault::FlipAnswer;
    assert!(!bench.session.safe());
    assert_eq!(*bench.sent.lock().unwrap(), [Message::Safe; 3]);
}

/// A hosted device on a line that brings garbage whenever somebody listens.
struct Babbling {
    device: Hosted,
    until: Instant,
}

impl Link for Babbling {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.device.exchange(now, bytes, answer)
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.device.pass(now, said)
    }

    fn line(&mut self) -> Option<&mut dyn Line> {
        Some(self)
    }
}

impl Line for Babbling {
    fn send(&mut self, _bytes: &[u8]) -> Result<(), LinkError> {
        Ok(())
    }

    fn receive(&mut self, _until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        let now = Instant::now();
        if now > self.until {
            return Err(LinkError::Disconnected("listened to for too long".to_owned()));
        }
        bytes.extend_from_slice(&[1, 2, 3, 0].repeat(8));
        Ok(Some(now))
    }
}

#[test]
fn a_line_that_babbles_holds_nobody_up_and_fills_no_memory() {
    let now = Instant::now();
    let mut session = Session::open(Babbling { device: Hosted::new(), until: now + Duration::from_secs(10) }).unwrap();
    let room = session.bytes.capacity();
    assert_eq!(session.listen(now + Duration::from_millis(20)).unwrap(), None);
    assert!(session.refused() >= 8);
    assert_eq!(session.bytes.capacity(), room);
}

#[test]
fn a_command_is_news_once_and_in_order_unless_it_takes_the_last_one_back() {
    let command = |state| Command {
        target_time_us: 0,
        drive_vpp: 0.0,
        frequency_mhz: 0,
        state,
        cause: platebench_wire::StateCause::None,
        flags: 0,
        compute_us: 0,
    };
    let is_news = |sent, heard, sequence, state| {
        News { sent, heard }.of(&Packet { sequence, message: Message::Command(command(state)) }).is_some()
    };
    // Around the end of the numbers, too.
    for (sent, heard) in [(7, 5), (1, 255), (0, 254)] {
        let at = |offset: i8| is_news(sent, heard, heard.wrapping_add_signed(offset), State::Running);
        assert_eq!([-1, 0, 1, 2, 3].map(at), [false, false, true, true, false], "{sent} {heard}");
        assert!(
            is_news(sent, heard, heard, State::Fault) && !is_news(sent, heard, heard.wrapping_sub(1), State::Fault)
        );
    }
    assert!(News { sent: 7, heard: 5 }.of(&Packet { sequence: 7, message: Message::Hello }).is_none());
}
