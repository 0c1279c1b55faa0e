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

#[cfg(test)]
mod tests {
    use super::super::EmulatedLink;
    use crate::link::{Chip as _, Link as _, LinkError, TargetError};
    use platebench_model::record::Transport;
    use platebench_wire::{Message, Packet};
    use std::time::Duration;

    fn checked_link() -> EmulatedLink {
        let mut link = EmulatedLink::built_in().unwrap();
        link.set_transport(Transport::BlocksAndWords);
        link.restart().unwrap();
        for sequence in 0..3 {
            let hello = Packet { sequence, message: Message::Hello }.encode();
            link.exchange(Duration::from_millis(sequence.into()), hello.as_bytes(), &mut Vec::new()).unwrap();
        }
        link
    }

    #[test]
    fn reports_a_difference_of_the_transports() {
        let mut link = checked_link();
        link.calls.calls[1].1.delay += Duration::from_nanos(1);
        let Err(LinkError::Target(error)) = link.check_transport() else { panic!("no error") };
        assert!(
            matches!(&*error, TargetError::Emulator(problem) if problem.contains("the message 1000 µs")),
            "{error}"
        );
        assert!(link.restart().is_err(), "the emulator cannot be trusted");
    }

    #[test]
    fn states_the_transport_of_a_checked_trial() {
        let mut link = checked_link();
        assert_eq!(link.transport(), Transport::Blocks, "not checked yet");
        link.check_transport().unwrap();
        assert_eq!(link.transport(), Transport::BlocksAndWords);
        link.set_transport(Transport::Words);
        link.restart().unwrap();
        assert_eq!(link.transport(), Transport::Words);
    }
}
