//! Tests programs that cannot start or that end.

use platebench_rig::{ConnectOptions, RigSpec};

fn start_error(command: &str) -> (String, bool) {
    let spec: RigSpec = format!("exec:{command}").parse().unwrap();
    let error = spec.connect().err().unwrap();
    (error.to_string(), error.is_invalid_input())
}

#[test]
fn rejects_a_command_that_cannot_start() {
    let cases = [
        ("python3 controller.py", "`python3 controller.py` has no {port}, the placeholder"),
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
