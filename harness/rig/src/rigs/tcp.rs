//! Connects to a serial port behind a network: a terminal server, ser2net or a labgrid exporter.
//! Bytes travel unchanged, and the server sets baud rate and format of the port.

use crate::cancel::CancelToken;
use crate::factory::{Argument, Capability, ConnectError, ConnectOptions, Rig, RigFactory, RigProperties};
use crate::link::{BoxedLink, LinkError};
use crate::port::Port;
use crate::wait_budget::WaitBudget;
use platebench_model::record::ClockKind;
use rustix::fd::OwnedFd;
use std::io;
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::sync::mpsc::{self, RecvTimeoutError};
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
        let line = connect(&self.address, &mut WaitBudget::new(CONNECT_TIMEOUT), &options.cancel)?;
        Ok(Box::new(Port::on_network(line).with_options(options)))
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
    #[error(
        "{address} does not set serial ports (RFC 2217); if the server sets the port itself, use tcp:{address}{}",
        sent_text(text.as_ref())
    )]
    NoPortOption { address: String, text: Option<String> },
    #[error("{address}: the server set {found} instead of {expected}")]
    Setting { address: String, expected: String, found: String },
    #[error("{address}: {source}{}", sent_text(text.as_ref()))]
    Settings { address: String, source: LinkError, text: Option<String> },
    #[error("cancelled while connecting to {address}")]
    Cancelled { address: String },
}

/// The server's own text, which is already in quotes.
fn sent_text(text: Option<&String>) -> String {
    text.map_or_else(String::new, |text| format!("; the server sent {text}"))
}

impl From<NetworkError> for ConnectError {
    fn from(error: NetworkError) -> Self {
        Self::new(error, false)
    }
}

/// Resolves the name and connects on another thread, because neither can be cancelled.
pub(super) fn connect(address: &str, budget: &mut WaitBudget, cancel: &CancelToken) -> Result<OwnedFd, NetworkError> {
    let (sender, receiver) = mpsc::channel();
    let name = address.to_owned();
    thread::spawn(move || {
        let _ = sender.send(connect_first(&name));
    });
    while let Some(until) = budget.next_part(Instant::now()) {
        match receiver.recv_timeout(until.saturating_duration_since(Instant::now())) {
            Ok(connected) => return connected.map(OwnedFd::from),
            Err(RecvTimeoutError::Timeout) if cancel.is_cancelled() => {
                return Err(NetworkError::Cancelled { address: address.to_owned() });
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
    }
    Err(NetworkError::TimedOut { address: address.to_owned() })
}

fn connect_first(address: &str) -> Result<TcpStream, NetworkError> {
    let failed = |error| NetworkError::Connect { address: address.to_owned(), error };
    let sockets: Vec<SocketAddr> = address
        .to_socket_addrs()
        .map_err(|error| NetworkError::Resolve { address: address.to_owned(), error })?
        .collect();
    let mut last = None;
    for socket in sockets {
        match TcpStream::connect_timeout(&socket, CONNECT_TIMEOUT) {
            Ok(stream) => {
                stream.set_nodelay(true).and_then(|()| stream.set_nonblocking(true)).map_err(failed)?;
                return Ok(stream);
            }
            Err(error) => last = Some(error),
        }
    }
    Err(match last {
        Some(error) if error.kind() != io::ErrorKind::TimedOut => failed(error),
        _ => NetworkError::TimedOut { address: address.to_owned() },
    })
}
