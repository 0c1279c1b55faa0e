//! Shows for each protocol fault a conversation in which its bytes differ from those of the correct
//! controller, and one in which they are equal.

use platebench_experiments::trust::{Mutant, MutantController, MutantSpec, protocol_faults};
use platebench_rig::{BoxedLink, HostedLink};
use platebench_test_kit::workspace_root;
use platebench_wire::{Command, Configure, EncodedFrame, Gains, LawId, Message, Packet, Sample, StateCause};
use rstest::rstest;
use std::collections::BTreeSet;
use std::fs;
use std::time::Duration;

const CONFIGURE: Configure = Configure { frequency_range_hz: 200.0, ..platebench_test_kit::CONFIGURE };

/// A dialogue with a controller; time advances between the messages.
struct Conversation {
    link: BoxedLink,
    now: Duration,
    sequence: u8,
    setpoint_um: f32,
    wq_um: f32,
    received: Vec<u8>,
}

impl Conversation {
    fn with(link: BoxedLink) -> Self {
        Self { link, now: Duration::ZERO, sequence: 0, setpoint_um: 2.0, wq_um: -0.1, received: Vec::new() }
    }

    fn raw(&mut self, bytes: &[u8]) {
        self.link.exchange(self.now, bytes, &mut self.received).unwrap();
    }

    fn body(&mut self, body: &[u8]) {
        self.raw(EncodedFrame::new(body).unwrap().as_bytes());
    }

    fn send(&mut self, message: Message) {
        self.sequence = self.sequence.wrapping_add(1);
        self.raw(Packet { sequence: self.sequence, message }.encode().as_bytes());
    }

    fn configure(&mut self, configure: Configure) {
        self.send(Message::Configure(configure));
    }

    /// Changes bytes in the body of a configuration with a loop delay of 400 µs.
    fn changed_configure(&mut self, change: impl Fn(&mut [u8])) {
        self.sequence += 1;
        let message = Message::Configure(Configure { loop_delay_us: 400, ..CONFIGURE });
        let frame = Packet { sequence: self.sequence, message }.encode();
        let mut reader = platebench_wire::FrameReader::new();
        let mut body = reader.read(&mut frame.as_bytes()).unwrap().unwrap().to_vec();
        change(&mut body);
        self.body(&body);
    }

    fn plate(&mut self, wd_um: f32, wq_um: f32) {
        let time_us = self.now.as_micros() as u32;
        self.send(Message::Sample(Sample { time_us, setpoint_um: self.setpoint_um, wd_um, wq_um }));
    }

    /// Sends samples 1 ms apart.
    fn samples(&mut self, count: u32) {
        for _ in 0..count {
            self.wait(1_000);
            self.plate(1.5, self.wq_um);
        }
    }

    /// Repeats the number of the last message as that of a sample.
    fn repeat(&mut self) {
        self.sequence = self.sequence.wrapping_sub(1);
        self.plate(1.5, self.wq_um);
    }

    fn reject(&mut self, count: usize) {
        self.raw(&[5, 0].repeat(count));
    }

    fn wait(&mut self, us: u64) {
        self.now += Duration::from_micros(us);
        self.link.advance_to(self.now, &mut self.received).unwrap();
    }

    /// Passes time without the controller's timer.
    fn busy(&mut self, us: u64) {
        self.now += Duration::from_micros(us);
    }

    fn watched(&mut self, watchdog_timeout_ms: u16) {
        self.configure(Configure { watchdog_timeout_ms, ..CONFIGURE });
    }

    fn safe(&mut self) {
        self.send(Message::Safe);
    }

    fn echo(&mut self) {
        let (state, cause) = (platebench_wire::ControllerState::Running, StateCause::None);
        let command =
            Command { target_time_us: 0, drive_vpp: 0.0, frequency_mhz: 0, state, cause, flags: 0, compute_us: 0 };
        self.raw(Packet { sequence: 0, message: Message::Command(command) }.encode().as_bytes());
    }
}

fn bytes(link: BoxedLink, talk: fn(&mut Conversation)) -> Vec<u8> {
    let mut conversation = Conversation::with(link);
    talk(&mut conversation);
    conversation.received
}

const GAINS: Gains = Gains { amplitude_kp: 100.0, amplitude_ki: 5e4, frequency_kp: 100.0, frequency_ki: 1e4 };

#[rstest]
#[case::clock("clock-of-27-bits", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.wait(1 << 27);
    talk.samples(1);
})]
#[case::deadline("deadline-without-wrap", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.wait((1 << 32) - 10_000);
    talk.samples(20);
})]
#[case::pool("configuration-pool", |talk: &mut Conversation| (0..513).for_each(|_| talk.configure(CONFIGURE)))]
#[case::mark("configuration-mark-of-9-bits", |talk: &mut Conversation| {
    (0..512).for_each(|_| talk.configure(CONFIGURE));
    talk.samples(1);
})]
#[case::steps("step-count-of-17-bits", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples((1 << 17) + 1);
})]
#[case::law_state("law-state-kept", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(3);
    talk.wait(5_000);
    talk.configure(CONFIGURE);
    talk.samples(1);
})]
#[case::rejected_count("rejected-count-kept", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(1);
    talk.reject(5);
    talk.configure(CONFIGURE);
    talk.samples(1);
    talk.reject(1);
    talk.samples(1);
})]
#[case::refusal("answer-kept-after-refusal", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(1);
    talk.configure(Configure { period_us: 0, ..CONFIGURE });
    talk.sequence -= 1;
    talk.repeat();
})]
#[case::frequency("frequency-kept", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(3);
    talk.configure(CONFIGURE);
    talk.safe();
})]
#[case::timeout("timeout-kept", |talk: &mut Conversation| {
    talk.watched(20);
    talk.configure(CONFIGURE);
    talk.samples(1);
    talk.wait(5_000);
})]
#[case::gains("gains-kept", |talk: &mut Conversation| {
    talk.configure(Configure { gains: Some(GAINS), ..CONFIGURE });
    talk.configure(CONFIGURE);
    talk.samples(1);
})]
#[case::second_stop("second-stop-not-reported", |talk: &mut Conversation| {
    for _ in 0..2 {
        talk.configure(CONFIGURE);
        talk.samples(1);
        talk.wait(5_000);
    }
})]
#[case::safe("answer-kept-after-safe", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(1);
    talk.safe();
    talk.sequence -= 1;
    talk.repeat();
})]
#[case::reload("watchdog-reload-overflow", |talk: &mut Conversation| {
    talk.watched(65_535);
    talk.samples(1);
    talk.wait(65_534_999);
})]
#[case::cycles("watchdog-in-cycles", |talk: &mut Conversation| {
    talk.watched(25_566);
    talk.samples(1);
    talk.wait(25_565_000);
})]
#[case::signed("watchdog-signed", |talk: &mut Conversation| {
    talk.watched(32_768);
    talk.samples(1);
    talk.wait(32_768_000);
})]
#[case::five_periods("five-periods-overflow", |talk: &mut Conversation| {
    talk.configure(Configure { period_us: 858_993_460, law: LawId::OpenLoop, ..CONFIGURE });
    talk.samples(1);
    talk.wait(858_993_460);
})]
#[case::second_sample("watchdog-from-second-sample", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(1);
    talk.wait(5_000);
})]
#[case::rejected_frames("watchdog-fed-by-rejected-frames", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(1);
    talk.wait(4_000);
    talk.reject(1);
    talk.wait(1_000);
})]
#[case::repeats("watchdog-fed-by-repeats", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(1);
    talk.wait(4_000);
    talk.repeat();
    talk.wait(1_000);
})]
#[case::limit("watchdog-after-limit", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(1);
    talk.busy(5_000);
    talk.plate(1.5, -0.1);
})]
#[case::order("values-before-watchdog", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(1);
    talk.busy(5_000);
    talk.plate(f32::NAN, 0.0);
})]
#[case::ticks("watchdog-of-10-ms-ticks", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(1);
    talk.wait(5_000);
})]
#[case::short_delay("short-delay-ignored", |talk: &mut Conversation| {
    talk.configure(Configure { loop_delay_us: 99, ..CONFIGURE });
    talk.samples(10);
})]
#[case::full_delay("full-period-delay-refused", |talk: &mut Conversation| {
    talk.configure(Configure { loop_delay_us: 1_000, ..CONFIGURE });
})]
#[case::one_flag("one-flag-only", |talk: &mut Conversation| {
    talk.configure(Configure { drive_limit_vpp: 1.0, frequency_slew_hz: 1.0, ..CONFIGURE });
    talk.samples(2);
})]
#[case::flags("flags-kept-in-stop", |talk: &mut Conversation| {
    talk.configure(Configure { drive_limit_vpp: 1.0, ..CONFIGURE });
    talk.samples(2);
    talk.wait(5_000);
})]
#[case::ramp("slow-ramp-lost", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    for _ in 0..5_000 {
        talk.samples(1);
        talk.setpoint_um += 0.5e-4;
    }
})]
#[case::setpoints("setpoint-list-full", |talk: &mut Conversation| {
    talk.configure(Configure { law: LawId::OpenLoop, ..CONFIGURE });
    for change in 0..4_097 {
        talk.setpoint_um = 1.0 + change as f32 * 1e-4;
        talk.samples(1);
    }
})]
#[case::infinite_wq("infinite-wq-accepted", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(1);
    talk.plate(1.5, f32::NEG_INFINITY);
})]
#[case::checksum("no-checksum-after-rejected", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(1);
    talk.reject(1);
    let sample = Sample { time_us: 0, setpoint_um: 2.0, wd_um: 1.0, wq_um: 0.0 };
    let mut frame = Packet { sequence: 200, message: Message::Sample(sample) }.encode().as_bytes().to_vec();
    let last = frame.len() - 2;
    frame[last] ^= 0x80;
    talk.raw(&frame);
})]
#[case::echo("echo-counted", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(1);
    (0..5).for_each(|_| talk.echo());
})]
#[case::invalid_body("invalid-body-not-counted", |talk: &mut Conversation| {
    talk.configure(CONFIGURE);
    talk.samples(1);
    (0..5).for_each(|_| talk.body(&[0x1f, 1]));
})]
#[case::number_0("number-0-as-forgotten", |talk: &mut Conversation| {
    talk.sequence = 254;
    talk.configure(CONFIGURE);
    talk.samples(1);
})]
#[case::slew(
    "zero-slew-accepted",
    |talk: &mut Conversation| talk.configure(Configure { frequency_slew_hz: 0.0, ..CONFIGURE })
)]
#[case::zero_delay("zero-delay-accepted", |talk: &mut Conversation| talk.changed_configure(|body| body[54..].fill(0)))]
#[case::unknown_law("unknown-law-answered", |talk: &mut Conversation| talk.changed_configure(|body| body[2] = 9))]
#[case::start("start-frequency-in-f32", |talk: &mut Conversation| {
    talk.configure(Configure { start_frequency_mhz: 32_307_601, ..CONFIGURE });
    talk.safe();
})]
#[case::negative_gain("negative-gain-refused", |talk: &mut Conversation| {
    talk.configure(Configure { gains: Some(Gains { frequency_ki: -1.0, ..GAINS }), ..CONFIGURE });
})]
#[case::unused_gains("unused-gains-checked", |talk: &mut Conversation| {
    talk.changed_configure(|body| body[38..42].copy_from_slice(&f32::NAN.to_le_bytes()));
})]
fn breaks_the_protocol_in_a_direct_conversation(#[case] name: &str, #[case] talk: fn(&mut Conversation)) {
    let fault = protocol_faults().into_iter().find(|fault| fault.name == name).unwrap();
    let correct = bytes(Box::new(HostedLink::new()), talk);
    assert!(bytes(fault.link(), talk) != correct, "no difference");
    assert!(bytes(unmutated(), talk) == correct, "the link around the controller differs");
}

struct Unmutated;

impl Mutant for Unmutated {}

fn unmutated() -> BoxedLink {
    Box::new(MutantController::new(HostedLink::new(), || Box::new(Unmutated)))
}

/// Trials without an event that a fault needs: with a repeated sample, rejected frames, a stop, a
/// refused configuration and a second trial of another law.
fn usual(talk: &mut Conversation) {
    talk.wq_um = 0.0;
    talk.send(Message::Hello);
    talk.watched(1_000);
    talk.samples(100);
    talk.repeat();
    talk.reject(2);
    talk.samples(300);
    talk.setpoint_um = 1.0;
    talk.samples(100);
    talk.plate(1.5, f32::NAN);
    talk.samples(2);
    talk.configure(Configure { drive_limit_vpp: -1.0, ..CONFIGURE });
    talk.samples(1);
    talk.configure(Configure { law: LawId::DqPiFixed, watchdog_timeout_ms: 500, loop_delay_us: 300, ..CONFIGURE });
    talk.samples(100);
    talk.safe();
    talk.samples(1);
}

#[test]
fn equals_the_correct_controller_without_its_event() {
    let correct = bytes(Box::new(HostedLink::new()), usual);
    let other: Vec<_> = protocol_faults()
        .into_iter()
        .filter(|fault: &MutantSpec| bytes(fault.link(), usual) != correct)
        .map(|fault| fault.name)
        .collect();
    assert!(other.is_empty(), "{other:?}");
}

#[test]
fn every_fault_has_a_unique_name_and_a_row_with_a_rule_of_the_protocol_page() {
    let read = |page| fs::read_to_string(workspace_root().join("docs").join(page)).unwrap();
    let (page, protocol) = (read("trust.md"), read("wire-protocol.md"));
    let headings: BTreeSet<_> =
        protocol.lines().filter(|line| line.starts_with("##")).map(|line| line.trim_matches(['#', ' ', '`'])).collect();
    let names: BTreeSet<_> = protocol_faults().iter().map(|fault| fault.name).collect();
    assert_eq!((names.len(), protocol_faults().len()), (40, 40));
    for fault in protocol_faults() {
        let row = format!("| {} | {} | ", fault.name, fault.description);
        let (_, rest) = page.split_once(&row).unwrap_or_else(|| panic!("not in docs/trust.md: {row}"));
        let mut cells = rest.split('|').map(str::trim);
        let (rule, scenarios) = (cells.next().unwrap(), cells.next().unwrap());
        assert!(headings.contains(rule), "{}: {rule:?}", fault.name);
        let witness = fault.witness_scenario.trim_end_matches(".toml");
        assert!(if witness.is_empty() { scenarios == "–" } else { scenarios.contains(witness) }, "{}", fault.name);
    }
}
