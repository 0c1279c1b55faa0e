use super::*;
use crate::fault::wire_faults;
use crate::queue::collect;
use crate::watch::Watch;
use allocation_counter::{AllocationInfo, measure, opt_out};
use platebench_rig::{Hosted, LinkError, Paced, Serial, Terminal};
use platebench_scenario::load;
use platebench_wire::{FrameReader, Packet};
use std::path::Path;
use std::thread;

struct Patient;

impl Patience for Patient {
    fn is_over(&self) -> bool {
        false
    }
}

/// The target's own allocations are not the bench's.
struct Uncounted(Hosted);

impl Link for Uncounted {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let mut outcome = Ok(Duration::ZERO);
        opt_out(|| outcome = self.0.exchange(now, bytes, answer));
        outcome
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        let mut outcome = Ok(());
        opt_out(|| outcome = self.0.pass(now, said));
        outcome
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.0.restart()
    }
}

fn scenario(name: &str) -> Scenario {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios").join(name);
    load(&path, name).unwrap_or_else(|fault| panic!("{fault}"))
}

/// What the loop's thread allocates from its first control instant to the last while somebody looks on, and in how many periods.
fn allocated<L: Link>(scenario: &Scenario, session: &mut Session<Faulty<L>>, pacing: Pacing) -> (AllocationInfo, u64) {
    let (watch, mut viewer) = Watch::new();
    let mut lent = watch.lend(0, 0);
    let law = crate::configure::law(scenario).unwrap();
    let order = Order { scenario, law, index: 0, wire_time: false, own_clock: true };
    let pace = Pace { time_scale: 1.0, pacing };
    let (queue, consumer) = Queue::new();
    let collector = thread::spawn(|| collect(consumer, 0));
    let stage = Stage::new(scenario, 0, queue, lent.tap());
    session.link_mut().arm(&wire_faults(scenario, 0));
    session.begin(&pace.of_target(configure(scenario, law))).unwrap();
    let mut live = Live::new(session, &order, pace, stage, None);
    let mut outcome = Ok(());
    let allocated = measure(|| outcome = live.play(&Patient));
    assert!(outcome.is_ok(), "it came to its end");
    let periods = live.accounts.periods;
    drop(live);
    let rows = collector.join().unwrap();
    assert!(rows.len() as u64 > periods);
    let seen = std::iter::from_fn(|| viewer.take()).map(|sight| sight.row).collect::<Vec<_>>();
    assert!(!seen.is_empty() && rows.starts_with(&seen), "whoever looks on gets the rows of the record");
    (allocated, periods)
}

#[test]
fn the_loop_allocates_nothing_in_process() {
    for (name, pacing) in [
        ("paper/fig13-closed-loop.toml", Pacing::Bench),
        ("paper/fig13-closed-loop.toml", Pacing::Target),
        ("faults/disconnect-and-reconnect.toml", Pacing::Bench),
        ("faults/noise-storm.toml", Pacing::Bench),
        ("faults/late-commands.toml", Pacing::Bench),
    ] {
        let scenario = scenario(name);
        let mut session = Session::open(Faulty::new(Paced::new(Uncounted(Hosted::new())))).unwrap();
        let (allocated, periods) = allocated(&scenario, &mut session, pacing);
        assert!(periods > 10, "{name}: {periods}");
        assert_eq!(allocated, AllocationInfo::default(), "{name}, paced by {}", pacing.name());
    }
}

/// Plays the board until the line hangs up.
fn serve(mut port: Serial) {
    let start = Instant::now();
    let mut device = Hosted::new();
    let (mut bytes, mut answer) = (Vec::new(), Vec::new());
    loop {
        let soon = Instant::now() + Duration::from_micros(250);
        let Ok(arrived) = port.line().unwrap().receive(soon, &mut bytes) else { return };
        if arrived.is_some() {
            device.exchange(start.elapsed(), &bytes, &mut answer).unwrap();
            bytes.clear();
        }
        device.pass(start.elapsed(), &mut answer).unwrap();
        if port.line().unwrap().send(&answer).is_err() {
            return;
        }
        answer.clear();
    }
}

#[test]
fn the_loop_allocates_nothing_over_a_terminal() {
    let mut terminal = Terminal::open().unwrap();
    let port = Serial::open(Path::new(terminal.path()), 1_000_000).unwrap();
    let board = thread::spawn(|| serve(port));
    // A busy machine lets the first calls go unheard.
    let called = (0..100).find_map(|_| Session::open(Faulty::new(&mut terminal)).ok().map(|_| ()));
    assert!(called.is_some(), "nobody introduces itself");
    let mut session = Session::open(Faulty::new(terminal)).unwrap();
    let (allocated, periods) = allocated(&scenario("paper/fig13-closed-loop.toml"), &mut session, Pacing::Bench);
    assert!(periods > 10, "{periods}");
    assert_eq!(allocated, AllocationInfo::default());
    drop(session);
    board.join().unwrap();
}

/// Answers every sample but the one at the last control instant.
struct SilentAtLast {
    inner: Hosted,
    last_us: u32,
}

impl Link for SilentAtLast {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let mut reader = FrameReader::new();
        let mut messages =
            bytes.iter().filter_map(|&byte| Some(Packet::decode(reader.push(byte)?.ok()?).ok()?.message));
        let is_last =
            messages.any(|message| matches!(message, Message::Sample(sample) if sample.time_us == self.last_us));
        let before = answer.len();
        let took = self.inner.exchange(now, bytes, answer);
        if is_last {
            answer.truncate(before);
        }
        took
    }

    fn pass(&mut self, now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.pass(now, said)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.inner.restart()
    }
}

/// No further control instant would notice.
#[test]
fn a_last_sample_without_an_answer_is_a_missing_answer() {
    let scenario = scenario("paper/fig13-closed-loop.toml");
    let link = SilentAtLast { inner: Hosted::new(), last_us: 59_000 };
    let mut session = Session::open(Faulty::new(Paced::new(link))).unwrap();
    let order = Order { scenario: &scenario, law: LawId::DqPi, index: 0, wire_time: false, own_clock: true };
    let pace = Pace { time_scale: 1.0, pacing: Pacing::Bench };
    let played = crate::real_time::play(&mut session, &order, pace, &Patient).unwrap();
    let last = played.rows.last().unwrap();
    assert!(last.flags.contains(Flags::LINK_LOST) && played.lost.is_none(), "{last:?}");
    let timing = played.telemetry.timing.unwrap();
    // A computer that stalls may have skipped it; then its instant is an overrun.
    assert!(timing.missed_replies > 0 || timing.skipped > 0, "{timing:?}");
}
