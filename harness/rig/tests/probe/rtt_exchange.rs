use crate::emulated_probe::SharedChip;
use crate::image::{ImageSpec, Program};
use crate::rtt_buffers::RttBuffers;
use crate::{BUSY_MACHINE_LIMIT, attach, link};
use platebench_rig::link::{Link, LinkError};
use platebench_rig::probe::{FlashImage, ProbeError, RttLink};
use platebench_rig::{RigError, Session};
use platebench_wire::{Configure, ControllerState, Sample};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// The period is long, because the emulated chip's watchdog runs on the wall clock.
pub(crate) const CONFIGURE: Configure = Configure { period_us: 1_000_000, ..platebench_test_kit::CONFIGURE };

#[test]
fn controls_over_rtt() {
    let chip = SharedChip::new();
    let mut session = Session::open(link(&chip, &ImageSpec::default()).unwrap()).unwrap();
    assert_eq!(session.firmware_name(), "emulated-board");
    assert_eq!(session.identity().chip, 0x1007_6413);
    session.start_trial(&CONFIGURE).unwrap();
    // The samples are more than fit into the buffers.
    for step in 0..40 {
        let sample = Sample { time_us: step * 1000, setpoint_um: 2.0, wd_um: 0.5, wq_um: 0.0 };
        let reply = session.send_sample(Duration::from_millis(u64::from(step)), &sample).unwrap().unwrap();
        assert_eq!(reply.command.state, ControllerState::Running);
        assert!(reply.command.drive_vpp > 0.0);
    }
    assert!(chip.lock().device.output().drive_vpp > 0.0);
    assert!(session.request_safe_state());
    assert_eq!(chip.lock().device.output().drive_vpp, 0.0);
}

#[test]
fn rejects_firmware_without_rtt_before_the_flash() {
    let chip = SharedChip::new();
    let error = link(&chip, &ImageSpec { rtt: false, ..ImageSpec::default() }).unwrap_err();
    assert!(matches!(error, ProbeError::NoRtt));
    assert!(error.to_string().contains("--rig probe:CHIP,port=PORT"), "{error}");
    assert_eq!(chip.written(), (0, 0));
    assert_eq!(chip.lock().resets, 0);
}

#[test]
fn ignores_an_old_rtt_control_block() {
    let chip = SharedChip::new();
    let image =
        Arc::new(FlashImage::parse(&ImageSpec { program: Program::Asleep, ..ImageSpec::default() }.elf()).unwrap());
    let mut board = attach(&chip).unwrap();
    board.flash(&image).unwrap();
    RttBuffers::start(&mut chip.lock());
    let start = Instant::now();
    board.restart(&image).unwrap();
    let error = RttLink::open(board, image).unwrap_err();
    assert!(matches!(error, ProbeError::RttNotStarted { address: 0x2000_0400, .. }), "{error}");
    assert!(start.elapsed() < BUSY_MACHINE_LIMIT, "{:?}", start.elapsed());
}

#[test]
fn ends_an_exchange_without_an_answer() {
    let chip = SharedChip::new();
    let mut link = link(&chip, &ImageSpec { program: Program::Mute, ..ImageSpec::default() }).unwrap();
    let start = Instant::now();
    let mut answer = Vec::new();
    link.exchange(Duration::ZERO, &[1, 2, 0], &mut answer).unwrap();
    assert!(answer.is_empty());
    assert!((Duration::from_millis(100)..BUSY_MACHINE_LIMIT).contains(&start.elapsed()), "{:?}", start.elapsed());
    assert!(matches!(Session::open(link), Err(RigError::NoIdentity { .. })));
}

#[test]
fn reports_a_missing_acknowledgement_for_good() {
    let chip = SharedChip::new();
    let mut link = link(&chip, &ImageSpec::default()).unwrap();
    chip.lock().failing_accesses = 1;
    let error = link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err();
    assert!(matches!(error, LinkError::Disconnected(_)), "{error:?}");
    let error = error.to_string();
    assert!(error.contains("an RTT exchange failed") && error.contains("did not respond"), "{error}");
    // The line works again, but the session has lost bytes.
    assert!(link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err().to_string().contains("earlier error"));
    let before = chip.lock().resets;
    assert!(link.shut_down().reset.is_ok());
    assert_eq!(chip.lock().resets, before + 1);
}

#[test]
fn abandons_a_probe_that_hangs() {
    let chip = SharedChip::new();
    let mut link = link(&chip, &ImageSpec::default()).unwrap();
    chip.lock().memory_hangs = true;
    let start = Instant::now();
    let error = link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err().to_string();
    assert!(error.contains("the debug probe hangs: an RTT exchange did not end within 400 ms"), "{error}");
    drop(link);
    assert!(start.elapsed() < BUSY_MACHINE_LIMIT, "{:?}", start.elapsed());
    chip.lock().memory_hangs = false;
}
