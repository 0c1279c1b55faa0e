//! A port with something at its other end.

use super::{CONFIGURE, WITHIN, sample};
use platebench_controller::Device;
use platebench_rig::{Link, LinkError, RigError, RigSpec, Serial, SerialError, Session};
use platebench_wire::{Identity, Message, State};
use rustix::fd::OwnedFd;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

const IDENTITY: Identity = Identity {
    version: [0, 1, 0],
    capabilities: 0,
    laws: 0b111,
    build: [0; 8],
    chip: 0,
    unique: [0; 12],
    name: *b"at the other end",
};

/// The other end of a cable, and the port at ours.
fn cable() -> (OwnedFd, PathBuf) {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let name = ptsname(&master, Vec::new()).unwrap().into_string().unwrap();
    (master, name.into())
}

/// A board that answers until its line is gone, each answer said `times` times.
fn board(master: OwnedFd, times: usize) {
    let mut line = File::from(master);
    let mut device = Device::new(IDENTITY);
    thread::spawn(move || {
        let since = Instant::now();
        let mut bytes = [0; 256];
        while let Ok(count @ 1..) = line.read(&mut bytes) {
            let mut answer = Vec::new();
            device.receive(&bytes[..count], since.elapsed().as_micros() as u32, |frame| {
                answer.extend(frame.repeat(times));
            });
            if line.write_all(&answer).is_err() {
                break;
            }
        }
    });
}

fn open(port: &Path) -> Serial {
    Serial::open(port, 1_000_000).unwrap()
}

#[test]
fn a_board_on_a_port_is_found_and_controls() {
    let (master, port) = cable();
    let serial = open(&port);
    board(master, 1);
    let mut session = Session::open(serial).unwrap();
    assert_eq!(session.identity(), &IDENTITY);
    session.begin(&CONFIGURE).unwrap();
    let reply = session.sample(Duration::ZERO, &sample(0)).unwrap().unwrap();
    assert_eq!(reply.command.state, State::Running);
    for step in 1..50 {
        let number = session.post(Message::Sample(sample(step))).unwrap();
        let heard = session.listen(Instant::now() + WITHIN).unwrap().unwrap();
        assert_eq!(heard.sequence, number);
    }
    assert!(session.safe());
    assert_eq!(session.refused(), 0);
}

#[test]
fn frames_that_come_together_are_told_one_by_one() {
    let (master, port) = cable();
    let serial = open(&port);
    board(master, 3);
    let mut session = Session::open(serial).unwrap();
    session.begin(&CONFIGURE).unwrap();
    let number = session.post(Message::Sample(sample(0))).unwrap();
    let mut heard = Vec::new();
    while heard.len() < 3 {
        let next = session.listen(Instant::now() + WITHIN).unwrap().unwrap();
        // Echoes of the handshake may still come.
        heard.extend(Some(next).filter(|heard| heard.sequence == number));
    }
    assert!(heard.windows(2).all(|pair| pair[0].message == pair[1].message && pair[0].at <= pair[1].at));
}

#[test]
fn a_port_in_use_names_its_holder_and_is_free_once_that_is_gone() {
    let (_master, port) = cable();
    let first = open(&port);
    let refused = Serial::open(&port, 1_000_000).unwrap_err();
    let SerialError::InUse { holder, .. } = &refused else { panic!("{refused:?}") };
    let told = holder.to_string();
    assert!(told.contains(&format!("process {}", std::process::id())) && told.contains("lines"), "{told}");
    let spec: RigSpec = format!("serial:{}", port.display()).parse().unwrap();
    let refused = spec.connect().err().unwrap();
    assert!(!refused.is_invalid_input(), "{refused}");
    drop(first);
    drop(open(&port));
}

#[test]
fn what_is_no_port_is_said() {
    let absent = Serial::open(Path::new("/dev/there-is-no-port"), 9_600).unwrap_err();
    assert!(matches!(absent, SerialError::Open { .. }), "{absent}");
    let null = Serial::open(Path::new("/dev/null"), 9_600).unwrap_err();
    assert_eq!(null.to_string(), "/dev/null is not a serial port");
    let folder = Serial::open(Path::new("/dev"), 9_600).unwrap_err();
    assert_eq!(folder.to_string(), "/dev is not a serial port");
    let error = |text: &str| text.parse::<RigSpec>().unwrap().connect().err().unwrap();
    assert!(!error("serial:/dev/there-is-no-port").is_invalid_input(), "unplugged is not mistyped");
    assert!(error("serial:/dev/null@9600").is_invalid_input());
}

#[test]
fn a_line_that_hangs_up_is_lost_whatever_is_done_with_it() {
    let (master, port) = cable();
    let mut serial = open(&port);
    drop(master);
    let mut bytes = Vec::new();
    let far = Instant::now() + WITHIN;
    assert!(matches!(serial.line().unwrap().receive(far, &mut bytes), Err(LinkError::Disconnected(_))));
    assert!(matches!(serial.line().unwrap().send(b"x"), Err(LinkError::Disconnected(_))));
    assert!(matches!(serial.exchange(Duration::ZERO, b"x", &mut bytes), Err(LinkError::Disconnected(_))));
    assert!(matches!(serial.pass(Duration::ZERO, &mut bytes), Err(LinkError::Disconnected(_))));
    assert!(Instant::now() < far, "noticed, not waited for");
    assert_eq!(bytes, []);
}

#[test]
fn silence_is_no_answer_and_ends() {
    let (_master, port) = cable();
    assert!(matches!(Session::open(open(&port)), Err(RigError::NoAnswer { expected: "identity" })));
}

#[test]
fn what_a_port_held_from_before_is_thrown_away() {
    let (master, port) = cable();
    let keeps_the_line = open(&port);
    rustix::io::write(&master, b"from before").unwrap();
    drop(keeps_the_line);
    let mut serial = open(&port);
    let mut bytes = Vec::new();
    serial.pass(Duration::ZERO, &mut bytes).unwrap();
    assert_eq!(bytes, []);
    rustix::io::write(&master, b"now").unwrap();
    assert!(serial.line().unwrap().receive(Instant::now() + WITHIN, &mut bytes).unwrap().is_some());
    assert_eq!(bytes, b"now");
}

#[test]
fn a_line_that_takes_nothing_and_one_that_babbles_hold_nobody_up() {
    let (master, port) = cable();
    let mut serial = open(&port);
    // Far more than a pseudo-terminal holds.
    for _ in 0..10_000 {
        serial.line().unwrap().send(&[0x55; 24]).unwrap();
    }
    drop(serial);

    let serial = open(&port);
    let babbler = File::from(master);
    let mut reader = babbler.try_clone().unwrap();
    thread::spawn(move || while (&babbler).write_all(&[1, 2, 3, 0].repeat(16)).is_ok() {});
    thread::spawn(move || while reader.read(&mut [0; 256]).is_ok_and(|count| count > 0) {});
    let far = Instant::now() + WITHIN;
    assert!(matches!(Session::open(serial), Err(RigError::NoAnswer { .. })));
    assert!(Instant::now() < far);
}
