//! Finds the controller on a link: repeats the hello until an identity arrives.
//!
//! A line may begin with noise, a banner, or half a frame of an earlier session, and a board or a
//! program may start for seconds. All of them lose the first hello or damage the first answer.

use crate::cancel::CancelToken;
use crate::link::{Link, LinkError, LinkKind};
use crate::rejected_bytes::RejectedBytes;
use crate::rig_error::RigError;
use crate::wait_budget::WaitBudget;
use platebench_wire::{FaultReport, Identity, Message, Packet, PacketReader};
use std::thread;
use std::time::{Duration, Instant};
use tracing::debug;

/// Time in which the hello is repeated. Time in which the bench stood still does not count.
pub(crate) const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);
/// Shortest time from one hello to the next.
const HELLO_INTERVAL: Duration = Duration::from_millis(100);
/// Number of every hello before the session.
pub(crate) const HELLO_NUMBER: u8 = 0;
/// The answers to earlier hellos are read until the line is quiet for this time, but not longer
/// than the second time.
const QUIET: Duration = Duration::from_millis(100);
const MAX_DRAIN: Duration = Duration::from_secs(1);
const DRAIN_POLL_INTERVAL: Duration = Duration::from_millis(5);

/// `exit` returns how the controller's program ended, if it did.
pub(crate) fn handshake<L: Link + ?Sized>(
    link: &mut L,
    timeout: Duration,
    cancel: &CancelToken,
    exit: impl Fn() -> Option<String>,
) -> Result<Identity, RigError> {
    let hello = Packet { sequence: HELLO_NUMBER, message: Message::Hello }.encode();
    let is_simulated = link.kind() == LinkKind::Simulated;
    let attempts = (timeout.as_millis() / HELLO_INTERVAL.as_millis()).max(1);
    let mut answers = HandshakeAnswers::default();
    // A number of attempts, not a deadline, because the bench may stand still.
    for attempt in 1..=attempts {
        if cancel.is_cancelled() {
            return Err(RigError::Cancelled);
        }
        let asked = Instant::now();
        let mut bytes = Vec::new();
        let exchanged = link.exchange(Duration::ZERO, hello.as_bytes(), &mut bytes);
        if exchanged.is_err() {
            // A server that is in use sends its reason and hangs up, which the write notices first.
            let _ = link.advance_to(Duration::ZERO, &mut bytes);
        }
        answers.read(&bytes);
        if let Some(identity) = answers.identity {
            debug!(attempt, rejected = answers.rejected.bytes, "identity received");
            // The controller may answer another client, which stops when it notices this one.
            if attempt > 1 || link.kind() == LinkKind::Network {
                drain(link, cancel)?;
            }
            return Ok(identity);
        }
        exchanged.map_err(|error| answers.explain(error))?;
        if let Some(how) = exit() {
            return Err(LinkError::Ended(how).into());
        }
        if !is_simulated {
            cancel.sleep(HELLO_INTERVAL.saturating_sub(asked.elapsed()));
        }
    }
    Err(match answers.fault {
        Some(report) => RigError::Trapped(report),
        None => RigError::NoIdentity { waited: timeout, rejected: answers.rejected() },
    })
}

#[derive(Debug, Default)]
struct HandshakeAnswers {
    reader: PacketReader,
    identity: Option<Identity>,
    /// A report may be of an earlier session, so that an identity after it counts.
    fault: Option<FaultReport>,
    rejected: RejectedBytes,
    /// Number of bytes since the last frame.
    unfinished: u64,
}

impl HandshakeAnswers {
    fn read(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.unfinished += 1;
            self.rejected.keep_start(byte);
            match self.reader.push(byte) {
                Some(Ok(packet)) => {
                    self.unfinished = 0;
                    match packet.message {
                        Message::Identity(identity) => self.identity = Some(identity),
                        Message::Fault(report) => self.fault = Some(report),
                        _ => {}
                    }
                }
                Some(Err(error)) => {
                    self.rejected.frames += 1;
                    self.rejected.last = Some(error);
                    self.rejected.bytes += std::mem::take(&mut self.unfinished);
                }
                // An idle line.
                None if byte == 0 => self.unfinished = 0,
                None => {}
            }
        }
    }

    fn rejected(mut self) -> RejectedBytes {
        self.rejected.bytes += self.unfinished;
        self.rejected
    }

    /// Adds the text of a server that closes the connection, such as "Port already in use".
    fn explain(&self, error: LinkError) -> LinkError {
        match (error, self.rejected.text()) {
            (LinkError::Disconnected(reason), Some(text)) => {
                LinkError::Disconnected(format!("{reason}; it sent {text}"))
            }
            (error, _) => error,
        }
    }
}

/// Reads the answers to earlier hellos, so that no later request gets them.
fn drain<L: Link + ?Sized>(link: &mut L, cancel: &CancelToken) -> Result<(), RigError> {
    let mut budget = WaitBudget::new(MAX_DRAIN);
    let mut quiet_since = Instant::now();
    while quiet_since.elapsed() < QUIET && !cancel.is_cancelled() && budget.next_part(Instant::now()).is_some() {
        let mut bytes = Vec::new();
        link.advance_to(Duration::ZERO, &mut bytes)?;
        if link.kind() == LinkKind::Simulated {
            break;
        }
        if !bytes.is_empty() {
            quiet_since = Instant::now();
        }
        thread::sleep(DRAIN_POLL_INTERVAL);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rigs::hosted::HostedLink;
    use platebench_test_kit::IDENTITY;
    use rstest::rstest;

    const TIMEOUT: Duration = Duration::from_millis(500);

    /// Link whose answers to the hellos are listed; the last one repeats.
    struct ListedLink {
        kind: LinkKind,
        answers: Vec<Vec<u8>>,
        hellos: usize,
        late: Vec<u8>,
        is_closed: bool,
    }

    impl ListedLink {
        fn new(answers: impl IntoIterator<Item = Vec<u8>>) -> Self {
            let answers = answers.into_iter().collect();
            Self { kind: LinkKind::Lossy, answers, hellos: 0, late: Vec::new(), is_closed: false }
        }
    }

    impl Link for ListedLink {
        fn exchange(&mut self, _: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
            let sent: Vec<_> = PacketReader::new().packets(bytes).flatten().collect();
            assert_eq!(sent, [Packet { sequence: 0, message: Message::Hello }]);
            let listed = &self.answers[self.hellos.min(self.answers.len() - 1)];
            self.hellos += 1;
            if self.is_closed {
                self.late.clone_from(listed);
                return Err(crate::tty::disconnected("the other side has hung up"));
            }
            answer.extend(listed);
            Ok(Duration::ZERO)
        }

        fn advance_to(&mut self, _: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
            received.append(&mut self.late);
            Ok(())
        }

        fn kind(&self) -> LinkKind {
            self.kind
        }
    }

    fn identity() -> Vec<u8> {
        Packet { sequence: 0, message: Message::Identity(IDENTITY) }.encode().as_bytes().to_vec()
    }

    fn open(link: &mut ListedLink) -> Result<Identity, RigError> {
        handshake(link, TIMEOUT, &CancelToken::never(), || None)
    }

    /// `I` stands for an identity.
    fn bytes(answer: &[u8]) -> Vec<u8> {
        answer.iter().flat_map(|&byte| if byte == b'I' { identity() } else { vec![byte] }).collect()
    }

    #[rstest]
    #[case::at_once(&["I"], 1)]
    #[case::noise_before(&["\u{7}\tUI", "I"], 2)]
    #[case::a_banner(&["boot v1.2\r\nready\r\n", "I"], 3)]
    #[case::a_boot(&["", "", "", "", "I"], 5)]
    #[case::half_a_frame(&["\u{4}\u{16}\u{3}\0I"], 1)]
    #[case::rejected_by_the_controller(&["", "I"], 2)]
    #[case::silence(&[""], 5)]
    #[case::noise_only(&["\u{1}\u{2}\u{3}\0"], 5)]
    fn repeats_the_hello_until_an_identity_comes(#[case] answers: &[&str], #[case] hellos: usize) {
        let mut link = ListedLink::new(answers.iter().map(|answer| bytes(answer.as_bytes())));
        let found = open(&mut link);
        assert_eq!(found.is_ok(), answers.last().is_some_and(|last| last.ends_with('I')), "{found:?}");
        assert_eq!(link.hellos, hellos);
    }

    #[test]
    fn the_message_counts_rejected_bytes() {
        let message = |answers: &[&[u8]]| {
            let error = open(&mut ListedLink::new(answers.iter().map(|answer| answer.to_vec()))).unwrap_err();
            error.to_string()
        };
        assert!(message(&[b""]).contains("; no byte was rejected"));
        let noise = message(&[&[1, 2, 3, 0], &[9, 9], &[]]);
        assert!(noise.contains("; 6 bytes were rejected in 1 frame, the last one has"), "{noise}");
        let text = message(&[b"login: ", b""]);
        assert!(text.contains("; 7 bytes were rejected; they begin with \"login:\""), "{text}");
        let long = message(&[&[&[7; 100][..], &[0, 0]].concat(), b""]);
        assert!(long.contains("; 101 bytes were rejected in 1 frame, the last one has no end"), "{long}");
    }

    #[test]
    fn a_report_of_an_earlier_trap_does_not_end_it() {
        let report = FaultReport { code: 3, pc: 0, lr: 0, cfsr: 0, address: 0 };
        let fault = Packet { sequence: 0, message: Message::Fault(report) }.encode().as_bytes().to_vec();
        open(&mut ListedLink::new([fault.clone(), identity()])).unwrap();
        let trapped = open(&mut ListedLink::new([fault, Vec::new()]));
        assert!(matches!(trapped, Err(RigError::Trapped(found)) if found == report), "{trapped:?}");
    }

    #[test]
    fn the_text_of_a_server_that_hangs_up_is_quoted() {
        let mut link = ListedLink { is_closed: true, ..ListedLink::new([b"Port already in use\r\n".to_vec()]) };
        let error = open(&mut link).unwrap_err().to_string();
        assert!(error.ends_with("the other side has hung up; it sent \"Port already in use\""), "{error}");
    }

    #[test]
    fn late_identities_are_drained() {
        let mut link = ListedLink { late: identity().repeat(2), ..ListedLink::new([vec![], vec![], identity()]) };
        open(&mut link).unwrap();
        assert!(link.late.is_empty());
    }

    /// The first exchange takes longer than the whole time-out, as after SIGSTOP.
    #[test]
    fn a_stall_of_the_bench_is_no_silence_of_the_controller() {
        struct StalledLink(ListedLink);

        impl Link for StalledLink {
            fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
                if self.0.hellos == 0 {
                    thread::sleep(TIMEOUT + HELLO_INTERVAL);
                }
                self.0.exchange(now, bytes, answer)
            }

            fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
                self.0.advance_to(now, received)
            }
        }

        let mut link = StalledLink(ListedLink::new([vec![], vec![], identity()]));
        handshake(&mut link, TIMEOUT, &CancelToken::never(), || None).unwrap();
    }

    #[test]
    fn a_cancellation_or_the_end_of_the_program_ends_it() {
        let cancel = CancelToken::never();
        let ended = handshake(&mut ListedLink::new([vec![]]), TIMEOUT, &cancel, || Some("ended".to_owned()));
        assert!(matches!(ended, Err(RigError::Link(LinkError::Ended(_)))), "{ended:?}");
        cancel.cancel();
        let cancelled = handshake(&mut HostedLink::new(), TIMEOUT, &cancel, || None);
        assert!(matches!(cancelled, Err(RigError::Cancelled)), "{cancelled:?}");
    }
}
