use super::*;
use crate::live_tap::LiveTap;
use crate::plant_simulation::collect_rows;
use crate::trial::{TrialResult, configure, set_line_faults};
use allocation_counter::{AllocationInfo, measure, opt_out};
use platebench_rig::{HostedLink, LinkError, PtyLink, RealTimeLine, SerialLink, WallClockLink};
use platebench_test_kit::{ScriptedLink, load_scenario, packets};
use platebench_wire::{LawId, Packet};
use std::path::Path;
use std::thread;

const PERIOD: Time = Time::from_nanos(1_000_000);

#[test]
fn measures_lateness_against_punctual_ticks() {
    let start = Instant::now();
    let mut ticks = TickTracker::default();
    let mut tick = |number: u32, late_us: u64| {
        let at = start + Duration::from_micros(u64::from(number) * 1_000 + 100 + late_us);
        let target = (f64::from(number) * 1_000.0 * (1.0 - 50e-6)) as u32;
        ticks.record(at, 0xFFFF_0000_u32.wrapping_add(target), PERIOD).0.as_micros()
    };
    assert_eq!(tick(0, 0), 0);
    assert!((299..=301).contains(&tick(1, 300)));
    assert!(tick(2, 0) <= 1);
    for number in 3..5_000 {
        let lateness = tick(number, 0);
        assert!(lateness <= 60, "tick {number}: drift of two intervals at most, not {lateness}");
    }
    let lateness = tick(5_000, 400);
    assert!((400..=460).contains(&lateness), "{lateness}");
}

#[test]
fn a_late_first_tick_shows_in_the_second() {
    let start = Instant::now();
    let mut ticks = TickTracker::default();
    let mut tick = |number: u32, late_us: u64| {
        let at = start + Duration::from_micros(u64::from(number) * 1_000 + late_us);
        ticks.record(at, number * 1_000, PERIOD).0.as_micros()
    };
    assert_eq!([tick(0, 900), tick(1, 500), tick(2, 0), tick(3, 0), tick(4, 10)], [0, 400, 500, 0, 10]);
}

#[test]
fn counts_missing_ticks_across_the_wrap() {
    let mut ticks = TickTracker::default();
    let start = 0xFFFF_FF00_u32;
    let mut missing = |target_us: u32| ticks.record(Instant::now(), start.wrapping_add(target_us), PERIOD).1;
    assert_eq!([0, 1_000, 1_990, 3_000, 7_000, 8_499, 10_000].map(&mut missing), [0, 0, 0, 0, 3, 0, 1]);
    assert_eq!([9_000, 10_000].map(&mut missing), [0, 0], "the counter does not go back");
}

#[test]
fn a_target_that_handles_its_tick_late_is_late() {
    let start = Instant::now();
    let mut ticks = TickTracker::default();
    let mut tick = |number: u32, late_us: u32| {
        let target_us = number * 1_000 + late_us;
        ticks.record(start + Duration::from_micros(target_us.into()), target_us, PERIOD).0.as_micros()
    };
    assert_eq!([tick(0, 0), tick(1, 220), tick(2, 0), tick(3, 450)], [0, 220, 0, 450]);
}

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
    set_line_faults(session.link_mut(), scenario, 0);
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

/// Repeats the trial until it had more than 10 periods, because a busy host skips some. Prints how
/// often.
fn assert_no_allocations<L: Link>(name: &str, session: &mut Session<FaultInjector<L>>, pacing: Pacing) {
    let scenario = load_scenario(name);
    let mut periods = 0;
    for trials in 1..=100 {
        let (allocated, played) = count_allocations(&scenario, session, pacing);
        assert_eq!(allocated, AllocationInfo::default(), "{name}, paced by {}", pacing.name());
        periods += played;
        if periods > 10 {
            println!("{name}, paced by {}: {trials} trials", pacing.name());
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
            Session::open(FaultInjector::new(WallClockLink::in_simulated_time(UncountedLink(HostedLink::new()))))
                .unwrap();
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

#[test]
fn a_last_sample_without_an_answer_is_a_missing_answer() {
    let scenario = load_scenario("paper/fig13-closed-loop.toml");
    let link = ScriptedLink::new(|controller, now, bytes, answer| {
        let is_last = |packet: &Packet| matches!(packet.message, Message::Sample(sample) if sample.time_us == 59_000);
        let received = if packets(bytes).iter().any(is_last) { &mut Vec::new() } else { answer };
        controller.exchange(now, bytes, received)
    });
    let result = play(&scenario, WallClockLink::in_simulated_time(link));
    let last = result.trace_rows.last().unwrap();
    let timing = result.telemetry.timing.unwrap();
    assert!(last.flags.contains(Flags::LINK_LOST) && result.link_error.is_none(), "{last:?} {timing:?}");
    assert_eq!((timing.missed_replies, timing.overruns), (1, 0), "{timing:?}");
}

/// Drops the messages of the controller from the tenth sample on, for 25 samples.
struct SilentLink {
    inner: HostedLink,
    samples: u32,
}

impl SilentLink {
    fn is_silent(&self) -> bool {
        (10..35).contains(&self.samples)
    }
}

impl Link for SilentLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        if packets(bytes).iter().any(|packet| matches!(packet.message, Message::Sample(_))) {
            self.samples += 1;
        }
        let before = answer.len();
        let took = self.inner.exchange(now, bytes, answer);
        answer.truncate(if self.is_silent() { before } else { answer.len() });
        took
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        let before = received.len();
        let advanced = self.inner.advance_to(now, received);
        received.truncate(if self.is_silent() { before } else { received.len() });
        advanced
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.inner.restart()
    }
}

/// Stalls the bench while it sends the tenth sample.
struct StalledLink {
    inner: WallClockLink<SilentLink>,
    samples: u32,
    stall: Duration,
}

impl Link for StalledLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        self.inner.exchange(now, bytes, answer)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.advance_to(now, received)
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        Some(self)
    }
}

impl StalledLink {
    fn past_stall(&self) -> Duration {
        if self.samples < 10 { Duration::ZERO } else { self.stall }
    }
}

impl RealTimeLine for StalledLink {
    fn now(&mut self) -> Instant {
        self.inner.now() + self.past_stall()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.samples += 1;
        self.inner.send(bytes)
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        let stall = self.past_stall();
        let arrived = self.inner.receive(until.checked_sub(stall).unwrap(), bytes)?;
        Ok(arrived.map(|at| at + stall))
    }
}

fn play<L: Link>(scenario: &Scenario, link: L) -> TrialResult {
    let mut session = Session::open(FaultInjector::new(link)).unwrap();
    let trial = Trial { own_clock: true, ..Trial::new(scenario, LawId::DqPi, 0) };
    let time_base = TimeBase { time_scale: 1.0, pacing: Pacing::Bench };
    crate::real_time::play(&mut session, trial, time_base).unwrap()
}

#[test]
fn a_stall_of_the_bench_is_no_silence_of_the_controller() {
    let mut scenario = load_scenario("paper/fig13-closed-loop.toml");
    scenario.duration = Time::from_nanos(700_000_000);
    let inner = WallClockLink::in_simulated_time(SilentLink { inner: HostedLink::new(), samples: 0 });
    let result = play(&scenario, StalledLink { inner, samples: 0, stall: Duration::from_millis(400) });
    assert!(result.link_error.is_none(), "{:?}", result.link_error);
    let timing = result.telemetry.timing.unwrap();
    // The sample at 9 ms is sent before the stall, and the one at 409 ms is the first after it.
    assert_eq!((timing.skipped, timing.missed_replies), (399, 25), "{timing:?}");
}
