//! Tests programs that cannot start or that end, and the example controller in Python, which
//! implements `docs/wire-protocol.md`.

use super::{CONFIGURE, sample};
use platebench_rig::{ConnectOptions, ExecLink, HostedLink, RigSpec, Session};
use platebench_wire::{Command, Configure, ControllerState, LawId, StateCause};
use std::time::Duration;

fn start_error(command: &str) -> (String, bool) {
    let spec: RigSpec = format!("exec:{command}").parse().unwrap();
    let error = spec.connect().err().unwrap();
    (error.to_string(), error.is_invalid_input())
}

#[test]
fn rejects_a_command_that_cannot_start() {
    let cases = [
        ("python3 controller.py", "`python3 controller.py` has no argument with {port}, the placeholder"),
        ("'a {port}", "`'a {port}` cannot be split into words"),
        ("/there/is/no-program {port}", "cannot start `/there/is/no-program`: No such file"),
        ("/dev/null {port}", "cannot start `/dev/null`: Permission denied"),
    ];
    for (command, expected) in cases {
        let (message, invalid) = start_error(command);
        assert!(message.contains(expected), "{message}");
        assert!(invalid, "{message}");
    }
}

#[test]
fn reports_how_a_program_ended() {
    let cases = [
        ("sh -c 'exit 3' {port}", "`sh` ended with exit status 3 before the handshake"),
        ("sh -c 'kill -9 $$' {port}", "`sh` was ended by signal 9 before the handshake"),
    ];
    for (command, expected) in cases {
        assert_eq!(start_error(command), (expected.to_owned(), false));
    }
}

/// Without the cancellation, the handshake waits 5 s.
#[test]
fn cancels_the_wait_for_a_silent_program() {
    let spec: RigSpec = "exec:sh -c 'exec sleep 60' {port}".parse().unwrap();
    let options = ConnectOptions::default();
    options.cancel.cancel();
    let error = spec.connect_with(&options).err().unwrap();
    assert_eq!(error.to_string(), "cancelled while waiting for the handshake of `sh`");
    assert!(!error.is_invalid_input());
}

const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/examples/controller.py");

/// `None`, with a message, if there is no Python with pyserial.
fn start() -> Option<Session<ExecLink>> {
    let python = platebench_test_kit::python_with_pyserial()?;
    Some(Session::open(ExecLink::start(&format!("{python} '{SCRIPT}' {{port}}")).unwrap()).unwrap())
}

#[test]
fn controls_like_the_firmware() {
    let Some(mut example) = start() else { return };
    assert_eq!(example.firmware_name(), "python-example");
    assert!(example.identity().has_law(LawId::DqPi));
    let mut hosted = Session::open(HostedLink::new()).unwrap();
    let configure = Configure { law: LawId::DqPiFixed, ..CONFIGURE };
    let gains = example.start_trial(&configure).unwrap();
    let known = hosted.start_trial(&configure).unwrap();
    let close = |a: f32, b: f32| (a - b).abs() <= 1e-4 * (1.0 + b.abs());
    assert!(
        close(gains.amplitude_kp, known.amplitude_kp) && close(gains.frequency_ki, known.frequency_ki),
        "{gains:?}"
    );
    for step in 0..50 {
        let wave = (step as f32 * 0.7).sin();
        let sample = platebench_wire::Sample { wd_um: 1.9 + 0.05 * wave, wq_um: 0.01 * wave, ..sample(step) };
        let now = Duration::from_millis(step.into());
        let example_command = example.send_sample(now, &sample).unwrap().unwrap().command;
        let hosted_command = hosted.send_sample(now, &sample).unwrap().unwrap().command;
        assert_eq!(example_command.state, ControllerState::Running);
        assert!(
            close(example_command.drive_vpp, hosted_command.drive_vpp),
            "step {step}: {} {}",
            example_command.drive_vpp,
            hosted_command.drive_vpp
        );
        assert!(
            example_command.frequency_mhz.abs_diff(hosted_command.frequency_mhz) <= 5,
            "step {step}: {example_command:?} {hosted_command:?}"
        );
    }
    assert!(example.request_safe_state());
}

#[test]
fn goes_to_0_v_as_the_page_requires() {
    let Some(mut example) = start() else { return };
    let drive = |command: Command| (command.state, command.cause, command.drive_vpp);
    example.start_trial(&CONFIGURE).unwrap();
    example.send_sample(Duration::ZERO, &sample(0)).unwrap().unwrap();
    let bad = platebench_wire::Sample { wd_um: f32::NAN, ..sample(1) };
    let reply = example.send_sample(Duration::ZERO, &bad).unwrap().unwrap();
    assert_eq!(drive(reply.command), (ControllerState::Fault, StateCause::NonFinite, 0.0));
    let reply = example.send_sample(Duration::ZERO, &sample(2)).unwrap().unwrap();
    assert_eq!(reply.command.drive_vpp, 0.0);

    example.start_trial(&Configure { watchdog_timeout_ms: 20, ..CONFIGURE }).unwrap();
    example.send_sample(Duration::ZERO, &sample(0)).unwrap().unwrap();
    let deadline = std::time::Instant::now() + super::RECEIVE_TIMEOUT;
    let stop = loop {
        if let Some(command) = example.advance_to(Duration::ZERO).unwrap() {
            break command;
        }
        assert!(std::time::Instant::now() < deadline, "no stop");
        std::thread::sleep(Duration::from_millis(5));
    };
    assert_eq!(drive(stop), (ControllerState::Fault, StateCause::SampleTimeout, 0.0));

    let refused = example.start_trial(&Configure { drive_limit_vpp: -1.0, ..CONFIGURE });
    assert!(matches!(refused, Err(platebench_rig::RigError::ConfigurationRejected(platebench_wire::Rejection::Value))));
}
