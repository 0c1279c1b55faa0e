//! Connects to a serial port behind a network: a terminal server, ser2net or a labgrid exporter.
//! With `tcp:`, bytes travel unchanged and the server sets baud rate and format of the port. With
//! `rfc2217:`, bytes travel over Telnet and the bench sets them.

mod error;
mod rfc2217;

pub use error::NetworkError;

use crate::port::Port;
use error::CONNECT_TIMEOUT;
use rfc2217::Rfc2217;
use rustix::fd::OwnedFd;
use std::io;
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::sync::mpsc;
use std::thread;
use std::time::Instant;

pub(crate) fn connect_tcp(address: &str) -> Result<Port<OwnedFd>, NetworkError> {
    Ok(Port::new(connect(address, Instant::now() + CONNECT_TIMEOUT)?))
}

/// Sets the server's port to `baud`, 8 data bits, no parity, 1 stop bit, no flow control.
pub(crate) fn connect_rfc2217(address: &str, baud: u32) -> Result<Port<Rfc2217>, NetworkError> {
    let deadline = Instant::now() + CONNECT_TIMEOUT;
    Ok(Port::new(Rfc2217::start(connect(address, deadline)?, address, baud, deadline)?))
}

fn connect(address: &str, deadline: Instant) -> Result<OwnedFd, NetworkError> {
    let timed_out = || NetworkError::TimedOut { address: address.to_owned() };
    let failed = |error| NetworkError::Connect { address: address.to_owned(), error };
    let mut last = None;
    for socket in resolve(address, deadline)? {
        let left = deadline.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(timed_out());
        }
        match TcpStream::connect_timeout(&socket, left) {
            Ok(stream) => {
                stream.set_nodelay(true).and_then(|()| stream.set_nonblocking(true)).map_err(failed)?;
                return Ok(stream.into());
            }
            Err(error) => last = Some(error),
        }
    }
    Err(match last {
        Some(error) if error.kind() != io::ErrorKind::TimedOut => failed(error),
        _ => timed_out(),
    })
}

/// Runs on another thread, because the resolver of the C library has no time-out.
fn resolve(address: &str, deadline: Instant) -> Result<Vec<SocketAddr>, NetworkError> {
    let (sender, receiver) = mpsc::channel();
    let name = address.to_owned();
    thread::spawn(move || {
        let _ = sender.send(name.to_socket_addrs().map(Iterator::collect));
    });
    match receiver.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
        Ok(found) => found.map_err(|error| NetworkError::Resolve { address: address.to_owned(), error }),
        Err(_) => Err(NetworkError::TimedOut { address: address.to_owned() }),
    }
}
