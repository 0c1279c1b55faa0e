use super::{COM_PORT, DO, DONT, IAC, Rfc2217, SUBNEGOTIATION, SUBNEGOTIATION_END, WILL};
use crate::rigs::tcp::NetworkError;
use crate::tty::Tty;
use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

fn deadline() -> Instant {
    Instant::now() + Duration::from_secs(10)
}

/// Starts a line whose server sends `answer`. Also returns the server's end and its thread.
fn start(answer: &'static [u8]) -> (Result<Rfc2217, NetworkError>, UnixStream, JoinHandle<()>) {
    let (line, server) = UnixStream::pair().unwrap();
    line.set_nonblocking(true).unwrap();
    let mut sender = server.try_clone().unwrap();
    let thread = thread::spawn(move || sender.write_all(answer).unwrap());
    (Rfc2217::start(line.into(), "host:1", 921_600, deadline()), server, thread)
}

const ACCEPTED: &[u8] =
    &[IAC, DO, COM_PORT, b'x', IAC, SUBNEGOTIATION, COM_PORT, 101, 0, 14, 16, 0, IAC, SUBNEGOTIATION_END, IAC, WILL, 1];

#[test]
fn sets_the_port_and_escapes_data() {
    let (line, mut server, thread) = start(ACCEPTED);
    let mut line = line.unwrap();
    thread.join().unwrap();
    let mut sent = [0; 256];
    let count = server.read(&mut sent).unwrap();
    let sent = &sent[..count];
    assert!(sent.starts_with(&[IAC, WILL, COM_PORT]), "{sent:?}");
    let baud = [IAC, SUBNEGOTIATION, COM_PORT, 1, 0, 14, 16, 0, IAC, SUBNEGOTIATION_END];
    assert!(sent.windows(baud.len()).any(|bytes| bytes == baud), "{sent:?}");
    assert!(sent.ends_with(&[IAC, DONT, 1]) || sent.ends_with(&baud), "{sent:?}");

    assert_eq!(line.write(&[1, IAC, 2], deadline()).unwrap(), Some(3));
    let mut escaped = [0; 16];
    let count = server.read(&mut escaped).unwrap();
    assert!(escaped[..count].ends_with(&[1, IAC, IAC, 2]), "{:?}", &escaped[..count]);

    // The data contain an escaped 255 that is split between two writes, and a Telnet command (241).
    server.write_all(&[3, IAC]).unwrap();
    let mut received = Vec::new();
    let mut buffer = [0; 8];
    let count = line.read(&mut buffer, deadline()).unwrap().unwrap();
    received.extend_from_slice(&buffer[..count]);
    server.write_all(&[IAC, IAC, 241, 4]).unwrap();
    while received.len() < 3 {
        let count = line.read(&mut buffer, deadline()).unwrap().unwrap();
        received.extend_from_slice(&buffer[..count]);
    }
    assert_eq!(received, [3, IAC, 4]);
    assert_eq!(line.read(&mut buffer, Instant::now()).unwrap(), None);
}

#[test]
fn refuses_a_server_that_sets_no_port_or_another_rate() {
    let (line, _server, _) = start(&[IAC, DONT, COM_PORT]);
    assert!(matches!(line, Err(NetworkError::NoPortOption { .. })), "{line:?}");
    let (line, _server, _) = start(&[IAC, SUBNEGOTIATION, COM_PORT, 101, 0, 0, 37, 128, IAC, SUBNEGOTIATION_END]);
    assert!(matches!(line, Err(NetworkError::Baud { found: 9_600, .. })), "{line:?}");
    let (line, server) = UnixStream::pair().unwrap();
    line.set_nonblocking(true).unwrap();
    drop(server);
    let line = Rfc2217::start(line.into(), "host:1", 9_600, deadline());
    assert!(matches!(line, Err(NetworkError::Settings { .. })), "{line:?}");
}
