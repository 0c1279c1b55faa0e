//! Counts replies that break the protocol.

use crate::handshake::HELLO_NUMBER;
use platebench_wire::{Command, Configured, ControllerState, Message, Packet};

/// Commands with a drive after the controller confirmed 0 V.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrivesAfterSafe {
    pub count: u64,
    /// Largest of the drives, Vpp. NaN if a drive was NaN.
    pub worst_vpp: f32,
}

/// Kind of the message that the bench sent under a sequence number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Request {
    #[default]
    None,
    Sample,
    Safe,
    Configuration,
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
    /// True if a *configured* message has answered a configuration.
    is_configured: bool,
}

#[derive(Debug)]
pub(crate) struct CommandAudit {
    exchanges: [Exchange; 256],
    /// True from the first request for 0 V to the next configuration.
    safe_requested: bool,
    /// True from the confirmation of 0 V to the next accepted configuration.
    is_safe: bool,
    pub(crate) contradictions: u64,
    pub(crate) second_replies: u64,
    drives_after_safe: Option<DrivesAfterSafe>,
    pub(crate) wrong_sequences: u64,
    pub(crate) ignored_safe_requests: u64,
    pub(crate) unrequested_confirmations: u64,
    /// Messages that no request caused and that the controller must not send of its own.
    pub(crate) unrequested_messages: u64,
    /// True from an accepted configuration without ticks and telemetry to the next configuration.
    is_silent: bool,
    /// True if the last configuration allows ticks or telemetry.
    allows_reports: bool,
}

impl CommandAudit {
    pub(crate) fn new() -> Self {
        Self {
            exchanges: [Exchange::default(); 256],
            safe_requested: false,
            is_safe: false,
            contradictions: 0,
            second_replies: 0,
            drives_after_safe: None,
            wrong_sequences: 0,
            ignored_safe_requests: 0,
            unrequested_confirmations: 0,
            unrequested_messages: 0,
            is_silent: false,
            allows_reports: false,
        }
    }

    /// Starts the counts of a trial. Keeps the drives after 0 V that no earlier trial has reported.
    pub(crate) fn reset(&mut self) {
        let Self { exchanges, safe_requested, is_safe, drives_after_safe, is_silent, allows_reports, .. } = *self;
        *self =
            Self { exchanges, safe_requested, is_safe, drives_after_safe, is_silent, allows_reports, ..Self::new() };
    }

    /// Forgets the messages to a target that was restarted.
    pub(crate) fn forget_messages(&mut self) {
        self.exchanges = [Exchange::default(); 256];
    }

    /// True if the controller confirmed 0 V under the number of the request, and not before.
    pub(crate) fn is_safe(&self) -> bool {
        self.is_safe
    }

    pub(crate) fn record_sent(&mut self, sequence: u8, message: &Message) {
        let request = match message {
            Message::Sample(_) => Request::Sample,
            Message::Safe => Request::Safe,
            Message::Configure(_) => Request::Configuration,
            _ => Request::Other,
        };
        match request {
            Request::Safe => self.safe_requested = true,
            Request::Configuration => (self.safe_requested, self.is_silent) = (false, false),
            _ => {}
        }
        if let Message::Configure(configure) = message {
            self.allows_reports = configure.paced_by_target || configure.drives_own_plate;
        }
        if let Some(exchange) = self.exchanges.get_mut(usize::from(sequence)) {
            *exchange = Exchange { request, ..Exchange::default() };
        }
    }

    pub(crate) fn drives_after_safe(&self) -> Option<DrivesAfterSafe> {
        self.drives_after_safe
    }

    pub(crate) fn take_drives_after_safe(&mut self) -> Option<DrivesAfterSafe> {
        self.drives_after_safe.take()
    }

    /// Checks a message in the order of arrival. `last_sent` is the number of the last request.
    pub(crate) fn record(&mut self, last_sent: u8, packet: &Packet) {
        match &packet.message {
            Message::Command(command) => {
                self.check_drive(command.drive_vpp);
                self.record_command(last_sent, packet.sequence, command);
                self.unrequested_messages += u64::from(self.is_unrequested_idle(packet.sequence, command));
            }
            Message::Telemetry(telemetry) => {
                self.check_drive(telemetry.drive_vpp);
                self.unrequested_messages += u64::from(self.is_silent);
            }
            Message::Tick(_) => self.unrequested_messages += u64::from(self.is_silent),
            Message::Identity(_) => {
                // A late answer to a hello of the handshake.
                let is_requested = packet.sequence == HELLO_NUMBER || self.request(packet.sequence) == Request::Other;
                self.unrequested_messages += u64::from(!is_requested);
            }
            Message::Configured(Configured { outcome }) => {
                let exchange = self.exchanges.get_mut(usize::from(packet.sequence));
                let Some(exchange) = exchange.filter(|exchange| exchange.request == Request::Configuration) else {
                    self.unrequested_messages += 1;
                    return;
                };
                self.second_replies += u64::from(exchange.is_configured);
                exchange.is_configured = true;
                self.is_safe &= outcome.is_err();
                self.is_silent = !self.allows_reports;
            }
            // Only the bench sends them.
            Message::Hello | Message::Configure(_) | Message::Sample(_) | Message::Safe | Message::Setpoint(_) => {
                self.unrequested_messages += 1;
            }
            Message::Fault(_) => {}
        }
    }

    fn request(&self, sequence: u8) -> Request {
        self.exchanges.get(usize::from(sequence)).map_or(Request::None, |exchange| exchange.request)
    }

    /// True for a command without a control step that answers no message. Other wrong commands have
    /// their own counts.
    fn is_unrequested_idle(&self, sequence: u8, command: &Command) -> bool {
        let answers = matches!(self.request(sequence), Request::Sample | Request::Safe);
        command.state == ControllerState::Idle && !answers
    }

    /// True for an identity or an answer to a configuration that the bench did not send. Wrong numbers
    /// of commands do not count, because a faulty controller sends them, too.
    pub(crate) fn is_unrequested_setup(&self, packet: &Packet) -> bool {
        let requested = self.exchanges.get(usize::from(packet.sequence)).map(|exchange| exchange.request);
        match packet.message {
            Message::Identity(_) => true,
            Message::Configured(_) => requested != Some(Request::Configuration),
            _ => false,
        }
    }

    fn check_drive(&mut self, drive_vpp: f32) {
        if !self.is_safe || drive_vpp == 0.0 {
            return;
        }
        let drives = self.drives_after_safe.get_or_insert(DrivesAfterSafe { count: 0, worst_vpp: drive_vpp });
        drives.count += 1;
        if drive_vpp.is_nan() || drive_vpp.abs() > drives.worst_vpp.abs() {
            drives.worst_vpp = drive_vpp;
        }
    }

    fn record_command(&mut self, last_sent: u8, sequence: u8, command: &Command) {
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
        let answers_command = matches!(request, Request::Sample | Request::Safe);
        match command.state {
            ControllerState::Running if !answers_command => {
                self.wrong_sequences += 1;
                return;
            }
            ControllerState::Safe if request != Request::Safe => {
                let contradicts = before.is_some_and(|before| before.0 != ControllerState::Safe);
                if !self.safe_requested || contradicts || !answers_command {
                    self.unrequested_confirmations += 1;
                    return;
                }
            }
            _ => {}
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
