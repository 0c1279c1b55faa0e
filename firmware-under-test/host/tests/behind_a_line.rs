//! The program as the bench reaches it: on a pseudo-terminal.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on ends by panicking")]

use platebench_rig::{Exec, Hosted, Link, Session};
use platebench_wire::{Command, Configure, LawId, Message, Packet, Sample, State, Tick, capabilities};
use std::fs;
use std::path::Path;
use std::process;
use std::time::{Duration, Instant};

const PROGRAM: &str = env!("CARGO_BIN_EXE_platebench-host-controller");

const CONFIGURE: Configure = Configure {
    law: LawId::DqPi,
    paced_by_target: false,
    drives_own_plate: false,
    patience_ms: 1_000,
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

/// The controller on a busy machine may come late, but it comes.
const WITHIN: Duration = Duration::from_secs(5);

fn start(log: Option<&Path>) -> Exec {
    let log = log.map_or_else(String::new, |file| format!(" --log '{}'", file.display()));
    Exec::start(&format!("'{PROGRAM}' {{port}}{log}")).unwrap()
}

fn sample(step: u32) -> Sample {
    let wave = (step as f32 * 0.7).sin();
    Sample { time_us: step * 1_000, setpoint_um: 2.0, wd_um: 1.5 + wave, wq_um: 0.3 * wave }
}

/// What acts on the plate; instants and computing times are the target's own.
fn acting(command: &Command) -> (u32, u32, State, u8) {
    (command.drive_vpp.to_bits(), command.frequency_mhz, command.state, command.flags)
}

#[test]
fn it_introduces_itself_and_says_what_it_is_built_from() {
    let session = Session::open(start(None)).unwrap();
    assert_eq!(session.firmware_name(), "platebench-host");
    let identity = session.identity();
    assert!(identity.can(capabilities::TARGET_PACED) && identity.can(capabilities::MEASURES_COMPUTING));
    assert!(LawId::ALL.into_iter().all(|law| identity.has(law)));
    assert_ne!(identity.build, [0; 8]);
    assert_eq!(identity.chip, 0);
}

#[test]
fn in_lockstep_it_drives_as_the_controller_in_process_does() {
    let mut program = Session::open(start(None)).unwrap();
    let mut hosted = Session::open(Hosted::new()).unwrap();
    for law in LawId::ALL {
        let configure = Configure { law, ..CONFIGURE };
        assert_eq!(program.begin(&configure).unwrap(), hosted.begin(&configure).unwrap());
        for step in 0..100 {
            let now = Duration::from_millis(step.into());
            let replies = [&program.sample(now, &sample(step)).unwrap(), &hosted.sample(now, &sample(step)).unwrap()]
                .map(|reply| acting(&reply.as_ref().unwrap().command));
            assert_eq!(replies[0], replies[1], "{} step {step}", law.name());
        }
        assert!(program.safe());
        hosted.safe();
    }
    assert_eq!(program.refused(), 0);
}

#[test]
fn in_real_time_every_sample_is_answered_under_its_number() {
    let mut session = Session::open(start(None)).unwrap();
    assert!(session.is_live());
    session.begin(&CONFIGURE).unwrap();
    for step in 0..300 {
        let posted = Instant::now();
        let number = session.post(Message::Sample(sample(step))).unwrap();
        let heard = session.listen(posted + WITHIN).unwrap().unwrap();
        assert_eq!(heard.sequence, number);
        assert!(heard.at >= posted);
        let Message::Command(command) = heard.message else { panic!("{heard:?}") };
        assert_eq!(command.state, State::Running);
        assert!(step == 0 || command.compute_us > 0);
    }
    // Nothing more is there, and nobody waits for it.
    assert_eq!(session.listen(Instant::now()).unwrap(), None);
    assert!(session.safe());
}

#[test]
fn paced_by_itself_it_asks_for_samples_until_it_is_safe() {
    let mut session = Session::open(start(None)).unwrap();
    session.begin(&Configure { paced_by_target: true, ..CONFIGURE }).unwrap();
    let (mut ticks, mut commands, mut last_us) = (0_u8, 0, 0);
    while ticks < 50 {
        let heard = session.listen(Instant::now() + WITHIN).unwrap().unwrap();
        match heard.message {
            Message::Tick(Tick { target_time_us }) => {
                ticks += 1;
                assert_eq!(heard.sequence, ticks);
                assert!(target_time_us > last_us);
                last_us = target_time_us;
                session.post(Message::Sample(sample(ticks.into()))).unwrap();
            }
            Message::Command(command) => {
                commands += 1;
                assert_eq!(command.state, State::Running);
            }
            other => panic!("{other:?}"),
        }
    }
    assert!(commands >= 49, "{commands}");
    assert!(session.safe());
    while session.listen(Instant::now()).unwrap().is_some() {}
    assert_eq!(session.listen(Instant::now() + Duration::from_millis(20)).unwrap(), None);
}

#[test]
fn a_bench_that_is_gone_leaves_zero_volts_and_a_program_that_ends() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("what it did.jsonl");
    let mut line = start(Some(&log));
    let mut answer = Vec::new();
    let messages = [Message::Configure(Configure { patience_ms: 0, ..CONFIGURE }), Message::Sample(sample(0))];
    for (sequence, message) in (1..).zip(messages) {
        line.exchange(Duration::ZERO, Packet { sequence, message }.encode().as_bytes(), &mut answer).unwrap();
    }
    // Without asking for 0 V: as after SIGKILL.
    drop(line);
    let told = fs::read_to_string(&log).unwrap();
    let field = |line: &str, name: &str| {
        let rest = line.split_once(&format!("\"{name}\":")).unwrap().1;
        rest.split([',', '}']).next().unwrap().trim_matches('"').to_owned()
    };
    let events: Vec<_> = told.lines().map(|line| [field(line, "event"), field(line, "state")].join(" ")).collect();
    // Where the machine is busy, the drive may go to 0 V before the program sees that its line has hung up.
    let mut sorted = events.clone();
    sorted.sort();
    assert_eq!(sorted.len(), 5, "{told}");
    assert_eq!(events[..2], ["start idle", "state running"], "{told}");
    assert_eq!(events[4], "end fault", "{told}");
    assert!(events.contains(&"state fault".to_owned()) && told.contains("\"event\":\"hang-up\""), "{told}");
    let end = told.lines().last().unwrap();
    assert_eq!((field(end, "drive_vpp"), field(end, "cause")), ("0".to_owned(), "sample-timeout".to_owned()));
    let stop = told.lines().find(|line| line.contains("\"state\":\"fault\"")).unwrap();
    assert!(field(stop, "since_sample_us").parse::<u32>().unwrap() >= 5_000, "{told}");
    assert!(told.lines().nth(1).unwrap().contains("\"event\":\"state\""));
}

#[test]
fn a_program_that_is_killed_is_a_lost_rig() {
    let mut session = Session::open(start(None)).unwrap();
    session.begin(&CONFIGURE).unwrap();
    let pid = session.link().process_id().to_string();
    assert!(process::Command::new("kill").args(["-9", &pid]).status().unwrap().success());
    let error = loop {
        if let Err(error) = session.sample(Duration::ZERO, &sample(0)) {
            break error.to_string();
        }
    };
    assert!(error.ends_with("was ended by signal 9"), "{error}");
    // A pseudo-terminal takes bytes for nobody; that nobody is there shows when listening.
    let _ = session.post(Message::Hello);
    assert!(session.listen(Instant::now() + WITHIN).is_err());
    assert!(!session.safe());
}

#[test]
fn a_port_or_a_log_that_cannot_be_opened_is_said() {
    let output = process::Command::new(PROGRAM).arg("/dev/there-is-no-port").output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("cannot open /dev/there-is-no-port"), "{said}");

    let output = process::Command::new(PROGRAM).arg("/dev/null").output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8(output.stderr).unwrap().contains("/dev/null cannot be set to 1000000 baud"));

    let output = process::Command::new(PROGRAM).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
}
