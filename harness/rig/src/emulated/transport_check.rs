//! Records the calls of a trial, so that they can be played again over the other transport.

use std::time::Duration;

/// One call of [`crate::Link::exchange`], or of [`crate::Link::advance_to`] if nothing was sent.
#[derive(Debug)]
pub(super) struct Call {
    pub(super) now: Duration,
    pub(super) sent: Option<Vec<u8>>,
}

#[derive(Debug, PartialEq, Eq)]
pub(super) struct CallResult {
    pub(super) received: Vec<u8>,
    pub(super) delay: Duration,
    pub(super) instructions: Option<u64>,
    pub(super) computing_ns: Option<u64>,
}

#[derive(Debug, Default)]
pub(super) struct CallLog {
    pub(super) is_recording: bool,
    /// True if the calls since the restart gave the same results again.
    pub(super) is_checked: bool,
    calls: Vec<(Call, CallResult)>,
}

impl CallLog {
    pub(super) fn start(&mut self, is_recording: bool) {
        *self = Self { is_recording, ..Self::default() };
    }

    pub(super) fn push(&mut self, call: Call, result: CallResult) {
        self.calls.push((call, result));
    }

    /// Ends the record. `None` if there was none.
    pub(super) fn take(&mut self) -> Option<Vec<(Call, CallResult)>> {
        std::mem::take(&mut self.is_recording).then(|| std::mem::take(&mut self.calls))
    }
}
