//! Changes what passes between the bench and a hosted controller.

use platebench_rig::{HostedLink, Link, LinkError, LinkKind};
use platebench_wire::{Command, Message, Packet, PacketReader};
use std::time::Duration;

/// Link whose script makes each exchange. The script gets a hosted controller, the time, the
/// request and the buffer for the answer.
///
/// A restart resets the controller and the variables that the script owns, but not what it shares.
/// The link has no real-time line, because the messages on it would not pass the script.
#[derive(Clone)]
pub struct ScriptedLink<F> {
    controller: HostedLink,
    kind: LinkKind,
    script: F,
    initial_script: F,
}

impl<F> ScriptedLink<F>
where
    F: FnMut(&mut HostedLink, Duration, &[u8], &mut Vec<u8>) -> Result<Duration, LinkError> + Clone,
{
    #[must_use]
    pub fn new(script: F) -> Self {
        let kind = LinkKind::Simulated;
        Self { controller: HostedLink::new(), kind, initial_script: script.clone(), script }
    }

    #[must_use]
    pub fn of_kind(self, kind: LinkKind) -> Self {
        Self { kind, ..self }
    }
}

impl<F> Link for ScriptedLink<F>
where
    F: FnMut(&mut HostedLink, Duration, &[u8], &mut Vec<u8>) -> Result<Duration, LinkError> + Clone + Send,
{
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        (self.script)(&mut self.controller, now, bytes, answer)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.controller.advance_to(now, received)
    }

    fn kind(&self) -> LinkKind {
        self.kind
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.script.clone_from(&self.initial_script);
        self.controller.restart()
    }

    fn continue_trial(&mut self) {
        self.controller.continue_trial();
    }
}

/// Returns a link whose answers `change` edits. `change` also gets the time and the requests.
pub fn link_with_changed_answers(
    mut change: impl FnMut(Duration, &[Packet], &mut Vec<Packet>) + Clone + Send,
) -> impl Link + Clone {
    ScriptedLink::new(move |controller, now, bytes, answer| {
        let mut own = Vec::new();
        let delay = controller.exchange(now, bytes, &mut own)?;
        let mut answers = packets(&own);
        change(now, &packets(bytes), &mut answers);
        answer.extend(answers.iter().flat_map(|packet| packet.encode().as_bytes().to_vec()));
        Ok(delay)
    })
}

/// Decodes the valid frames in `bytes`.
#[must_use]
pub fn packets(bytes: &[u8]) -> Vec<Packet> {
    PacketReader::new().packets(bytes).flatten().collect()
}

pub fn commands(packets: &mut [Packet]) -> impl Iterator<Item = &mut Command> {
    packets.iter_mut().filter_map(|packet| match &mut packet.message {
        Message::Command(command) => Some(command),
        _ => None,
    })
}
