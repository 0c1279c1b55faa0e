//! Counts replies that break the protocol.

use platebench_wire::{Command, ControllerState};

#[derive(Debug)]
pub(crate) struct CommandAudit {
    /// Drive and frequency of the reply to each sequence number. The drive is stored as bits,
    /// because NaN is not equal to itself.
    replies: [Option<(u32, u32)>; 256],
    /// True from the confirmation of 0 V to the next configuration.
    is_safe: bool,
    pub(crate) contradictions: u64,
    pub(crate) second_replies: u64,
    pub(crate) drives_after_safe: u64,
    pub(crate) wrong_sequences: u64,
    pub(crate) ignored_safe_requests: u64,
}

impl CommandAudit {
    pub(crate) fn new() -> Self {
        Self {
            replies: [None; 256],
            is_safe: false,
            contradictions: 0,
            second_replies: 0,
            drives_after_safe: 0,
            wrong_sequences: 0,
            ignored_safe_requests: 0,
        }
    }

    pub(crate) fn reset(&mut self) {
        *self = Self::new();
    }

    pub(crate) fn record_safe_reply(&mut self, command: &Command) -> bool {
        self.is_safe = command.state == ControllerState::Safe && command.drive_vpp == 0.0;
        let drives_on = command.state == ControllerState::Running || command.drive_vpp != 0.0;
        self.ignored_safe_requests += u64::from(drives_on);
        self.is_safe
    }

    pub(crate) fn record_configuration(&mut self) {
        self.is_safe = false;
    }

    pub(crate) fn record_sent(&mut self, sequence: u8) {
        if let Some(reply) = self.replies.get_mut(usize::from(sequence)) {
            *reply = None;
        }
    }

    pub(crate) fn record_command(&mut self, last_sent: u8, sequence: u8, command: &Command) {
        // Only a reply to the last message counts, because a late one may have a drive.
        if self.is_safe && sequence == last_sent && command.drive_vpp != 0.0 {
            self.drives_after_safe += 1;
        }
        if command.state != ControllerState::Running {
            return;
        }
        // Numbers wrap. The last number and the 127 before it were sent, the others not yet.
        if last_sent.wrapping_sub(sequence) > u8::MAX / 2 {
            self.wrong_sequences += 1;
            return;
        }
        let Some(reply) = self.replies.get_mut(usize::from(sequence)) else { return };
        let content = (command.drive_vpp.to_bits(), command.frequency_mhz);
        match reply.replace(content) {
            Some(before) if before == content => self.second_replies += 1,
            Some(_) => self.contradictions += 1,
            None => {}
        }
    }
}
