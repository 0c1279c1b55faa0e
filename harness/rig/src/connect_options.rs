//! Options for connecting to a controller.

use crate::cancel::CancelToken;
use crate::tty::DEFAULT_REPLY_TIMEOUT;
use std::time::Duration;

/// How to connect to a controller.
#[derive(Debug, Clone)]
pub struct ConnectOptions {
    /// Time for a reply in lockstep over a serial line, from the last byte of the request on.
    pub reply_timeout: Duration,
    /// Ends the wait for a program that does not answer its handshake.
    pub cancel: CancelToken,
}

impl Default for ConnectOptions {
    fn default() -> Self {
        Self { reply_timeout: DEFAULT_REPLY_TIMEOUT, cancel: CancelToken::never() }
    }
}
