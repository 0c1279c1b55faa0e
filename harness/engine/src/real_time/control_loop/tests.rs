use super::*;
use crate::live_tap::LiveTap;
use crate::row_queue::collect_rows;
use crate::trial::{configure, wire_faults};
use allocation_counter::{AllocationInfo, measure, opt_out};
use platebench_model::scenario::load;
use platebench_rig::{HostedLink, LinkError, PtyLink, SerialLink, WallClockLink};
use platebench_wire::{LawId, PacketReader};
use std::path::Path;
use std::thread;

struct UncountedLink(HostedLink);

impl Link for UncountedLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let mut outcome = Ok(Duration::ZERO);
        opt_out(|| outcome = self.0.exchange(now, bytes, answer));
        outcome
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        let mut outcome = Ok(());
        opt_out(|| outcome = self.0.advance_to(now, received));
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

fn count_allocations<L: Link>(
    scenario: &Scenario,
    session: &mut Session<FaultInjector<L>>,
    pacing: Pacing,
) -> (AllocationInfo, u64) {
    let (live_tap, mut tap_reader) = LiveTap::new();
    let mut guard = live_tap.acquire(0, 0);
    let law = crate::trial::law(scenario).unwrap();
    let trial = Trial { own_clock: true, ..Trial::new(scenario, law, 0) };
    let time_base = TimeBase { time_scale: 1.0, pacing };
    let (queue, consumer) = RowQueue::new();
    let collector = thread::spawn(|| collect_rows(consumer, 0));
    let plant = PlantSimulation::new(scenario, 0, queue, guard.tap());
    session.link_mut().set_faults(&wire_faults(scenario, 0));
    let configuration = time_base.with_target_timing(configure(scenario, law));
    session.start_line().unwrap();
    let gains = session.start_trial(&configuration).unwrap();
    let mut control_loop = RealTimeLoop::new(session, &trial, time_base, plant, None);
    let mut outcome = Ok(());
    let allocated = measure(|| outcome = control_loop.run(&configuration, &gains));
    assert!(outcome.is_ok(), "the trial did not end normally");
    let periods = control_loop.timing.counts.periods;
    drop(control_loop);
    let rows = collector.join().unwrap();
    assert!(rows.len() as u64 > periods);
    let seen = std::iter::from_fn(|| tap_reader.next_row()).map(|tap_row| tap_row.row).collect::<Vec<_>>();
    assert!(!seen.is_empty() && rows.starts_with(&seen), "the live view gets the rows of the record");
    (allocated, periods)
}

/// Repeats the trial until it had more than 10 periods, because a busy host skips some.
fn assert_no_allocations<L: Link>(name: &str, session: &mut Session<FaultInjector<L>>, pacing: Pacing) {
    let scenario = scenario(name);
    let mut periods = 0;
    for _ in 0..100 {
        let (allocated, played) = count_allocations(&scenario, session, pacing);
        assert_eq!(allocated, AllocationInfo::default(), "{name}, paced by {}", pacing.name());
        periods += played;
        if periods > 10 {
            return;
        }
    }
    panic!("{name}: {periods} periods in 100 trials");
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
        let mut session =
            Session::open(FaultInjector::new(WallClockLink::new(UncountedLink(HostedLink::new())))).unwrap();
        assert_no_allocations(name, &mut session, pacing);
    }
}

fn run_controller(mut port: SerialLink) {
    let start = Instant::now();
    let mut device = HostedLink::new();
    let (mut bytes, mut answer) = (Vec::new(), Vec::new());
    loop {
        let soon = Instant::now() + Duration::from_micros(250);
        let Ok(arrived) = port.real_time_line().unwrap().receive(soon, &mut bytes) else { return };
        if arrived.is_some() {
            device.exchange(start.elapsed(), &bytes, &mut answer).unwrap();
            bytes.clear();
        }
        device.advance_to(start.elapsed(), &mut answer).unwrap();
        if port.real_time_line().unwrap().send(&answer).is_err() {
            return;
        }
        answer.clear();
    }
}

#[test]
fn the_loop_allocates_nothing_over_a_terminal() {
    let mut terminal = PtyLink::open().unwrap();
    let port = SerialLink::open(Path::new(terminal.path()), 1_000_000).unwrap();
    let board = thread::spawn(|| run_controller(port));
    // On a busy host, the controller may miss the first requests.
    let opened = (0..100).find_map(|_| Session::open(FaultInjector::new(&mut terminal)).ok().map(|_| ()));
    assert!(opened.is_some(), "the controller does not send its identity");
    let mut session = Session::open(FaultInjector::new(terminal)).unwrap();
    assert_no_allocations("paper/fig13-closed-loop.toml", &mut session, Pacing::Bench);
    drop(session);
    board.join().unwrap();
}

struct SilentAtLastSample {
    inner: HostedLink,
    last_us: u32,
}

impl Link for SilentAtLastSample {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let is_last = PacketReader::new()
            .packets(bytes)
            .flatten()
            .any(|packet| matches!(packet.message, Message::Sample(sample) if sample.time_us == self.last_us));
        let before = answer.len();
        let took = self.inner.exchange(now, bytes, answer);
        if is_last {
            answer.truncate(before);
        }
        took
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.advance_to(now, received)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.inner.restart()
    }
}

#[test]
fn a_last_sample_without_an_answer_is_a_missing_answer() {
    let scenario = scenario("paper/fig13-closed-loop.toml");
    let link = SilentAtLastSample { inner: HostedLink::new(), last_us: 59_000 };
    let mut session = Session::open(FaultInjector::new(WallClockLink::new(link))).unwrap();
    let trial = Trial { own_clock: true, ..Trial::new(&scenario, LawId::DqPi, 0) };
    let time_base = TimeBase { time_scale: 1.0, pacing: Pacing::Bench };
    let result = crate::real_time::play(&mut session, trial, time_base).unwrap();
    let last = result.trace_rows.last().unwrap();
    let timing = result.telemetry.timing.unwrap();
    // A host that stalls may skip the last sample. Its control instant is then an overrun.
    let is_marked = last.flags.contains(Flags::LINK_LOST) || timing.skipped > 0;
    assert!(is_marked && result.link_error.is_none(), "{last:?} {timing:?}");
    assert!(timing.missed_replies > 0 || timing.skipped > 0, "{timing:?}");
}
