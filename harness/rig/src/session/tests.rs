//! Tests a session over a hosted controller, and over links with faults.

use super::*;
use crate::link::{BoxedLink, LinkError, RealTimeLine};
use crate::rigs::hosted::HostedLink;
use platebench_test_kit::{CONFIGURE, random_sample};
use platebench_wire::{LawId, Rejection, StateCause};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::sync::{Arc, Mutex};

const AT_REST: Sample = Sample { time_us: 0, setpoint_um: 2.0, wd_um: 0.0, wq_um: 0.0 };

/// Link to a hosted controller. `answer` returns the bytes that arrive after a request.
struct FakeLink<F> {
    device: HostedLink,
    answer: F,
    /// Bytes that arrive before the next answer.
    queued: Vec<u8>,
}

type Answer = Result<Vec<u8>, LinkError>;

impl<F: FnMut(&mut HostedLink, Duration, &[u8], &mut Vec<u8>) -> Answer + Send> FakeLink<F> {
    fn new(answer: F) -> Self {
        Self { device: HostedLink::new(), answer, queued: Vec::new() }
    }
}

impl<F: FnMut(&mut HostedLink, Duration, &[u8], &mut Vec<u8>) -> Answer + Send> Link for FakeLink<F> {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        answer.append(&mut self.queued);
        answer.extend((self.answer)(&mut self.device, now, bytes, &mut self.queued)?);
        Ok(Duration::ZERO)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        received.append(&mut self.queued);
        self.device.advance_to(now, received)
    }
}

fn true_answer(device: &mut HostedLink, now: Duration, bytes: &[u8]) -> Vec<u8> {
    let mut answer = Vec::new();
    device.exchange(now, bytes, &mut answer).unwrap();
    answer
}

fn first_packet(bytes: &[u8]) -> Option<Packet> {
    PacketReader::new().packets(bytes).flatten().next()
}

fn command(state: ControllerState, drive_vpp: f32) -> Command {
    let frequency_mhz = 32_307_600;
    Command { target_time_us: 0, drive_vpp, frequency_mhz, state, cause: StateCause::None, flags: 0, compute_us: 0 }
}

fn command_frame(sequence: u8, state: ControllerState, drive_vpp: f32) -> Vec<u8> {
    Packet { sequence, message: Message::Command(command(state, drive_vpp)) }.encode().as_bytes().to_vec()
}

fn with_changed_command(frame: &[u8], change: impl FnOnce(&mut Command)) -> Vec<u8> {
    let mut packet = first_packet(frame).unwrap();
    if let Message::Command(command) = &mut packet.message {
        change(command);
    }
    packet.encode().as_bytes().to_vec()
}

#[derive(Clone, Copy, PartialEq)]
enum LinkFault {
    None,
    Silent,
    FlipAnswer,
    PreviousAnswer,
    Duplicated,
    Contradicting,
    IgnoresSafe,
    Disconnected,
}

struct Fixture {
    session: Session<BoxedLink>,
    fault: Arc<Mutex<LinkFault>>,
    sent: Arc<Mutex<Vec<Message>>>,
}

impl Fixture {
    fn set_fault(&self, fault: LinkFault) {
        *self.fault.lock().unwrap() = fault;
    }

    fn sample(&mut self, ms: u64) -> Option<Reply> {
        self.session.send_sample(Duration::from_millis(ms), &AT_REST).unwrap()
    }
}

fn faulty_link(fault: &Arc<Mutex<LinkFault>>, sent: &Arc<Mutex<Vec<Message>>>) -> BoxedLink {
    let (fault, sent, mut previous) = (fault.clone(), sent.clone(), Vec::new());
    Box::new(FakeLink::new(move |device, now, bytes, _| {
        let messages = PacketReader::new().packets(bytes).map(|packet| packet.unwrap().message).collect::<Vec<_>>();
        sent.lock().unwrap().extend(messages);
        let own = true_answer(device, now, bytes);
        let previous = std::mem::replace(&mut previous, own.clone());
        Ok(match *fault.lock().unwrap() {
            LinkFault::None => own,
            LinkFault::Silent => Vec::new(),
            LinkFault::FlipAnswer => [&own[..5], &[own[5] ^ 4], &own[6..]].concat(),
            LinkFault::PreviousAnswer => previous,
            LinkFault::Duplicated => own.repeat(2),
            LinkFault::Contradicting => {
                [&own[..], &with_changed_command(&own, |command| command.drive_vpp += 1.0)].concat()
            }
            LinkFault::IgnoresSafe => with_changed_command(&own, |command| command.state = ControllerState::Running),
            LinkFault::Disconnected => return Err(LinkError::Disconnected("unplugged".to_owned())),
        })
    }))
}

fn start_trial() -> Fixture {
    let (fault, sent) = (Arc::new(Mutex::new(LinkFault::None)), Arc::default());
    let mut session = Session::open(faulty_link(&fault, &sent)).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    Fixture { session, fault, sent }
}

#[test]
fn controls_with_the_hosted_device() {
    let mut fixture = start_trial();
    assert_eq!(fixture.session.firmware_name(), "platebench-host");
    assert!(LawId::ALL.into_iter().all(|law| fixture.session.identity().has_law(law)));
    let reply = fixture.sample(0).unwrap();
    assert_eq!(reply.delay, Duration::ZERO);
    assert!(reply.command.drive_vpp > 500.0);
}

/// Replies to samples with silences that stop the controller, and the stops.
fn replies(law: LawId, transport: Transport) -> (Vec<Option<Reply>>, Vec<Option<Command>>) {
    let mut session = Session::open(HostedLink::new()).unwrap();
    session.set_transport(transport);
    let configure = Configure { law, ..CONFIGURE };
    session.begin_trial(&configure, false).unwrap();
    let (mut replies, mut stops, mut random) = (Vec::new(), Vec::new(), ChaCha8Rng::seed_from_u64(7));
    for step in 0..300_u64 {
        let now = Duration::from_millis(step + step / 40 * 10);
        if step % 40 == 0 {
            stops.push(session.advance_to(now).unwrap());
            session.reconfigure(now, &configure).unwrap();
        }
        let mut sample = random_sample(&mut random, now.as_micros() as u32);
        if step % 80 == 20 {
            sample.wd_um = f32::NAN;
        }
        replies.push(session.send_sample(now, &sample).unwrap());
    }
    (replies, stops)
}

#[test]
fn samples_without_bytes_get_the_same_replies() {
    for law in LawId::ALL {
        let expected = replies(law, Transport::Words);
        assert!(expected.0.iter().all(Option::is_some) && expected.1.iter().any(Option::is_some), "{law:?}");
        assert_eq!(replies(law, Transport::Blocks), expected, "{law:?}");
        assert_eq!(replies(law, Transport::BlocksAndWords), expected, "{law:?}");
    }
}

#[test]
fn replaces_control_characters_in_a_name() {
    let mut fixture = start_trial();
    fixture.session.identity.name = *b"\x1b[31m a~\n\x7f\xff\0\x07xyz";
    assert_eq!(fixture.session.firmware_name(), "\u{fffd}[31m a~\u{fffd}\u{fffd}\u{fffd}");
}

#[test]
fn returns_no_reply_without_a_valid_answer() {
    for fault in [LinkFault::Silent, LinkFault::FlipAnswer, LinkFault::PreviousAnswer] {
        let mut fixture = start_trial();
        fixture.sample(0).unwrap();
        fixture.set_fault(fault);
        assert_eq!(fixture.sample(1), None);
        fixture.set_fault(LinkFault::None);
        assert!(fixture.sample(2).is_some());
    }
}

#[test]
fn reports_a_lost_link_and_a_silent_controller() {
    let mut fixture = start_trial();
    fixture.set_fault(LinkFault::Disconnected);
    assert!(matches!(fixture.session.send_sample(Duration::ZERO, &AT_REST), Err(RigError::Link(_))));
    assert!(!fixture.session.request_safe_state());

    let link = faulty_link(&Arc::new(Mutex::new(LinkFault::Silent)), &Arc::default());
    assert!(matches!(Session::open(link), Err(RigError::NoIdentity { .. })));
}

#[test]
fn reports_why_a_configuration_is_rejected() {
    let mut fixture = start_trial();
    let refused = fixture.session.start_trial(&Configure { drive_limit_vpp: -1.0, ..CONFIGURE });
    assert!(matches!(refused, Err(RigError::ConfigurationRejected(Rejection::Value))));
}

#[test]
fn returns_the_stop_after_time_without_samples() {
    let mut fixture = start_trial();
    fixture.sample(0);
    assert_eq!(fixture.session.advance_to(Duration::from_micros(4_999)).unwrap(), None);
    let command = fixture.session.advance_to(Duration::from_millis(5)).unwrap().unwrap();
    assert_eq!((command.state, command.drive_vpp), (ControllerState::Fault, 0.0));
}

#[test]
fn requests_0_v_when_dropped() {
    let mut fixture = start_trial();
    fixture.sample(0);
    assert!(fixture.session.request_safe_state());
    fixture.sent.lock().unwrap().clear();
    drop(fixture.session);
    assert_eq!(*fixture.sent.lock().unwrap(), [Message::Safe]);
}

#[test]
fn rejects_real_time_over_a_link_in_virtual_time() {
    let mut fixture = start_trial();
    assert!(!fixture.session.supports_real_time());
    assert!(matches!(fixture.session.send(Message::Hello), Err(RigError::NoRealTime)));
    assert!(matches!(fixture.session.receive(Instant::now()), Err(RigError::NoRealTime)));
}

#[test]
fn counts_rejected_frames_per_trial() {
    let mut fixture = start_trial();
    fixture.set_fault(LinkFault::FlipAnswer);
    for _ in 0..3 {
        fixture.sample(0);
    }
    assert_eq!(fixture.session.rejected_frames(), 3);
    let rejected = fixture.session.first_rejected_frame().unwrap();
    assert_eq!((rejected.bytes, rejected.expected), (24, 24));
    fixture.set_fault(LinkFault::None);
    fixture.session.start_trial(&CONFIGURE).unwrap();
    assert_eq!((fixture.session.rejected_frames(), fixture.session.first_rejected_frame()), (0, None));
}

#[test]
fn counts_two_different_answers_to_one_sample() {
    let mut fixture = start_trial();
    let mut sample = |fault, ms| {
        fixture.set_fault(fault);
        fixture.sample(ms).unwrap();
        fixture.session.contradictions()
    };
    assert_eq!(
        [LinkFault::None, LinkFault::Duplicated].map(|fault| sample(fault, 0)),
        [0, 0],
        "duplicated by the line"
    );
    assert!((1..=300).all(|number| sample(LinkFault::Contradicting, number) == number));
    assert_eq!(sample(LinkFault::None, 301), 300);
    fixture.set_fault(LinkFault::None);
    fixture.session.start_trial(&CONFIGURE).unwrap();
    assert_eq!(fixture.session.contradictions(), 0);
}

#[test]
fn counts_no_contradiction_for_a_stop() {
    let mut fixture = start_trial();
    fixture.sample(0).unwrap();
    let stopped = fixture.session.advance_to(Duration::from_millis(5)).unwrap().unwrap();
    assert_eq!((stopped.state, fixture.session.contradictions()), (ControllerState::Fault, 0));
}

#[test]
fn repeats_the_request_for_0_v_without_an_answer() {
    let mut fixture = start_trial();
    fixture.sent.lock().unwrap().clear();
    fixture.set_fault(LinkFault::FlipAnswer);
    assert!(!fixture.session.request_safe_state());
    assert_eq!(*fixture.sent.lock().unwrap(), [Message::Safe; 3]);
}

struct BabblingLink {
    device: HostedLink,
    until: Instant,
}

impl Link for BabblingLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.device.exchange(now, bytes, answer)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.device.advance_to(now, received)
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        Some(self)
    }
}

impl RealTimeLine for BabblingLink {
    fn send(&mut self, _bytes: &[u8]) -> Result<(), LinkError> {
        Ok(())
    }

    fn receive(&mut self, _until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        let now = Instant::now();
        if now > self.until {
            return Err(LinkError::Disconnected("received for too long".to_owned()));
        }
        bytes.extend_from_slice(&[1, 2, 3, 0].repeat(8));
        Ok(Some(now))
    }
}

#[test]
fn ends_a_wait_on_a_line_full_of_garbage() {
    let now = Instant::now();
    let mut session =
        Session::open(BabblingLink { device: HostedLink::new(), until: now + Duration::from_secs(10) }).unwrap();
    let capacity = session.bytes.capacity();
    assert_eq!(session.receive(now + Duration::from_millis(20)).unwrap(), None);
    assert!(session.rejected_frames() >= 8);
    assert_eq!(session.bytes.capacity(), capacity);
}

#[test]
fn filters_commands_by_sequence_number() {
    let is_new = |sent, last, sequence, state| {
        CommandFilter { last_sent: sent, last_command: last }
            .new_command(&Packet { sequence, message: Message::Command(command(state, 0.0)) })
            .is_some()
    };
    for (sent, last) in [(7, 5), (1, 255), (0, 254)] {
        let at = |offset: i8| is_new(sent, last, last.wrapping_add_signed(offset), ControllerState::Running);
        assert_eq!([-1, 0, 1, 2, 3].map(at), [false, false, true, true, false], "{sent} {last}");
        assert!(
            is_new(sent, last, last, ControllerState::Fault)
                && !is_new(sent, last, last.wrapping_sub(1), ControllerState::Fault)
        );
    }
    assert!(
        CommandFilter { last_sent: 7, last_command: 5 }
            .new_command(&Packet { sequence: 7, message: Message::Hello })
            .is_none()
    );
}

#[test]
fn counts_requests_for_0_v_that_were_ignored() {
    let mut fixture = start_trial();
    assert!(fixture.session.request_safe_state());
    assert_eq!(fixture.session.ignored_safe_requests(), 0);
    fixture.set_fault(LinkFault::Silent);
    assert!(!fixture.session.request_safe_state());
    assert_eq!(fixture.session.ignored_safe_requests(), 0);
    fixture.set_fault(LinkFault::IgnoresSafe);
    assert!(!fixture.session.request_safe_state());
    assert_eq!(fixture.session.ignored_safe_requests(), 1);
    fixture.session.start_trial(&CONFIGURE).unwrap();
    assert_eq!(fixture.session.ignored_safe_requests(), 0);
}

#[test]
fn counts_drives_after_0_v_was_confirmed() {
    let late_driver = FakeLink::new(|device, now, bytes, queued| {
        let safe = first_packet(bytes).filter(|packet| packet.message == Message::Safe);
        queued
            .extend(safe.map(|safe| command_frame(safe.sequence, ControllerState::Running, 100.0)).unwrap_or_default());
        Ok(true_answer(device, now, bytes))
    });
    let mut session = Session::open(late_driver).unwrap();
    assert!(session.request_safe_state());
    assert_eq!(session.observe_safe_state(), Some(DrivesAfterSafe { count: 1, worst_vpp: 100.0 }));
    assert!(matches!(session.close(), SafeEnd::Driven(_)));
}

#[test]
fn counts_a_drive_that_a_sample_causes_after_0_v() {
    // This controller leaves the state *safe*: it configures itself again before each sample.
    let restarting = FakeLink::new(|device, now, bytes, _| {
        if matches!(first_packet(bytes), Some(Packet { message: Message::Sample(_), .. })) {
            let configure = Packet { sequence: 0, message: Message::Configure(CONFIGURE) };
            true_answer(device, now, configure.encode().as_bytes());
        }
        Ok(true_answer(device, now, bytes))
    });
    let drives = |mut session: Session<BoxedLink>| {
        assert!(session.request_safe_state());
        session.send_sample(Duration::ZERO, &AT_REST).unwrap();
        let drives = session.observe_safe_state().map_or(0, |drives| drives.count);
        session.start_trial(&CONFIGURE).unwrap();
        session.send_sample(Duration::ZERO, &AT_REST).unwrap();
        (drives, session.observe_safe_state().map_or(0, |drives| drives.count))
    };
    let open = |link: BoxedLink| Session::open(link).unwrap();
    assert_eq!(drives(open(Box::new(restarting))), (1, 0));
    assert_eq!(drives(open(Box::<HostedLink>::default())), (0, 0));
}

/// Messages that a controller sends besides its answers.
#[derive(Clone, Copy, PartialEq)]
enum Chatter {
    /// Sends each answer twice.
    Doubled,
    /// Reports 0 V under the number of each sample, besides the answer.
    SafeForSample,
    /// Confirms 0 V before it is requested, and never afterwards.
    SafeBeforeRequest,
    /// Answers the request for 0 V with a drive, then confirms 0 V.
    DriveThenSafe,
    /// Confirms 0 V under the number of the last sample.
    SafeWithOldNumber,
    /// Commands a drive under the number of the configuration.
    DriveForConfiguration,
    /// Confirms 0 V under the number of the configuration.
    SafeForConfiguration,
}

#[expect(clippy::type_complexity, reason = "the closure has no name")]
fn chatty_session(
    chatter: Chatter,
) -> Session<FakeLink<impl FnMut(&mut HostedLink, Duration, &[u8], &mut Vec<u8>) -> Answer + Send>> {
    let link = FakeLink::new(move |device, now, bytes, queued| {
        let own = true_answer(device, now, bytes);
        let Some(request) = first_packet(bytes) else { return Ok(own) };
        let (safe, number) = (ControllerState::Safe, request.sequence);
        let drive = |vpp| command_frame(number, ControllerState::Running, vpp);
        Ok(match (chatter, request.message) {
            (Chatter::Doubled, _) => own.repeat(2),
            (Chatter::SafeForSample, Message::Sample(_)) | (Chatter::SafeForConfiguration, Message::Configure(_)) => {
                [own, command_frame(number, safe, 0.0)].concat()
            }
            (Chatter::SafeBeforeRequest, Message::Sample(_)) => {
                *queued = command_frame(number.wrapping_add(1), safe, 0.0);
                own
            }
            (Chatter::SafeBeforeRequest, Message::Safe) => Vec::new(),
            (Chatter::DriveThenSafe, Message::Safe) => [drive(400.0), own].concat(),
            // The number of the sample, after those of hello and configuration.
            (Chatter::SafeWithOldNumber, Message::Safe) => command_frame(3, safe, 0.0),
            (Chatter::DriveForConfiguration, Message::Configure(_)) => [own, drive(900.0)].concat(),
            _ => own,
        })
    });
    let mut session = Session::open(link).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    session.send_sample(Duration::ZERO, &AT_REST).unwrap().unwrap();
    session
}

#[test]
fn doubled_answers_are_no_invented_confirmation() {
    let mut session = chatty_session(Chatter::Doubled);
    assert!(session.request_safe_state());
    session.send_sample(Duration::from_millis(1), &AT_REST).unwrap().unwrap();
    // The configuration, the sample, the request for 0 V, and the sample in the state *safe*.
    assert_eq!((session.second_replies(), session.contradictions()), (4, 0));
    assert_eq!((session.unrequested_confirmations(), session.observe_safe_state()), (0, None));
}

#[test]
fn an_invented_confirmation_is_no_second_answer() {
    for chatter in [Chatter::SafeForSample, Chatter::SafeBeforeRequest, Chatter::SafeWithOldNumber] {
        let mut session = chatty_session(chatter);
        let confirmed = session.request_safe_state();
        assert_eq!(confirmed, chatter == Chatter::SafeForSample);
        assert!(session.unrequested_confirmations() > 0);
        assert_eq!((session.second_replies(), session.contradictions()), (0, 0));
    }
}

#[test]
fn a_command_for_a_configuration_breaks_the_protocol() {
    let session = chatty_session(Chatter::DriveForConfiguration);
    assert_eq!((session.wrong_sequences(), session.unrequested_confirmations()), (1, 0));
    let session = chatty_session(Chatter::SafeForConfiguration);
    assert_eq!((session.wrong_sequences(), session.unrequested_confirmations()), (0, 1));
}

#[test]
fn the_first_answer_to_a_request_for_0_v_counts() {
    let mut session = chatty_session(Chatter::DriveThenSafe);
    assert!(!session.request_safe_state());
    assert_eq!((session.ignored_safe_requests(), session.contradictions()), (1, 1));
    assert_eq!(session.unrequested_confirmations(), 0);
}

#[test]
fn the_report_of_a_stop_is_no_second_answer() {
    let mut session = chatty_session(Chatter::SafeBeforeRequest);
    session.link_mut().queued.clear();
    let stopped = session.advance_to(Duration::from_millis(5)).unwrap().unwrap();
    assert_eq!(stopped.state, ControllerState::Fault);
    assert_eq!((session.second_replies(), session.contradictions(), session.unrequested_confirmations()), (0, 0, 0));
}
