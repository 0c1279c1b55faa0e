//! Defines options for connecting to a controller.

use crate::cancel::CancelToken;
use crate::debug_port::DebugPort;
use crate::port::DEFAULT_REPLY_TIMEOUT;
use std::time::Duration;

#[derive(Debug, Clone)]
pub struct ConnectOptions {
    /// In lockstep over a serial line, counted from the last byte of the request.
    pub reply_timeout: Duration,
    /// Ends the wait for a program that does not answer its handshake.
    pub cancel: CancelToken,
    /// The first emulated chip waits for a debugger there.
    pub debug_port: Option<DebugPort>,
}

impl Default for ConnectOptions {
    fn default() -> Self {
        Self { reply_timeout: DEFAULT_REPLY_TIMEOUT, cancel: CancelToken::never(), debug_port: None }
    }
}
