//! The wire protocol over the board's serial port: a pseudo-terminal with the emulated chip at its other end.

use crate::emulated::Bench;
use crate::image::{Program, Recipe};
use crate::talks::configure;
use crate::{patience, spec};
use platebench_rig::link::{Link, LinkError};
use platebench_rig::probe::{ProbeError, Setup};
use platebench_rig::{AnyLink, ConnectError, RigError, SerialError, Session, TargetFault, Terminal};
use platebench_wire::{Message, Sample, State};
use std::path::Path;
use std::sync::{Arc, Weak};
use std::thread;
use std::time::{Duration, Instant};

/// A cable from the chip's serial port to the path that is returned; it lasts as long as what comes with that.
fn cable(bench: &Bench) -> (String, Arc<()>) {
    let mut terminal = Terminal::open().unwrap();
    let (path, bench, plugged) = (terminal.path().to_owned(), bench.clone(), Arc::new(()));
    let still: Weak<()> = Arc::downgrade(&plugged);
    thread::spawn(move || {
        let line = terminal.line().unwrap();
        let mut heard = Vec::new();
        while still.upgrade().is_some() {
            heard.clear();
            if line.receive(Instant::now() + Duration::from_millis(20), &mut heard).unwrap().is_some() {
                let said = bench.chip().serial_port(&heard);
                line.send(&said).unwrap();
            }
        }
    });
    (path, plugged)
}

fn recipe(program: Program) -> Recipe {
    Recipe { program, rtt: false, ..Recipe::default() }
}

fn connect(bench: &Bench, port: &str, program: Program) -> Result<AnyLink, ConnectError> {
    let port = (port.into(), 1_000_000);
    Setup::new(spec(), &recipe(program).elf(), Some(port)).unwrap().connect(bench.lister(), patience())
}

fn sample(step: u32) -> Sample {
    Sample { time_us: step * 1000, setpoint_um: 2.0, wd_um: 0.5, wq_um: 0.0 }
}

#[test]
fn a_board_is_flashed_reset_and_talked_to_over_its_port_in_both_clocks_and_reset_at_the_end() {
    let bench = Bench::new();
    let (port, _plugged) = cable(&bench);
    let mut session = Session::open(connect(&bench, &port, Program::Port).unwrap()).unwrap();
    assert_eq!(session.firmware_name(), "emulated-board");
    assert_eq!(bench.written(), (3, 36));
    session.begin(&configure()).unwrap();
    let reply = session.sample(Duration::ZERO, &sample(0)).unwrap().unwrap();
    assert_eq!(reply.command.state, State::Running);
    assert!(session.is_live());
    let number = session.post(Message::Sample(sample(1))).unwrap();
    let heard = session.listen(Instant::now() + Duration::from_secs(10)).unwrap().unwrap();
    assert_eq!(heard.sequence, number);
    assert!(bench.chip().device.output().drive_vpp > 0.0);
    let before = bench.chip().resets;
    drop(session);
    assert_eq!(bench.chip().resets, before + 1);
    assert_eq!(bench.chip().device.output().drive_vpp, 0.0);
    assert!(!bench.chip().is_halted());
}

#[test]
fn firmware_that_takes_its_time_after_the_reset_is_waited_for() {
    let bench = Bench::new();
    let (port, _plugged) = cable(&bench);
    bench.chip().deaf = 2;
    let mut session = Session::open(connect(&bench, &port, Program::Port).unwrap()).unwrap();
    assert!(session.safe());
}

#[test]
fn silence_on_the_port_is_bounded_and_asks_whether_it_is_the_board_s() {
    let bench = Bench::new();
    let (port, _plugged) = cable(&bench);
    bench.chip().deaf = u32::MAX;
    let start = Instant::now();
    let error = connect(&bench, &port, Program::Port).err().unwrap();
    assert!(start.elapsed() < Duration::from_secs(10));
    assert!(matches!(&error, ConnectError::Probe(ProbeError::NoIntroduction { .. })), "{error}");
    assert!(!error.is_invalid_input());
    let told = error.to_string();
    assert!(told.contains(&port) && told.contains("within 400 ms of the reset"), "{told}");
    // Port and board are free again.
    bench.chip().deaf = 0;
    assert!(connect(&bench, &port, Program::Port).is_ok());
}

#[test]
fn a_port_that_is_not_there_costs_the_board_nothing() {
    let bench = Bench::new();
    let error = connect(&bench, "/dev/no-such-port", Program::Port).err().unwrap();
    assert!(
        matches!(&error, ConnectError::Serial(SerialError::Open { port, .. }) if port == Path::new("/dev/no-such-port"))
    );
    assert_eq!((bench.written(), bench.chip().resets), ((0, 0), 0));
}

#[test]
fn a_missing_answer_is_explained_by_the_trap_that_the_probe_sees() {
    for program in [Program::PortTraps, Program::PortReports] {
        let bench = Bench::new();
        let (port, _plugged) = cable(&bench);
        let mut session = Session::open(connect(&bench, &port, program).unwrap()).unwrap();
        session.begin(&configure()).unwrap();
        let error = session.sample(Duration::ZERO, &sample(0)).unwrap_err();
        let RigError::Link(LinkError::Target(target)) = &error else { panic!("{program:?}: {error:?}") };
        assert!(matches!(&**target, TargetFault::OnBoard(_)), "{target:?}");
        let told = error.to_string();
        for part in ["address 0x40001000", "at 0x08000212 in control_step", "called from 0x08000250 in main_loop"] {
            assert!(told.contains(part), "{program:?}: {part} is missing in: {told}");
        }
    }
}
