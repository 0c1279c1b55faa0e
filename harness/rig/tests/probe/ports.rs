//! Tests the wire protocol over the board's serial port, which is a pseudo-terminal here, traps of the
//! firmware, and the end of a session: 0 V, a reset, a running processor, a released probe.

use crate::emulated_probe::SharedChip;
use crate::image::{CONTROL_STEP, ImageSpec, MAIN_LOOP, Program};
use crate::rtt_exchange::CONFIGURE;
use crate::{BUSY_MACHINE_LIMIT, attach, link, spec, timeouts};
use platebench_rig::link::{Link, LinkError};
use platebench_rig::probe::{FlashImage, ProbeError, ProbeSetup};
use platebench_rig::{BoxedLink, ConnectError, PtyLink, RigError, SerialError, Session, TargetError};
use platebench_wire::{ControllerState, Message, Sample};
use std::path::Path;
use std::sync::{Arc, Weak};
use std::thread;
use std::time::{Duration, Instant};

/// Connects the emulated chip to a pseudo-terminal until the returned guard is dropped.
fn cable(chip: &SharedChip) -> (String, Arc<()>) {
    let mut terminal = PtyLink::open().unwrap();
    let (path, chip, plugged) = (terminal.path().to_owned(), chip.clone(), Arc::new(()));
    let guard: Weak<()> = Arc::downgrade(&plugged);
    thread::spawn(move || {
        let line = terminal.real_time_line().unwrap();
        let mut received = Vec::new();
        while guard.upgrade().is_some() {
            received.clear();
            if line.receive(Instant::now() + Duration::from_millis(20), &mut received).unwrap().is_some() {
                let answer = chip.lock().serial_port(&received);
                line.send(&answer).unwrap();
            }
        }
    });
    (path, plugged)
}

fn port_image(program: Program) -> ImageSpec {
    ImageSpec { program, rtt: false, ..ImageSpec::default() }
}

fn connect(chip: &SharedChip, port: &str, program: Program) -> Result<BoxedLink, ConnectError> {
    let port = (port.into(), 1_000_000);
    ProbeSetup::new(spec(), &port_image(program).elf(), Some(port))
        .unwrap()
        .connect(chip.lister(), timeouts())
        .map_err(ConnectError::from)
}

fn sample(step: u32) -> Sample {
    Sample { time_us: step * 1000, setpoint_um: 2.0, wd_um: 0.5, wq_um: 0.0 }
}

#[test]
fn controls_over_the_port_in_both_clocks() {
    let chip = SharedChip::new();
    let (port, _plugged) = cable(&chip);
    let mut session = Session::open(connect(&chip, &port, Program::Port).unwrap()).unwrap();
    assert_eq!(session.firmware_name(), "emulated-board");
    assert_eq!(chip.written(), (3, 36));
    session.start_trial(&CONFIGURE).unwrap();
    let reply = session.send_sample(Duration::ZERO, &sample(0)).unwrap().unwrap();
    assert_eq!(reply.command.state, ControllerState::Running);
    assert!(session.supports_real_time());
    let number = session.send(Message::Sample(sample(1))).unwrap();
    let received = session.receive(Instant::now() + Duration::from_secs(10)).unwrap().unwrap();
    assert_eq!(received.sequence, number);
    assert!(chip.lock().device.output().drive_vpp > 0.0);
    let before = chip.lock().resets;
    drop(session);
    assert_eq!(chip.lock().resets, before + 1);
    assert_eq!(chip.lock().device.output().drive_vpp, 0.0);
    assert!(!chip.lock().is_halted());
}

#[test]
fn waits_for_slow_firmware_after_the_reset() {
    let chip = SharedChip::new();
    let (port, _plugged) = cable(&chip);
    chip.lock().lost_serial_chunks = 2;
    let mut session = Session::open(connect(&chip, &port, Program::Port).unwrap()).unwrap();
    assert!(session.request_safe_state());
}

#[test]
fn ends_the_handshake_with_a_silent_port() {
    let chip = SharedChip::new();
    let (port, _plugged) = cable(&chip);
    chip.lock().lost_serial_chunks = u32::MAX;
    let start = Instant::now();
    let error = connect(&chip, &port, Program::Port).err().unwrap();
    assert!(start.elapsed() < BUSY_MACHINE_LIMIT);
    assert!(matches!(error.downcast_ref(), Some(ProbeError::NoHandshake { .. })), "{error}");
    assert!(!error.is_invalid_input());
    let text = error.to_string();
    assert!(text.contains(&port) && text.contains("within 400 ms after the reset"), "{text}");
    chip.lock().lost_serial_chunks = 0;
    assert!(connect(&chip, &port, Program::Port).is_ok());
}

#[test]
fn does_not_touch_the_board_without_the_port() {
    let chip = SharedChip::new();
    let error = connect(&chip, "/dev/no-such-port", Program::Port).err().unwrap();
    assert!(
        matches!(error.downcast_ref(), Some(SerialError::Open { port, .. }) if port == Path::new("/dev/no-such-port"))
    );
    assert_eq!((chip.written(), chip.lock().resets), ((0, 0), 0));
}

#[test]
fn explains_a_missing_answer_by_the_trap() {
    for program in [Program::PortTraps, Program::PortReports] {
        let chip = SharedChip::new();
        let (port, _plugged) = cable(&chip);
        let mut session = Session::open(connect(&chip, &port, program).unwrap()).unwrap();
        session.start_trial(&CONFIGURE).unwrap();
        let error = session.send_sample(Duration::ZERO, &sample(0)).unwrap_err();
        let RigError::Link(LinkError::Target(target)) = &error else { panic!("{program:?}: {error:?}") };
        assert!(matches!(&**target, TargetError::Trap(_)), "{target:?}");
        let text = error.to_string();
        for part in ["address 0x40001000", "at 0x08000212 in control_step", "called from 0x0800024e in main_loop"] {
            assert!(text.contains(part), "{program:?}: {part} is missing in: {text}");
        }
    }
}

fn trapping_image() -> ImageSpec {
    ImageSpec { program: Program::Traps, ..ImageSpec::default() }
}

#[test]
fn reports_a_hard_fault_with_callers() {
    let chip = SharedChip::new();
    let start = Instant::now();
    let error = Session::open(link(&chip, &trapping_image()).unwrap()).unwrap_err().to_string();
    assert!(start.elapsed() < BUSY_MACHINE_LIMIT);
    for part in [
        "the firmware trapped: HardFault, data bus error, at 0x08000212 in control_step, address 0x40001000",
        "called from 0x0800024e in main_loop",
        "cfsr 0x00008200, hfsr 0x40000000",
    ] {
        assert!(error.contains(part), "{part} is missing in: {error}");
    }
}

#[test]
fn reads_the_registers_of_a_fault() {
    let chip = SharedChip::new();
    let mut link = link(&chip, &trapping_image()).unwrap();
    let image = Arc::new(FlashImage::parse(&trapping_image().elf()).unwrap());
    assert_eq!(link.board().read_crash(&image).unwrap(), None);
    // A trap is an error of the firmware, not a lost line.
    let error = link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err();
    let LinkError::Target(target) = &error else { panic!("{error:?}") };
    assert!(matches!(&**target, TargetError::Trap(crash) if crash.to_string().contains("control_step")), "{target:?}");
    let crash = link.board().read_crash(&image).unwrap().unwrap();
    assert_eq!((crash.exception, crash.status.cfsr), ("HardFault", 0x8200));
    assert_eq!(crash.status.address, Some(0x4000_1000));
    assert_eq!(crash.place.unwrap().address, CONTROL_STEP + 0x12);
    // A call's address is that of the second half-word of its BL instruction.
    assert_eq!(crash.callers.iter().map(|call| call.address).collect::<Vec<_>>(), [MAIN_LOOP + 0xe]);
}

#[test]
fn resets_after_a_trap_without_confirmed_0_v() {
    let chip = SharedChip::new();
    let mut link = link(&chip, &trapping_image()).unwrap();
    link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err();
    let before = chip.lock().resets;
    let ending = link.shut_down();
    assert!(!ending.zero_volts_confirmed && ending.reset.is_ok());
    assert_eq!(chip.lock().resets, before + 1);
    assert!(!chip.lock().is_halted());
}

#[test]
fn reports_a_watchdog_reset_during_the_reading() {
    let chip = SharedChip::new();
    let mut link = link(&chip, &trapping_image()).unwrap();
    chip.lock().watchdog_resets_when_halted = true;
    let error = link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err().to_string();
    assert!(error.contains("the watchdog reset the chip before its stack was read"), "{error}");
    assert!(error.contains("cfsr 0x00008200") && !error.contains("control_step"), "{error}");
}

#[test]
fn confirms_0_v_and_resets() {
    let chip = SharedChip::new();
    let mut link = link(&chip, &ImageSpec::default()).unwrap();
    let before = chip.lock().resets;
    let ending = link.shut_down();
    assert!(ending.zero_volts_confirmed);
    assert!(ending.reset.is_ok());
    assert_eq!(chip.lock().resets, before + 1);
    assert!(!link.shut_down().zero_volts_confirmed);
    drop(link);
    assert_eq!(chip.lock().resets, before + 1);
}

#[test]
fn resets_a_running_chip_when_the_session_is_dropped() {
    let chip = SharedChip::new();
    let session = Session::open(link(&chip, &ImageSpec::default()).unwrap()).unwrap();
    let before = chip.lock().resets;
    drop(session);
    assert_eq!(chip.lock().resets, before + 1);
    assert!(!chip.lock().is_halted());
}

#[test]
fn attaches_to_a_board_again() {
    let chip = SharedChip::new();
    drop(attach(&chip).unwrap());
    assert_eq!(chip.lock().resets, 1);
    assert!(attach(&chip).is_ok());
}
