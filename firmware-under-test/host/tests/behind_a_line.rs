//! Tests the program on a pseudo-terminal, as the bench uses it.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a panic fails the test")]

use platebench_rig::{ExecLink, HostedLink, Link, Session};
use platebench_test_kit::wave_sample as sample;
use platebench_wire::{Command, Configure, ControllerState, LawId, Message, Packet, Tick, capabilities};
use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process;
use std::time::{Duration, Instant};

const PROGRAM: &str = env!("CARGO_BIN_EXE_platebench-host-controller");

const CONFIGURE: Configure = Configure { watchdog_timeout_ms: 1_000, ..platebench_test_kit::CONFIGURE };

const TIMEOUT: Duration = Duration::from_secs(5);

fn start(log: Option<&Path>) -> ExecLink {
    let log = log.map_or_else(String::new, |file| format!(" --log '{}'", file.display()));
    ExecLink::start(&format!("'{PROGRAM}' {{port}}{log}")).unwrap()
}

fn acting_bits(command: &Command) -> (u32, u32, ControllerState, u8) {
    (command.drive_vpp.to_bits(), command.frequency_mhz, command.state, command.flags)
}

#[test]
fn the_identity_holds_the_source_hash() {
    let session = Session::open(start(None)).unwrap();
    assert_eq!(session.firmware_name(), "platebench-host");
    let identity = session.identity();
    assert!(identity.has_capability(capabilities::TARGET_PACED) && identity.has_capability(capabilities::COMPUTE_TIME));
    assert!(LawId::ALL.into_iter().all(|law| identity.has_law(law)));
    assert_ne!(identity.build, [0; 8]);
    assert_eq!(identity.chip, 0);
}

#[test]
fn lockstep_commands_equal_the_hosted_controller_s() {
    let mut program = Session::open(start(None)).unwrap();
    let mut hosted = Session::open(HostedLink::new()).unwrap();
    for law in LawId::ALL {
        let configure = Configure { law, ..CONFIGURE };
        assert_eq!(program.start_trial(&configure).unwrap(), hosted.start_trial(&configure).unwrap());
        for step in 0..100 {
            let now = Duration::from_millis(step.into());
            let replies =
                [&program.send_sample(now, &sample(step)).unwrap(), &hosted.send_sample(now, &sample(step)).unwrap()]
                    .map(|reply| acting_bits(&reply.as_ref().unwrap().command));
            assert_eq!(replies[0], replies[1], "{} step {step}", law.name());
        }
        assert!(program.request_safe_state());
        hosted.request_safe_state();
    }
    assert_eq!(program.rejected_frames(), 0);
}

#[test]
fn real_time_answers_repeat_the_sequence_number() {
    let mut session = Session::open(start(None)).unwrap();
    assert!(session.supports_real_time());
    session.start_trial(&CONFIGURE).unwrap();
    for step in 0..300 {
        let sent_at = Instant::now();
        let number = session.send(Message::Sample(sample(step))).unwrap();
        let received = session.receive(sent_at + TIMEOUT).unwrap().unwrap();
        assert_eq!(received.sequence, number);
        assert!(received.received_at >= sent_at);
        let Message::Command(command) = received.message else { panic!("{received:?}") };
        assert_eq!(command.state, ControllerState::Running);
        assert!(step == 0 || command.compute_us > 0);
    }
    assert_eq!(session.receive(Instant::now()).unwrap(), None);
    assert!(session.request_safe_state());
}

#[test]
fn target_pacing_sends_ticks_until_safe() {
    let mut session = Session::open(start(None)).unwrap();
    session.start_trial(&Configure { paced_by_target: true, ..CONFIGURE }).unwrap();
    let (mut ticks, mut last_us) = (0_u8, 0);
    // On a busy machine ticks may arrive with the answer to the configuration, and answers late.
    let mut last_sequence: Option<u8> = None;
    let mut unanswered = BTreeSet::new();
    while ticks < 50 || unanswered.len() > 1 {
        let received = session.receive(Instant::now() + TIMEOUT).unwrap().unwrap();
        match received.message {
            Message::Tick(Tick { target_time_us }) => {
                ticks += 1;
                assert!(ticks < 200, "no answer to {unanswered:?}");
                assert!(last_sequence.is_none_or(|last| received.sequence == last + 1), "{last_sequence:?}");
                last_sequence = Some(received.sequence);
                assert!(target_time_us > last_us);
                last_us = target_time_us;
                let sequence = session.send(Message::Sample(sample(ticks.into()))).unwrap();
                if ticks <= 50 {
                    unanswered.insert(sequence);
                }
            }
            Message::Command(command) => {
                unanswered.remove(&received.sequence);
                assert_eq!(command.state, ControllerState::Running);
            }
            other => panic!("{other:?}"),
        }
    }
    assert!(session.request_safe_state());
    while session.receive(Instant::now()).unwrap().is_some() {}
    assert_eq!(session.receive(Instant::now() + Duration::from_millis(20)).unwrap(), None);
}

#[test]
fn a_lost_bench_leads_to_0_v_and_ends_the_program() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("with spaces.jsonl");
    let mut line = start(Some(&log));
    let mut answer = Vec::new();
    let messages = [Message::Configure(Configure { watchdog_timeout_ms: 0, ..CONFIGURE }), Message::Sample(sample(0))];
    for (sequence, message) in (1..).zip(messages) {
        line.exchange(Duration::ZERO, Packet { sequence, message }.encode().as_bytes(), &mut answer).unwrap();
    }
    // Closes the line without a request for 0 V, as after SIGKILL.
    drop(line);
    let log_text = fs::read_to_string(&log).unwrap();
    let field = |line: &str, name: &str| {
        let rest = line.split_once(&format!("\"{name}\":")).unwrap().1;
        rest.split([',', '}']).next().unwrap().trim_matches('"').to_owned()
    };
    let events: Vec<_> = log_text.lines().map(|line| [field(line, "event"), field(line, "state")].join(" ")).collect();
    // On a busy machine the drive may go to 0 V before the program detects the hang-up.
    let mut sorted = events.clone();
    sorted.sort();
    assert_eq!(sorted.len(), 5, "{log_text}");
    assert_eq!(events[..2], ["start idle", "state running"], "{log_text}");
    assert_eq!(events[4], "end fault", "{log_text}");
    assert!(events.contains(&"state fault".to_owned()) && log_text.contains("\"event\":\"hang-up\""), "{log_text}");
    let end = log_text.lines().last().unwrap();
    assert_eq!((field(end, "drive_vpp"), field(end, "cause")), ("0".to_owned(), "sample-timeout".to_owned()));
    let stop = log_text.lines().find(|line| line.contains("\"state\":\"fault\"")).unwrap();
    assert!(field(stop, "since_sample_us").parse::<u32>().unwrap() >= 5_000, "{log_text}");
    assert!(log_text.lines().nth(1).unwrap().contains("\"event\":\"state\""));
}

#[test]
fn a_killed_program_is_a_lost_rig() {
    let mut session = Session::open(start(None)).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    let pid = session.link().process_id().to_string();
    assert!(process::Command::new("kill").args(["-9", &pid]).status().unwrap().success());
    let error = loop {
        if let Err(error) = session.send_sample(Duration::ZERO, &sample(0)) {
            break error.to_string();
        }
    };
    assert!(error.ends_with("was ended by signal 9"), "{error}");
    // A pseudo-terminal accepts bytes without a reader, so only a receive detects the lost program.
    let _ = session.send(Message::Hello);
    assert!(session.receive(Instant::now() + TIMEOUT).is_err());
    assert!(!session.request_safe_state());
}
