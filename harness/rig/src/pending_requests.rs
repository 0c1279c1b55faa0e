//! Finds the answer that ends an exchange.

use platebench_wire::{ControllerState, Message, PacketReader};

#[derive(Debug, Default)]
pub(crate) struct PendingRequests {
    requests: PacketReader,
    answers: PacketReader,
    /// Sequence number of the awaited answer; `None` if the last message needs no answer.
    expected: Option<u8>,
    request: Request,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum Request {
    #[default]
    None,
    Sample,
    Setup,
    Other,
}

impl PendingRequests {
    /// Returns the request in the last complete message of `bytes`.
    pub(crate) fn send(&mut self, bytes: &[u8]) -> Request {
        (self.expected, self.request) = (None, Request::None);
        for packet in self.requests.packets(bytes).flatten() {
            let request = match packet.message {
                Message::Sample(_) => Request::Sample,
                Message::Hello | Message::Configure(_) => Request::Setup,
                Message::Setpoint(_) | Message::Safe => Request::Other,
                _ => continue,
            };
            (self.expected, self.request) = (Some(packet.sequence), request);
        }
        self.request
    }

    /// True if `byte` completes the expected answer, or a message after which no answer will come:
    /// a fault report, or a command in the state *running* with a number that was not sent yet.
    /// Ticks and telemetry do not count, because they have their own numbers.
    pub(crate) fn ends_wait(&mut self, byte: u8) -> bool {
        let (Some(Ok(packet)), Some(expected)) = (self.answers.push(byte), self.expected) else { return false };
        // Numbers wrap: 127 numbers after the expected one are ahead, the others are late.
        let is_ahead = (1..=u8::MAX / 2).contains(&packet.sequence.wrapping_sub(expected));
        match packet.message {
            Message::Fault(_) => true,
            Message::Command(command)
                if self.request == Request::Sample && command.state == ControllerState::Running && is_ahead =>
            {
                true
            }
            message => packet.sequence == expected && !message.is_unsolicited(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_wire::{Command, Packet, Sample, StateCause};
    use rstest::rstest;

    const SAMPLE: Message = Message::Sample(Sample { time_us: 0, setpoint_um: 2.0, wd_um: 0.0, wq_um: 0.0 });

    fn is_answered(request: Packet, answer: Packet) -> bool {
        let mut pending = PendingRequests::default();
        assert_ne!(pending.send(request.encode().as_bytes()), Request::None);
        answer.encode().as_bytes().iter().any(|&byte| pending.ends_wait(byte))
    }

    #[rstest]
    #[case::equal(7, true)]
    #[case::next(8, true)]
    #[case::last_one_ahead(7 + 127, true)]
    #[case::first_one_behind(7 + 128, false)]
    #[case::previous(6, false)]
    fn a_number_ahead_ends_the_wait_for_a_command(#[case] sequence: u8, #[case] expected: bool) {
        let command = Command {
            target_time_us: 0,
            drive_vpp: 1.0,
            frequency_mhz: 32_307_600,
            state: ControllerState::Running,
            cause: StateCause::None,
            flags: 0,
            compute_us: 0,
        };
        let answer = Packet { sequence, message: Message::Command(command) };
        assert_eq!(is_answered(Packet { sequence: 7, message: SAMPLE }, answer), expected);
        // The confirmation of 0 V has the number of its request.
        assert_eq!(is_answered(Packet { sequence: 7, message: Message::Safe }, answer), sequence == 7);
        // A stopped controller may use any number, and only the expected one ends the wait.
        let stopped = Command { state: ControllerState::Safe, ..command };
        let answer = Packet { sequence, message: Message::Command(stopped) };
        assert_eq!(is_answered(Packet { sequence: 7, message: SAMPLE }, answer), sequence == 7);
    }
}
