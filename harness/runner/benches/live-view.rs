//! What it costs the loop that somebody looks on: the table of `docs/live-view.md`.
//!
//! `cargo bench --ignore-rust-version -p platebench-runner --bench live-view`. All ways are played in turn within the same run, and processor time of the loop's thread is counted, so that ratios hold where
//! the computer does something else besides. In lockstep nothing waits, so that the loop's own work is all there is.

use platebench_rig::{FaultInjector, HostedLink, Session};
use platebench_runner::live_tap::{TapGuard, TapReader};
use platebench_runner::trial::{TrialSpec, play};
use platebench_runner::{CancelToken, LiveTap};
use platebench_scenario::load;
use platebench_wire::LawId;
use rustix::time::{ClockId, clock_gettime};
use std::error::Error;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

const SCENARIO: &str = "paper/fig13-closed-loop.toml";
/// Each one plays every way once.
const ROUNDS: usize = 60;
/// Of one way in a round.
const TRIALS: usize = 20;
/// As the live view looks.
const POLL_INTERVAL: Duration = Duration::from_millis(10);

const VARIANTS: [&str; 4] =
    ["nobody looks on", "nobody looks on, once more", "a view looks on", "a view that never looks: the queue is full"];

fn main() -> Result<(), Box<dyn Error>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios").join(SCENARIO);
    let scenario = load(&path, SCENARIO).map_err(|fault| fault.to_string())?;
    let order = TrialSpec { scenario: &scenario, law: LawId::DqPi, index: 0, wire_time: false, own_clock: false };
    let mut session = Session::open(FaultInjector::new(HostedLink::new()))?;
    let (looked_at, viewer) = LiveTap::new();
    let (stalled, never_looks) = LiveTap::new();
    let over = AtomicBool::new(false);
    let mut spent: [Vec<f64>; VARIANTS.len()] = Default::default();
    thread::scope(|scope| {
        scope.spawn(|| drain_until(viewer, &over));
        let watches = [LiveTap::default(), LiveTap::default(), looked_at, stalled];
        let mut taps = watches.each_ref().map(|watch| watch.acquire(0, 0));
        let cancel = CancelToken::default();
        // The first round warms up, and fills the queue that nobody empties.
        for round in 0..=ROUNDS {
            // Each way comes first as often as any other one.
            for place in 0..VARIANTS.len() {
                let way = (place + round) % VARIANTS.len();
                let (Some(tap), Some(of_way)) = (taps.get_mut(way), spent.get_mut(way)) else { continue };
                let took = time_trials(&mut session, &order, &cancel, tap);
                if round > 0 {
                    of_way.push(took);
                }
            }
        }
        over.store(true, Ordering::Relaxed);
    });
    let lost = never_looks.counts().dropped_rows;
    let baseline = spent.first().cloned().unwrap_or_default();
    println!("| lockstep, hosted, {SCENARIO} | ns per row, median | ratio, median | quartiles |\n|---|---|---|---|");
    for (way, of_way) in VARIANTS.iter().zip(&mut spent) {
        let mut ratios: Vec<f64> = of_way.iter().zip(&baseline).map(|(took, base)| took / base).collect();
        let [q1, median, q3] = quartiles(&mut ratios);
        let [_, ns, _] = quartiles(of_way);
        println!("| {way} | {ns:.0} | {median:.3} | {q1:.3} to {q3:.3} |");
    }
    println!("\n{ROUNDS} rounds of {TRIALS} trials; {lost} rows found no room in the queue that nobody emptied");
    Ok(())
}

/// Processor time per row, ns.
fn time_trials(
    session: &mut Session<FaultInjector<HostedLink>>,
    order: &TrialSpec<'_>,
    cancel: &CancelToken,
    lent: &mut TapGuard<'_>,
) -> f64 {
    let mut rows = 0;
    let begun = processor_s();
    for _ in 0..TRIALS {
        rows += play(session, order, cancel, lent.tap()).map_or(0, |played| played.trace_rows.len());
    }
    (processor_s() - begun) * 1e9 / rows.max(1) as f64
}

/// Of this thread.
fn processor_s() -> f64 {
    let spent = clock_gettime(ClockId::ThreadCPUTime);
    spent.tv_sec as f64 + spent.tv_nsec as f64 / 1e9
}

fn drain_until(mut viewer: TapReader, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        while viewer.next_row().is_some() {}
        thread::sleep(POLL_INTERVAL);
    }
}

fn quartiles(values: &mut [f64]) -> [f64; 3] {
    values.sort_by(f64::total_cmp);
    [1, 2, 3].map(|quarter| values.get(values.len() * quarter / 4).copied().unwrap_or(f64::NAN))
}
