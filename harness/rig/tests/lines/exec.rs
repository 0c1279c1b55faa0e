//! Programs that are none, that end, and that do not want to.

use platebench_rig::RigSpec;

fn refused(command: &str) -> (String, bool) {
    let spec: RigSpec = format!("exec:{command}").parse().unwrap();
    let error = spec.connect().err().unwrap();
    (error.to_string(), error.is_invalid_input())
}

#[test]
fn a_command_that_cannot_be_started_is_the_user_s_doing() {
    let cases = [
        ("python3 controller.py", "`python3 controller.py` has no {port}, which is where the path"),
        ("'a {port}", "`'a {port}` cannot be split into words"),
        ("/there/is/no-program {port}", "cannot start `/there/is/no-program`: No such file"),
        ("/dev/null {port}", "cannot start `/dev/null`: Permission denied"),
    ];
    for (command, told) in cases {
        let (message, invalid) = refused(command);
        assert!(message.contains(told), "{message}");
        assert!(invalid, "{message}");
    }
}

#[test]
fn a_program_that_ends_is_a_lost_rig_and_says_how_it_ended() {
    let cases = [
        ("sh -c 'exit 3' {port}", "`sh` ended with exit status 3 before it introduced itself"),
        ("sh -c 'kill -9 $$' {port}", "`sh` was ended by signal 9 before it introduced itself"),
    ];
    for (command, told) in cases {
        assert_eq!(refused(command), (told.to_owned(), false));
    }
}
