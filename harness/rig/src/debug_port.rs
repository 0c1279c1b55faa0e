//! Waits for a debugger on a port of the loopback interface.

use crate::cancel::CancelToken;
use std::io;
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

const CONNECT_TIMEOUT: Duration = Duration::from_mins(5);
pub(crate) const POLL: Duration = Duration::from_millis(50);

#[derive(Debug, thiserror::Error)]
pub enum DebuggerError {
    #[error("127.0.0.1:{port}: {error}; expected a free port for the debugger")]
    Listen { port: u16, error: io::Error },
    #[error("no debugger connected within {} s", CONNECT_TIMEOUT.as_secs())]
    NotConnected,
    #[error("cancelled before a debugger connected")]
    Cancelled,
    #[error("the connection of the debugger failed: {0}")]
    Connection(String),
}

impl From<io::Error> for DebuggerError {
    fn from(error: io::Error) -> Self {
        Self::Connection(error.to_string())
    }
}

/// Port for one debugger of one emulated chip. Clones share the port.
#[derive(Debug, Clone)]
pub struct DebugPort {
    number: u16,
    listener: Arc<Mutex<Option<TcpListener>>>,
}

impl DebugPort {
    pub fn bind(port: u16) -> Result<Self, DebuggerError> {
        let listen_error = |error| DebuggerError::Listen { port, error };
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port)).map_err(listen_error)?;
        listener.set_nonblocking(true).map_err(listen_error)?;
        let number = listener.local_addr().map_err(listen_error)?.port();
        Ok(Self { number, listener: Arc::new(Mutex::new(Some(listener))) })
    }

    pub fn number(&self) -> u16 {
        self.number
    }

    /// The first caller waits for a debugger. Later callers get `None`.
    pub(crate) fn accept(&self, cancel: &CancelToken) -> Result<Option<TcpStream>, DebuggerError> {
        let listener = self.listener.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Some(listener) = listener else { return Ok(None) };
        let deadline = Instant::now() + CONNECT_TIMEOUT;
        loop {
            match listener.accept() {
                Ok((stream, _)) => return Ok(Some(stream)),
                Err(error) if error.kind() != io::ErrorKind::WouldBlock => return Err(error.into()),
                Err(_) if cancel.is_cancelled() => return Err(DebuggerError::Cancelled),
                Err(_) if Instant::now() > deadline => return Err(DebuggerError::NotConnected),
                Err(_) => thread::sleep(POLL),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refuses_a_port_in_use() {
        let first = DebugPort::bind(0).unwrap();
        let error = DebugPort::bind(first.number()).unwrap_err().to_string();
        assert!(error.starts_with(&format!("127.0.0.1:{}: ", first.number())), "{error}");
        assert!(error.ends_with("; expected a free port for the debugger"), "{error}");
    }

    #[test]
    fn a_cancelled_wait_ends_and_the_second_link_has_no_debugger() {
        let (port, cancel) = (DebugPort::bind(0).unwrap(), CancelToken::default());
        cancel.cancel();
        assert!(matches!(port.accept(&cancel), Err(DebuggerError::Cancelled)));
        assert!(port.accept(&cancel).unwrap().is_none());
    }
}
