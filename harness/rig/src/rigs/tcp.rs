//! Connects to a serial port behind a network: a terminal server, ser2net or a labgrid exporter.
//! Bytes travel unchanged, and the server sets baud rate and format of the port.

use crate::factory::{Argument, Capability, ConnectError, ConnectOptions, Rig, RigFactory, RigProperties};
use crate::link::{BoxedLink, LinkError};
use crate::port::Port;
use platebench_model::record::ClockKind;
use rustix::fd::OwnedFd;
use std::io;
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

pub(super) const RIG: RigFactory = RigFactory {
    name: "tcp",
    argument: Argument::Required("HOST:PORT"),
    help: "a board on a serial port of a server that transports bytes unchanged",
    capabilities: &[Capability::RealPlate],
    parse: |text| Ok(Box::new(TcpRig { address: parse_address(text.unwrap_or_default())? })),
};

#[derive(Debug)]
struct TcpRig {
    address: String,
}

impl Rig for TcpRig {
    fn properties(&self) -> RigProperties {
        RigProperties { default_clock: ClockKind::RealTime, ..RigProperties::default() }
    }

    fn open(&self, options: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        let line = connect(&self.address, Instant::now() + CONNECT_TIMEOUT)?;
        Ok(Box::new(Port::new(line).with_reply_timeout(options.reply_timeout)))
    }
}

/// Checks the form `HOST:PORT`. An IPv6 address must be in brackets.
pub(super) fn parse_address(text: &str) -> Result<String, &'static str> {
    let wrong = "the address is not HOST:PORT with a port from 1 to 65535";
    let (host, port) = text.rsplit_once(':').ok_or(wrong)?;
    let is_bracketed = host.starts_with('[') && host.ends_with(']');
    let is_host = !host.is_empty() && (is_bracketed || !host.contains(':')) && !host.contains(char::is_whitespace);
    let is_port = port.bytes().all(|byte| byte.is_ascii_digit()) && port.parse::<u16>().is_ok_and(|port| port > 0);
    if is_host && is_port { Ok(text.to_owned()) } else { Err(wrong) }
}

/// Longest time for name resolution, connection and settings together.
pub(super) const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    #[error("{address}: the name cannot be resolved: {error}")]
    Resolve { address: String, error: io::Error },
    #[error("{address}: cannot connect: {error}")]
    Connect { address: String, error: io::Error },
    #[error("{address}: no connection within {} s", CONNECT_TIMEOUT.as_secs())]
    TimedOut { address: String },
    #[error("{address} does not set serial ports (RFC 2217); if the server sets the port itself, use tcp:{address}")]
    NoPortOption { address: String },
    #[error("{address}: the server set {found} baud instead of {expected}")]
    Baud { address: String, expected: u32, found: u32 },
    #[error("{address}: {source}")]
    Settings { address: String, source: LinkError },
}

impl From<NetworkError> for ConnectError {
    fn from(error: NetworkError) -> Self {
        Self::new(error, false)
    }
}

pub(super) fn connect(address: &str, deadline: Instant) -> Result<OwnedFd, NetworkError> {
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
