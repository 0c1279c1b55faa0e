//! Defines options for connecting to a controller.

use crate::cancel::CancelToken;
use crate::debug_port::DebugPort;
use crate::port::DEFAULT_REPLY_TIMEOUT;
use std::time::Duration;

#[derive(Debug, Clone)]
pub struct ConnectOptions {
    /// Longest wait for an answer in lockstep over a line, from the last byte of the request.
    pub reply_timeout: Duration,
    /// Cancels the waits for a program's handshake and for a debugger.
    pub cancel: CancelToken,
    /// The first emulated chip waits on this port for a debugger.
    pub debug_port: Option<DebugPort>,
}

impl Default for ConnectOptions {
    fn default() -> Self {
        Self { reply_timeout: DEFAULT_REPLY_TIMEOUT, cancel: CancelToken::never(), debug_port: None }
    }
}
