//! Tests a session over a hosted controller, and over links with faults.

use super::*;
use crate::link::{BoxedLink, LinkError, RealTimeLine};
use crate::rigs::hosted::HostedLink;
use platebench_test_kit::CONFIGURE;
use platebench_wire::{LawId, Rejection, StateCause};
use std::sync::{Arc, Mutex};

const AT_REST: Sample = Sample { time_us: 0, setpoint_um: 2.0, wd_um: 0.0, wq_um: 0.0 };

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

struct FaultyDevice {
    device: HostedLink,
    fault: Arc<Mutex<LinkFault>>,
    sent: Arc<Mutex<Vec<Message>>>,
    previous_answer: Vec<u8>,
}

impl Link for FaultyDevice {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let fault = *self.fault.lock().unwrap();
        if fault == LinkFault::Disconnected {
            return Err(LinkError::Disconnected("unplugged".to_owned()));
        }
        let mut reader = PacketReader::new();
        let messages = reader.packets(bytes).map(|packet| packet.unwrap().message);
        self.sent.lock().unwrap().extend(messages);
        let mut real = Vec::new();
        let delay = self.device.exchange(now, bytes, &mut real)?;
        match fault {
            LinkFault::Silent => {}
            LinkFault::FlipAnswer => {
                real[5] ^= 4;
                answer.extend(&real);
            }
            LinkFault::PreviousAnswer => answer.extend(&self.previous_answer),
            LinkFault::Duplicated => answer.extend([&real[..], &real[..]].concat()),
            LinkFault::Contradicting => {
                answer.extend(&real);
                let mut packet = PacketReader::new().packets(&real).next().unwrap().unwrap();
                if let Message::Command(command) = &mut packet.message {
                    command.drive_vpp += 1.0;
                }
                answer.extend(packet.encode().as_bytes());
            }
            LinkFault::IgnoresSafe => {
                let mut packet = PacketReader::new().packets(&real).next().unwrap().unwrap();
                if let Message::Command(command) = &mut packet.message {
                    command.state = ControllerState::Running;
                }
                answer.extend(packet.encode().as_bytes());
            }
            _ => answer.extend(&real),
        }
        self.previous_answer = real;
        Ok(delay)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.device.advance_to(now, received)
    }
}

struct Fixture {
    session: Session<FaultyDevice>,
    fault: Arc<Mutex<LinkFault>>,
    sent: Arc<Mutex<Vec<Message>>>,
}

fn start_trial() -> Fixture {
    let fault = Arc::new(Mutex::new(LinkFault::None));
    let sent = Arc::new(Mutex::new(Vec::new()));
    let link = FaultyDevice {
        device: HostedLink::new(),
        fault: fault.clone(),
        sent: sent.clone(),
        previous_answer: Vec::new(),
    };
    let mut session = Session::open(link).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    Fixture { session, fault, sent }
}

#[test]
fn controls_with_the_hosted_device() {
    let mut fixture = start_trial();
    assert_eq!(fixture.session.firmware_name(), "platebench-host");
    assert!(LawId::ALL.into_iter().all(|law| fixture.session.identity().has_law(law)));
    let reply = fixture.session.send_sample(Duration::ZERO, &AT_REST).unwrap().unwrap();
    assert_eq!(reply.delay, Duration::ZERO);
    assert!(reply.command.drive_vpp > 500.0);
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
        fixture.session.send_sample(Duration::ZERO, &AT_REST).unwrap().unwrap();
        *fixture.fault.lock().unwrap() = fault;
        assert_eq!(fixture.session.send_sample(Duration::from_millis(1), &AT_REST).unwrap(), None);
        *fixture.fault.lock().unwrap() = LinkFault::None;
        assert!(fixture.session.send_sample(Duration::from_millis(2), &AT_REST).unwrap().is_some());
    }
}

#[test]
fn reports_a_lost_link_and_a_silent_controller() {
    let mut fixture = start_trial();
    *fixture.fault.lock().unwrap() = LinkFault::Disconnected;
    assert!(matches!(fixture.session.send_sample(Duration::ZERO, &AT_REST), Err(RigError::Link(_))));
    assert!(!fixture.session.request_safe_state());

    let fault = Arc::new(Mutex::new(LinkFault::Silent));
    let link = FaultyDevice { device: HostedLink::new(), fault, sent: Arc::default(), previous_answer: Vec::new() };
    assert!(matches!(Session::open(link), Err(RigError::NoAnswer { expected: "identity" })));
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
    fixture.session.send_sample(Duration::ZERO, &AT_REST).unwrap();
    assert_eq!(fixture.session.advance_to(Duration::from_micros(4_999)).unwrap(), None);
    let command = fixture.session.advance_to(Duration::from_millis(5)).unwrap().unwrap();
    assert_eq!((command.state, command.drive_vpp), (ControllerState::Fault, 0.0));
}

#[test]
fn requests_0_v_when_dropped() {
    let mut fixture = start_trial();
    fixture.session.send_sample(Duration::ZERO, &AT_REST).unwrap();
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
    *fixture.fault.lock().unwrap() = LinkFault::FlipAnswer;
    for _ in 0..3 {
        fixture.session.send_sample(Duration::ZERO, &AT_REST).unwrap();
    }
    assert_eq!(fixture.session.rejected_frames(), 3);
    *fixture.fault.lock().unwrap() = LinkFault::None;
    fixture.session.start_trial(&CONFIGURE).unwrap();
    assert_eq!(fixture.session.rejected_frames(), 0);
}

#[test]
fn counts_two_different_answers_to_one_sample() {
    let mut fixture = start_trial();
    let mut sample = |fault, ms| {
        *fixture.fault.lock().unwrap() = fault;
        fixture.session.send_sample(Duration::from_millis(ms), &AT_REST).unwrap().unwrap();
        fixture.session.contradictions()
    };
    assert_eq!(
        [LinkFault::None, LinkFault::Duplicated].map(|fault| sample(fault, 0)),
        [0, 0],
        "duplicated by the line"
    );
    assert!((1..=300).all(|number| sample(LinkFault::Contradicting, number) == number));
    assert_eq!(sample(LinkFault::None, 301), 300);
    *fixture.fault.lock().unwrap() = LinkFault::None;
    fixture.session.start_trial(&CONFIGURE).unwrap();
    assert_eq!(fixture.session.contradictions(), 0);
}

#[test]
fn counts_no_contradiction_for_a_stop() {
    let mut fixture = start_trial();
    fixture.session.send_sample(Duration::ZERO, &AT_REST).unwrap().unwrap();
    let stopped = fixture.session.advance_to(Duration::from_millis(5)).unwrap().unwrap();
    assert_eq!((stopped.state, fixture.session.contradictions()), (ControllerState::Fault, 0));
}

#[test]
fn repeats_the_request_for_0_v_without_an_answer() {
    let mut fixture = start_trial();
    fixture.sent.lock().unwrap().clear();
    *fixture.fault.lock().unwrap() = LinkFault::FlipAnswer;
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
    let command = |state| Command {
        target_time_us: 0,
        drive_vpp: 0.0,
        frequency_mhz: 0,
        state,
        cause: platebench_wire::StateCause::None,
        flags: 0,
        compute_us: 0,
    };
    let is_new = |sent, last, sequence, state| {
        CommandFilter { last_sent: sent, last_command: last }
            .new_command(&Packet { sequence, message: Message::Command(command(state)) })
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
    *fixture.fault.lock().unwrap() = LinkFault::Silent;
    assert!(!fixture.session.request_safe_state());
    assert_eq!(fixture.session.ignored_safe_requests(), 0);
    *fixture.fault.lock().unwrap() = LinkFault::IgnoresSafe;
    assert!(!fixture.session.request_safe_state());
    assert_eq!(fixture.session.ignored_safe_requests(), 1);
    fixture.session.start_trial(&CONFIGURE).unwrap();
    assert_eq!(fixture.session.ignored_safe_requests(), 0);
}

#[derive(Default)]
struct LateDriver {
    inner: HostedLink,
    safe_sequence: Option<u8>,
}

impl Link for LateDriver {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let mut reader = platebench_wire::PacketReader::new();
        let is_safe = |packet: &Packet| matches!(packet.message, Message::Safe);
        self.safe_sequence = reader.packets(bytes).flatten().find(is_safe).map(|packet| packet.sequence);
        self.inner.exchange(now, bytes, answer)
    }

    fn advance_to(&mut self, _: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        let Some(sequence) = self.safe_sequence.take() else { return Ok(()) };
        let command = Command {
            target_time_us: 0,
            drive_vpp: 100.0,
            frequency_mhz: 32_307_600,
            state: ControllerState::Running,
            cause: platebench_wire::StateCause::None,
            flags: 0,
            compute_us: 0,
        };
        received.extend_from_slice(Packet { sequence, message: Message::Command(command) }.encode().as_bytes());
        Ok(())
    }
}

#[test]
fn counts_drives_after_0_v_was_confirmed() {
    let mut session = Session::open(LateDriver::default()).unwrap();
    assert!(session.request_safe_state());
    assert_eq!(session.observe_safe_state(), Some(DrivesAfterSafe { count: 1, worst_vpp: 100.0 }));
    assert!(matches!(session.close(), SafeEnd::Driven(_)));
}

/// Controller that leaves the state *safe*: it configures itself again before each sample.
struct RestartsAfterSafe(HostedLink);

impl Link for RestartsAfterSafe {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let packet = PacketReader::new().packets(bytes).flatten().next();
        if matches!(packet, Some(Packet { message: Message::Sample(_), .. })) {
            let configure = Packet { sequence: 0, message: Message::Configure(CONFIGURE) };
            self.0.exchange(now, configure.encode().as_bytes(), &mut Vec::new())?;
        }
        self.0.exchange(now, bytes, answer)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.0.advance_to(now, received)
    }
}

#[test]
fn counts_a_drive_that_a_sample_causes_after_0_v() {
    let sample = Sample { time_us: 0, setpoint_um: 2.0, wd_um: 0.0, wq_um: 0.0 };
    let drives = |mut session: Session<BoxedLink>| {
        assert!(session.request_safe_state());
        session.send_sample(Duration::ZERO, &sample).unwrap();
        let drives = session.observe_safe_state().map_or(0, |drives| drives.count);
        session.start_trial(&CONFIGURE).unwrap();
        session.send_sample(Duration::ZERO, &sample).unwrap();
        (drives, session.observe_safe_state().map_or(0, |drives| drives.count))
    };
    let open = |link: BoxedLink| Session::open(link).unwrap();
    assert_eq!(drives(open(Box::new(RestartsAfterSafe(HostedLink::new())))), (1, 0));
    assert_eq!(drives(open(Box::<HostedLink>::default())), (0, 0));
}

/// Controller that sends something besides its answers.
struct ChattyDevice {
    inner: HostedLink,
    chatter: Chatter,
    /// Bytes that arrive between two requests.
    queued: Vec<u8>,
}

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

fn chatty_session(chatter: Chatter) -> Session<ChattyDevice> {
    let mut session = Session::open(ChattyDevice { inner: HostedLink::new(), chatter, queued: Vec::new() }).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    session
}

impl Link for ChattyDevice {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let mut own = Vec::new();
        let delay = self.inner.exchange(now, bytes, &mut own)?;
        answer.append(&mut self.queued);
        let Some(request) = PacketReader::new().packets(bytes).flatten().next() else { return Ok(delay) };
        let Some(reply) = PacketReader::new().packets(&own).flatten().next() else { return Ok(delay) };
        let command = |sequence: u8, state, drive_vpp| {
            let Message::Command(command) = reply.message else { return Vec::new() };
            let message = Message::Command(Command { state, drive_vpp, ..command });
            Packet { sequence, message }.encode().as_bytes().to_vec()
        };
        let (safe, number) = (ControllerState::Safe, request.sequence);
        let invented = |state, drive_vpp| {
            let command = Command {
                target_time_us: 0,
                drive_vpp,
                frequency_mhz: 32_300_000,
                state,
                cause: StateCause::None,
                flags: 0,
                compute_us: 0,
            };
            Packet { sequence: number, message: Message::Command(command) }.encode().as_bytes().to_vec()
        };
        match (self.chatter, request.message) {
            (Chatter::Doubled, _) => answer.extend([&own[..], &own[..]].concat()),
            (Chatter::SafeForSample, Message::Sample(_)) => {
                answer.extend(own);
                answer.extend(command(number, safe, 0.0));
            }
            (Chatter::SafeBeforeRequest, Message::Sample(_)) => {
                answer.extend(own);
                self.queued = command(number.wrapping_add(1), safe, 0.0);
            }
            (Chatter::SafeBeforeRequest, Message::Safe) => {}
            (Chatter::DriveThenSafe, Message::Safe) => {
                answer.extend(command(number, ControllerState::Running, 400.0));
                answer.extend(own);
            }
            (Chatter::SafeWithOldNumber, Message::Safe) => {
                // The number of the sample, after those of hello and configuration.
                answer.extend(command(3, safe, 0.0));
            }
            (Chatter::DriveForConfiguration, Message::Configure(_)) => {
                answer.extend([own, invented(ControllerState::Running, 900.0)].concat());
            }
            (Chatter::SafeForConfiguration, Message::Configure(_)) => {
                answer.extend([own, invented(safe, 0.0)].concat());
            }
            _ => answer.extend(own),
        }
        Ok(delay)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        received.append(&mut self.queued);
        self.inner.advance_to(now, received)
    }
}

#[test]
fn doubled_answers_are_no_invented_confirmation() {
    let mut session = chatty_session(Chatter::Doubled);
    session.send_sample(Duration::ZERO, &AT_REST).unwrap().unwrap();
    assert!(session.request_safe_state());
    session.send_sample(Duration::from_millis(1), &AT_REST).unwrap().unwrap();
    // The sample, the request for 0 V, and the sample in the state *safe*.
    assert_eq!((session.second_replies(), session.contradictions()), (3, 0));
    assert_eq!((session.unrequested_confirmations(), session.observe_safe_state()), (0, None));
}

#[test]
fn an_invented_confirmation_is_no_second_answer() {
    for chatter in [Chatter::SafeForSample, Chatter::SafeBeforeRequest, Chatter::SafeWithOldNumber] {
        let mut session = chatty_session(chatter);
        session.send_sample(Duration::ZERO, &AT_REST).unwrap().unwrap();
        let confirmed = session.request_safe_state();
        assert_eq!(confirmed, chatter == Chatter::SafeForSample);
        assert!(session.unrequested_confirmations() > 0);
        assert_eq!((session.second_replies(), session.contradictions()), (0, 0));
    }
}

#[test]
fn a_command_for_a_configuration_breaks_the_protocol() {
    let mut session = chatty_session(Chatter::DriveForConfiguration);
    session.send_sample(Duration::ZERO, &AT_REST).unwrap().unwrap();
    assert_eq!((session.wrong_sequences(), session.unrequested_confirmations()), (1, 0));
    let mut session = chatty_session(Chatter::SafeForConfiguration);
    session.send_sample(Duration::ZERO, &AT_REST).unwrap().unwrap();
    assert_eq!((session.wrong_sequences(), session.unrequested_confirmations()), (0, 1));
}

#[test]
fn the_first_answer_to_a_request_for_0_v_counts() {
    let mut session = chatty_session(Chatter::DriveThenSafe);
    session.send_sample(Duration::ZERO, &AT_REST).unwrap().unwrap();
    assert!(!session.request_safe_state());
    assert_eq!((session.ignored_safe_requests(), session.contradictions()), (1, 1));
    assert_eq!(session.unrequested_confirmations(), 0);
}

#[test]
fn the_report_of_a_stop_is_no_second_answer() {
    let mut session = chatty_session(Chatter::SafeBeforeRequest);
    session.send_sample(Duration::ZERO, &AT_REST).unwrap().unwrap();
    session.link_mut().queued.clear();
    let stopped = session.advance_to(Duration::from_millis(5)).unwrap().unwrap();
    assert_eq!(stopped.state, ControllerState::Fault);
    assert_eq!((session.second_replies(), session.contradictions(), session.unrequested_confirmations()), (0, 0, 0));
}
