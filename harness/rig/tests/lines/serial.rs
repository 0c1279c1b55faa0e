//! Tests serial ports with a pseudo-terminal as the cable.

use super::{CONFIGURE, RECEIVE_TIMEOUT, sample};
use platebench_rig::{Link, LinkError, RigError, RigSpec, SerialError, SerialLink, Session};
use platebench_test_kit::{IDENTITY, answer_line, open_terminal};
use platebench_wire::{ControllerState, Message};
use rstest::rstest;
use std::fs::File;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

fn cable() -> (File, PathBuf) {
    let (master, path) = open_terminal();
    (master, path.into())
}

fn board(line: File, copies: usize) {
    thread::spawn(move || answer_line(line.try_clone().unwrap(), line, copies));
}

fn open(port: &Path) -> SerialLink {
    SerialLink::open(port, 1_000_000).unwrap()
}

#[test]
fn controls_with_a_board_on_a_port() {
    let (master, port) = cable();
    let serial = open(&port);
    board(master, 1);
    let mut session = Session::open(serial).unwrap();
    assert_eq!(session.identity(), &IDENTITY);
    session.start_trial(&CONFIGURE).unwrap();
    let reply = session.send_sample(Duration::ZERO, &sample(0)).unwrap().unwrap();
    assert_eq!(reply.command.state, ControllerState::Running);
    for step in 1..50 {
        let number = session.send(Message::Sample(sample(step))).unwrap();
        let received = session.receive(Instant::now() + RECEIVE_TIMEOUT).unwrap().unwrap();
        assert_eq!(received.sequence, number);
    }
    assert!(session.request_safe_state());
    assert_eq!(session.rejected_frames(), 0);
}

#[test]
fn returns_frames_one_by_one() {
    let (master, port) = cable();
    let serial = open(&port);
    board(master, 3);
    let mut session = Session::open(serial).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    let number = session.send(Message::Sample(sample(0))).unwrap();
    let mut received = Vec::new();
    while received.len() < 3 {
        let next = session.receive(Instant::now() + RECEIVE_TIMEOUT).unwrap().unwrap();
        // Repeated answers to the handshake may still arrive.
        received.extend(Some(next).filter(|received| received.sequence == number));
    }
    assert!(
        received
            .windows(2)
            .all(|pair| pair[0].message == pair[1].message && pair[0].received_at <= pair[1].received_at)
    );
}

#[test]
fn names_the_holder_of_a_port_in_use() {
    let (_master, port) = cable();
    let first = open(&port);
    let refused = SerialLink::open(&port, 1_000_000).unwrap_err();
    let SerialError::InUse { holder, .. } = &refused else { panic!("{refused:?}") };
    let text = holder.to_string();
    assert!(text.contains(&format!("process {}", std::process::id())) && text.contains("lines"), "{text}");
    let spec: RigSpec = format!("serial:{}", port.display()).parse().unwrap();
    let refused = spec.connect().err().unwrap();
    assert!(!refused.is_invalid_input(), "{refused}");
    drop(first);
    drop(open(&port));
}

#[test]
fn rejects_other_files_and_missing_ports() {
    let absent = SerialLink::open(Path::new("/dev/there-is-no-port"), 9_600).unwrap_err();
    assert!(matches!(absent, SerialError::Open { .. }), "{absent}");
    let null = SerialLink::open(Path::new("/dev/null"), 9_600).unwrap_err();
    assert_eq!(null.to_string(), "/dev/null is not a serial port");
    let folder = SerialLink::open(Path::new("/dev"), 9_600).unwrap_err();
    assert_eq!(folder.to_string(), "/dev is not a serial port");
    let error = |text: &str| text.parse::<RigSpec>().unwrap().connect().err().unwrap();
    assert!(!error("serial:/dev/there-is-no-port").is_invalid_input(), "unplugged, not invalid input");
    assert!(error("serial:/dev/null@9600").is_invalid_input());
}

#[test]
fn reports_a_line_that_hung_up_on_every_call() {
    let (master, port) = cable();
    let mut serial = open(&port);
    drop(master);
    let mut bytes = Vec::new();
    let far = Instant::now() + RECEIVE_TIMEOUT;
    assert!(matches!(serial.real_time_line().unwrap().receive(far, &mut bytes), Err(LinkError::Disconnected(_))));
    assert!(matches!(serial.real_time_line().unwrap().send(b"x"), Err(LinkError::Disconnected(_))));
    assert!(matches!(serial.exchange(Duration::ZERO, b"x", &mut bytes), Err(LinkError::Disconnected(_))));
    assert!(matches!(serial.advance_to(Duration::ZERO, &mut bytes), Err(LinkError::Disconnected(_))));
    assert!(Instant::now() < far, "the wait did not end early");
    assert!(bytes.is_empty(), "{bytes:?}");
}

#[test]
fn ends_the_handshake_with_a_silent_port() {
    let (_master, port) = cable();
    let error = Session::open(open(&port)).unwrap_err();
    assert!(matches!(error, RigError::NoIdentity { .. }), "{error}");
    assert!(error.to_string().contains("no byte was rejected"), "{error}");
}

/// Board that does not read while it starts, sends `greeting` and loses earlier bytes. Half a frame
/// of an earlier session is before the first hello.
#[rstest]
#[case::noise(&[0x55, 0, 9, 0xff])]
#[case::a_banner(b"platebench 1.0\r\nready")]
#[case::half_a_frame(&[4, 22, 3, 210])]
fn finds_a_board_that_starts_with_other_bytes(#[case] greeting: &'static [u8]) {
    let (master, port) = cable();
    let serial = open(&port);
    thread::spawn(move || {
        let mut lost = [0; 256];
        let mut line = &master;
        let count = line.read(&mut lost).unwrap();
        assert!(count > 0);
        line.write_all(greeting).unwrap();
        let reader = io::Cursor::new([9, 3]).chain(master.try_clone().unwrap());
        answer_line(reader, master, 1);
    });
    let mut session = Session::open(serial).unwrap();
    assert_eq!(session.identity(), &IDENTITY);
    session.start_trial(&CONFIGURE).unwrap();
    assert!(session.send_sample(Duration::ZERO, &sample(0)).unwrap().is_some());
    assert_eq!((session.rejected_frames(), session.second_replies()), (0, 0));
    assert!(session.request_safe_state());
}

#[test]
fn discards_bytes_from_before_the_opening() {
    let (master, port) = cable();
    let first = open(&port);
    rustix::io::write(&master, b"from before").unwrap();
    drop(first);
    let mut serial = open(&port);
    let mut bytes = Vec::new();
    serial.advance_to(Duration::ZERO, &mut bytes).unwrap();
    assert!(bytes.is_empty(), "{bytes:?}");
    rustix::io::write(&master, b"now").unwrap();
    assert!(serial.real_time_line().unwrap().receive(Instant::now() + RECEIVE_TIMEOUT, &mut bytes).unwrap().is_some());
    assert_eq!(bytes, b"now");
}

#[test]
fn ends_waits_on_a_full_line_and_on_garbage() {
    let (master, port) = cable();
    let mut serial = open(&port);
    // The samples are more than a pseudo-terminal holds.
    for _ in 0..10_000 {
        serial.real_time_line().unwrap().send(&[0x55; 24]).unwrap();
    }
    drop(serial);

    let serial = open(&port);
    let mut reader = master.try_clone().unwrap();
    thread::spawn(move || while (&master).write_all(&[1, 2, 3, 0].repeat(16)).is_ok() {});
    thread::spawn(move || while reader.read(&mut [0; 256]).is_ok_and(|count| count > 0) {});
    let far = Instant::now() + 6 * RECEIVE_TIMEOUT;
    assert!(matches!(Session::open(serial), Err(RigError::NoIdentity { .. })));
    assert!(Instant::now() < far);
}
