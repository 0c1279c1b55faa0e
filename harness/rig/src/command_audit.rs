//! Counts replies that break the protocol.

use platebench_wire::{Command, ControllerState, Message};

/// Kind of the message that the bench sent under a sequence number in this trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Request {
    #[default]
    None,
    Sample,
    Safe,
    Other,
}

/// State, drive and frequency of a command. The drive is stored as bits, because NaN is not equal
/// to itself.
type Content = (ControllerState, u32, u32);

/// Request under one sequence number and its answers.
#[derive(Debug, Clone, Copy, Default)]
struct Exchange {
    request: Request,
    reply: Option<Content>,
    /// A controller in the state *fault* answers a sample, or reports a stop under the number of
    /// the last sample, which has an answer already.
    fault: Option<Content>,
}

#[derive(Debug)]
pub(crate) struct CommandAudit {
    exchanges: [Exchange; 256],
    /// True from the first request for 0 V to the next configuration.
    safe_requested: bool,
    /// True from the confirmation of 0 V to the next configuration.
    is_safe: bool,
    pub(crate) contradictions: u64,
    pub(crate) second_replies: u64,
    pub(crate) drives_after_safe: u64,
    pub(crate) wrong_sequences: u64,
    pub(crate) ignored_safe_requests: u64,
    pub(crate) unrequested_confirmations: u64,
}

impl CommandAudit {
    pub(crate) fn new() -> Self {
        Self {
            exchanges: [Exchange::default(); 256],
            safe_requested: false,
            is_safe: false,
            contradictions: 0,
            second_replies: 0,
            drives_after_safe: 0,
            wrong_sequences: 0,
            ignored_safe_requests: 0,
            unrequested_confirmations: 0,
        }
    }

    pub(crate) fn reset(&mut self) {
        *self = Self::new();
    }

    /// True if the controller confirmed 0 V under the number of the request, and not before.
    pub(crate) fn is_safe(&self) -> bool {
        self.is_safe
    }

    pub(crate) fn record_sent(&mut self, sequence: u8, message: &Message) {
        let request = match message {
            Message::Sample(_) => Request::Sample,
            Message::Safe => Request::Safe,
            _ => Request::Other,
        };
        match message {
            Message::Safe => self.safe_requested = true,
            Message::Configure(_) => (self.safe_requested, self.is_safe) = (false, false),
            _ => {}
        }
        if let Some(exchange) = self.exchanges.get_mut(usize::from(sequence)) {
            *exchange = Exchange { request, ..Exchange::default() };
        }
    }

    pub(crate) fn record_command(&mut self, last_sent: u8, sequence: u8, command: &Command) {
        // Only a reply to the last message counts, because a late one may have a drive.
        if self.is_safe && sequence == last_sent && command.drive_vpp != 0.0 {
            self.drives_after_safe += 1;
        }
        // Numbers wrap. The last number and the 127 before it were sent, the others not yet.
        if last_sent.wrapping_sub(sequence) > u8::MAX / 2 {
            match command.state {
                ControllerState::Running => self.wrong_sequences += 1,
                ControllerState::Safe if self.safe_requested => self.wrong_sequences += 1,
                ControllerState::Safe => self.unrequested_confirmations += 1,
                // The report of a stop without any sample has number 0.
                ControllerState::Idle | ControllerState::Fault => {}
            }
            return;
        }
        let Some(exchange) = self.exchanges.get_mut(usize::from(sequence)) else { return };
        let content = (command.state, command.drive_vpp.to_bits(), command.frequency_mhz);
        let is_stop = command.state == ControllerState::Fault && exchange.request != Request::Safe;
        let request = exchange.request;
        let slot = if is_stop { &mut exchange.fault } else { &mut exchange.reply };
        let before = *slot;
        let is_confirmation = command.state == ControllerState::Safe && request == Request::Sample;
        let is_unrequested = !self.safe_requested || before.is_some_and(|before| before.0 != ControllerState::Safe);
        if is_confirmation && is_unrequested {
            self.unrequested_confirmations += 1;
            return;
        }
        match before {
            Some(before) if before == content => self.second_replies += 1,
            Some(_) => self.contradictions += 1,
            // The first answer to a request for 0 V decides whether 0 V is confirmed.
            None if request == Request::Safe => {
                let is_driven = command.state == ControllerState::Running || command.drive_vpp != 0.0;
                self.ignored_safe_requests += u64::from(is_driven);
                self.is_safe = command.state == ControllerState::Safe && command.drive_vpp == 0.0;
            }
            None => {}
        }
        *slot = Some(content);
    }
}
