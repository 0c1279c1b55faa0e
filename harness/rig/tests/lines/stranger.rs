//! The example controller that was written from the protocol's page alone, in another language.

use super::{CONFIGURE, sample};
use platebench_rig::{Exec, Hosted, Session};
use platebench_wire::{Command, Configure, LawId, State, StateCause};
use std::process::Stdio;
use std::time::Duration;

const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/examples/controller.py");

/// Set where everything that tests need has to be there.
const REQUIRE_ALL: &str = "PLATEBENCH_REQUIRE_ALL";

/// Whichever comes first and can talk to a serial port: the one that distributions install libraries for may not be the one on the path.
const PYTHONS: [&str; 2] = ["python3", "/usr/bin/python3"];

/// `None`, said aloud, where there is no Python with pyserial, unless there has to be.
fn start() -> Option<Session<Exec>> {
    let has_serial = |python: &&str| {
        let mut command = std::process::Command::new(python);
        let status = command.args(["-c", "import serial"]).stdout(Stdio::null()).stderr(Stdio::null()).status();
        status.is_ok_and(|status| status.success())
    };
    let Some(python) = PYTHONS.into_iter().find(has_serial) else {
        assert!(std::env::var_os(REQUIRE_ALL).is_none(), "python3 or pyserial is missing: ci/install-test-tools");
        eprintln!("NOT TESTED: python3 or pyserial is missing (ci/install-test-tools)");
        return None;
    };
    Some(Session::open(Exec::start(&format!("{python} '{SCRIPT}' {{port}}")).unwrap()).unwrap())
}

#[test]
fn it_controls_as_the_firmware_does() {
    let Some(mut stranger) = start() else { return };
    assert_eq!(stranger.firmware_name(), "python-example");
    assert!(stranger.identity().has(LawId::DqPi));
    let mut hosted = Session::open(Hosted::new()).unwrap();
    let configure = Configure { law: LawId::DqPiFixed, ..CONFIGURE };
    let gains = stranger.begin(&configure).unwrap();
    let known = hosted.begin(&configure).unwrap();
    let close = |a: f32, b: f32| (a - b).abs() <= 1e-4 * (1.0 + b.abs());
    assert!(
        close(gains.amplitude_kp, known.amplitude_kp) && close(gains.frequency_ki, known.frequency_ki),
        "{gains:?}"
    );
    // Near the setpoint, where no limit acts and anti-windup has nothing to do.
    for step in 0..50 {
        let wave = (step as f32 * 0.7).sin();
        let sample = platebench_wire::Sample { wd_um: 1.9 + 0.05 * wave, wq_um: 0.01 * wave, ..sample(step) };
        let now = Duration::from_millis(step.into());
        let theirs = stranger.sample(now, &sample).unwrap().unwrap().command;
        let ours = hosted.sample(now, &sample).unwrap().unwrap().command;
        assert_eq!(theirs.state, State::Running);
        assert!(close(theirs.drive_vpp, ours.drive_vpp), "step {step}: {} {}", theirs.drive_vpp, ours.drive_vpp);
        assert!(theirs.frequency_mhz.abs_diff(ours.frequency_mhz) <= 5, "step {step}: {theirs:?} {ours:?}");
    }
    assert!(stranger.safe());
}

#[test]
fn it_goes_to_zero_volts_where_the_page_says_so() {
    let Some(mut stranger) = start() else { return };
    let drive = |command: Command| (command.state, command.cause, command.drive_vpp);
    stranger.begin(&CONFIGURE).unwrap();
    stranger.sample(Duration::ZERO, &sample(0)).unwrap().unwrap();
    let bad = platebench_wire::Sample { wd_um: f32::NAN, ..sample(1) };
    let told = stranger.sample(Duration::ZERO, &bad).unwrap().unwrap();
    assert_eq!(drive(told.command), (State::Fault, StateCause::NonFinite, 0.0));
    let told = stranger.sample(Duration::ZERO, &sample(2)).unwrap().unwrap();
    assert_eq!(told.command.drive_vpp, 0.0);

    // Silence, on its own clock.
    stranger.begin(&Configure { patience_ms: 20, ..CONFIGURE }).unwrap();
    stranger.sample(Duration::ZERO, &sample(0)).unwrap().unwrap();
    let deadline = std::time::Instant::now() + super::WITHIN;
    let told = loop {
        if let Some(command) = stranger.pass(Duration::ZERO).unwrap() {
            break command;
        }
        assert!(std::time::Instant::now() < deadline, "it never noticed");
        std::thread::sleep(Duration::from_millis(5));
    };
    assert_eq!(drive(told), (State::Fault, StateCause::SampleTimeout, 0.0));

    let refused = stranger.begin(&Configure { drive_limit_vpp: -1.0, ..CONFIGURE });
    assert!(matches!(refused, Err(platebench_rig::RigError::Refused(platebench_wire::Rejection::Value))));
}
