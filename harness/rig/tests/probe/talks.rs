//! The wire protocol over RTT.

use crate::emulated::Bench;
use crate::image::{Program, Recipe};
use crate::rtt::Rings;
use crate::{attach, link};
use platebench_rig::link::{Link, LinkError};
use platebench_rig::probe::{Image, ProbeError, RttLink};
use platebench_rig::{RigError, Session};
use platebench_wire::{Configure, LawId, Sample, State};
use std::sync::Arc;
use std::time::{Duration, Instant};

pub(crate) fn configure() -> Configure {
    Configure {
        law: LawId::DqPi,
        paced_by_target: false,
        drives_own_plate: false,
        patience_ms: 0,
        period_us: 1_000_000,
        loop_delay_us: 0,
        start_frequency_mhz: 32_307_600,
        gain_um_per_vpp: 0.006_98,
        time_constant_s: 0.001_88,
        response_time_s: 0.0,
        drive_limit_vpp: 900.0,
        frequency_range_hz: 100.0,
        frequency_slew_hz: 50.0,
        gains: None,
    }
}

#[test]
fn a_controller_behind_the_probe_says_who_it_is_and_controls() {
    let bench = Bench::new();
    let mut session = Session::open(link(&bench, &Recipe::default()).unwrap()).unwrap();
    assert_eq!(session.firmware_name(), "emulated-board");
    assert_eq!(session.identity().chip, 0x1007_6413);
    session.begin(&configure()).unwrap();
    // More samples than fit into the rings at once.
    for step in 0..40 {
        let sample = Sample { time_us: step * 1000, setpoint_um: 2.0, wd_um: 0.5, wq_um: 0.0 };
        let reply = session.sample(Duration::from_millis(u64::from(step)), &sample).unwrap().unwrap();
        assert_eq!(reply.command.state, State::Running);
        assert!(reply.command.drive_vpp > 0.0);
    }
    assert!(bench.chip().device.output().drive_vpp > 0.0);
    assert!(session.safe());
    assert_eq!(bench.chip().device.output().drive_vpp, 0.0);
}

#[test]
fn firmware_without_rtt_is_sent_to_the_serial_port_before_the_board_is_touched() {
    let bench = Bench::new();
    let error = link(&bench, &Recipe { rtt: false, ..Recipe::default() }).unwrap_err();
    assert!(matches!(error, ProbeError::NoRtt));
    assert!(error.to_string().contains("--rig probe:CHIP,port=PORT"), "{error}");
    assert_eq!(bench.written(), (0, 0));
    assert_eq!(bench.chip().resets, 0);
}

#[test]
fn firmware_that_does_not_start_its_rtt_is_named_even_when_an_old_control_block_is_left_in_memory() {
    let bench = Bench::new();
    let image = Arc::new(Image::parse(&Recipe { program: Program::Asleep, ..Recipe::default() }.elf()).unwrap());
    let mut board = attach(&bench).unwrap();
    board.flash(&image).unwrap();
    Rings::start(&mut bench.chip());
    let start = Instant::now();
    board.restart(&image).unwrap();
    let error = RttLink::open(board, image).unwrap_err();
    assert!(matches!(error, ProbeError::RttNotStarted { address: 0x2000_0400, .. }), "{error}");
    assert!(start.elapsed() < Duration::from_secs(3), "{:?}", start.elapsed());
}

#[test]
fn silence_is_bounded_and_no_answer() {
    let bench = Bench::new();
    let mut link = link(&bench, &Recipe { program: Program::Mute, ..Recipe::default() }).unwrap();
    let start = Instant::now();
    let mut answer = Vec::new();
    link.exchange(Duration::ZERO, &[1, 2, 0], &mut answer).unwrap();
    assert!(answer.is_empty());
    assert!((Duration::from_millis(100)..Duration::from_secs(2)).contains(&start.elapsed()), "{:?}", start.elapsed());
    assert!(matches!(Session::open(link), Err(RigError::NoAnswer { .. })));
}

#[test]
fn a_line_that_does_not_acknowledge_is_an_error_that_nothing_repeats_away() {
    let bench = Bench::new();
    let mut link = link(&bench, &Recipe::default()).unwrap();
    bench.chip().unacknowledged = 1;
    let error = link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err();
    assert!(matches!(error, LinkError::Disconnected(_)), "{error:?}");
    let error = error.to_string();
    assert!(error.contains("an exchange failed") && error.contains("did not respond"), "{error}");
    // The line is back; a session that lost bytes is not.
    assert!(link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err().to_string().contains("earlier error"));
    let before = bench.chip().resets;
    assert!(link.end().reset.is_ok());
    assert_eq!(bench.chip().resets, before + 1);
}

#[test]
fn a_probe_that_hangs_is_given_up_in_time() {
    let bench = Bench::new();
    let mut link = link(&bench, &Recipe::default()).unwrap();
    bench.chip().hangs = true;
    let start = Instant::now();
    let error = link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err().to_string();
    assert!(error.contains("the debug probe hangs: an exchange did not end within 400 ms"), "{error}");
    drop(link);
    assert!(start.elapsed() < Duration::from_secs(2), "{:?}", start.elapsed());
    bench.chip().hangs = false;
}
