//! Tests lines behind a network: a bridge in this process, and ser2net.

use super::{CONFIGURE, RECEIVE_TIMEOUT, sample};
use platebench_rig::{BoxedLink, ConnectError, NetworkError, RigSpec, Session};
use platebench_test_kit::{ChildGuard, IDENTITY, UNREACHABLE, answer_line, open_terminal, serve_board, skip_without};
use platebench_wire::Message;
use rstest::rstest;
use std::fs;
use std::net::TcpListener;
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

fn connect(spec: &str) -> Result<BoxedLink, ConnectError> {
    spec.parse::<RigSpec>().unwrap().connect()
}

fn control(link: BoxedLink) {
    let mut session = Session::open(link).unwrap();
    assert_eq!(session.identity(), &IDENTITY);
    session.start_trial(&CONFIGURE).unwrap();
    for step in 0..50 {
        let number = session.send(Message::Sample(sample(step))).unwrap();
        let received = session.receive(Instant::now() + RECEIVE_TIMEOUT).unwrap().unwrap();
        assert_eq!(received.sequence, number);
    }
    assert!(session.request_safe_state());
    assert_eq!(session.rejected_frames(), 0);
}

#[test]
fn controls_over_tcp() {
    control(connect(&format!("tcp:{}", serve_board())).unwrap());
}

#[test]
fn names_the_address_that_cannot_be_reached() {
    for kind in ["tcp", "rfc2217"] {
        let refused = connect(&format!("{kind}:{UNREACHABLE}")).err().unwrap();
        assert!(matches!(refused.downcast_ref(), Some(NetworkError::Connect { .. })), "{refused}");
        assert!(!refused.is_invalid_input() && refused.to_string().starts_with(UNREACHABLE), "{refused}");
    }
}

/// Starts ser2net in front of a simulated board. `accepter` selects the protocol of ser2net.
fn ser2net(accepter: &str) -> Option<(ChildGuard, String, (tempfile::TempDir, fs::File))> {
    if Command::new("ser2net").arg("-v").stdout(Stdio::null()).stderr(Stdio::null()).status().is_err() {
        skip_without("ser2net");
        return None;
    }
    let (master, path) = open_terminal();
    thread::spawn(move || answer_line(master.try_clone().unwrap(), master, 1));
    // The terminal is kept open, because it would hang up when ser2net closes it.
    let slave = fs::File::options().read(true).write(true).open(&path).unwrap();
    // Other tests use 127.0.0.1, so that none takes the port before ser2net opens it.
    let address = TcpListener::bind("127.0.0.2:0").unwrap().local_addr().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("ser2net.yaml");
    let (host, port) = (address.ip(), address.port());
    let text = format!(
        "connection: &board\n  accepter: {accepter}tcp,{host},{port}\n  connector: serialdev,{path},115200n81,local\n"
    );
    fs::write(&file, text).unwrap();
    let child = Command::new("ser2net").args(["-n", "-d", "-c"]).arg(&file).stderr(Stdio::null()).spawn().unwrap();
    Some((ChildGuard(child), address.to_string(), (folder, slave)))
}

#[rstest]
#[case::raw("tcp", "")]
#[case::with_settings("rfc2217", "telnet(rfc2217),")]
fn controls_through_ser2net(#[case] kind: &str, #[case] accepter: &str) {
    let Some((_server, address, _files)) = ser2net(accepter) else { return };
    let began = Instant::now();
    let link = loop {
        match connect(&format!("{kind}:{address}")) {
            Ok(link) => break link,
            Err(error) => assert!(began.elapsed() < RECEIVE_TIMEOUT, "{error}"),
        }
        thread::sleep(Duration::from_millis(50));
    };
    control(link);
}
