//! Defines the errors of a line behind a network.

use crate::link::LinkError;
use std::io;
use std::time::Duration;

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
