//! Measures by how much a live view slows down the trial loop, for the table of
//! `docs/live-view.md`. Variants alternate and only processor time counts, so the ratios hold on a
//! busy computer.

use platebench_engine::live_tap::{TapGuard, TapReader};
use platebench_engine::lockstep::play;
use platebench_engine::{LiveTap, Trial};
use platebench_model::scenario::{Scenario, load};
use platebench_rig::{FaultInjector, HostedLink, Session};
use platebench_wire::LawId;
use rustix::time::{ClockId, clock_gettime};
use std::error::Error;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

const SCENARIO: &str = "paper/fig13-closed-loop.toml";
const ROUNDS: usize = 60;
const TRIALS: usize = 20;
const POLL_INTERVAL: Duration = Duration::from_millis(10);

const VARIANTS: [&str; 4] =
    ["without a view", "without a view, repeated", "with a view", "with a view that never reads: the queue is full"];

fn main() -> Result<(), Box<dyn Error>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios").join(SCENARIO);
    let scenario = load(&path, SCENARIO).map_err(|fault| fault.to_string())?;
    let mut session = Session::open(FaultInjector::new(HostedLink::new()))?;
    let (active, reader) = LiveTap::new();
    let (stalled, idle_reader) = LiveTap::new();
    let is_finished = AtomicBool::new(false);
    let mut spent: [Vec<f64>; VARIANTS.len()] = Default::default();
    thread::scope(|scope| {
        scope.spawn(|| drain_until(reader, &is_finished));
        let live_taps = [LiveTap::default(), LiveTap::default(), active, stalled];
        let mut taps = live_taps.each_ref().map(|tap| tap.acquire(0, 0));
        // The first round is not measured. It fills the queue that has no active reader.
        for round in 0..=ROUNDS {
            for place in 0..VARIANTS.len() {
                let variant = (place + round) % VARIANTS.len();
                let (Some(tap), Some(times)) = (taps.get_mut(variant), spent.get_mut(variant)) else { continue };
                let time = time_trials(&mut session, &scenario, tap);
                if round > 0 {
                    times.push(time);
                }
            }
        }
        is_finished.store(true, Ordering::Relaxed);
    });
    let lost = idle_reader.counts().dropped_rows;
    let baseline = spent.first().cloned().unwrap_or_default();
    println!("| lockstep, hosted, {SCENARIO} | ns per row, median | ratio, median | quartiles |\n|---|---|---|---|");
    for (variant, times) in VARIANTS.iter().zip(&mut spent) {
        let mut ratios: Vec<f64> = times.iter().zip(&baseline).map(|(time, base)| time / base).collect();
        let [q1, median, q3] = quartiles(&mut ratios);
        let [_, ns, _] = quartiles(times);
        println!("| {variant} | {ns:.0} | {median:.3} | {q1:.3} to {q3:.3} |");
    }
    println!("\n{ROUNDS} rounds of {TRIALS} trials; {lost} rows were dropped by the full queue");
    Ok(())
}

fn time_trials(session: &mut Session<FaultInjector<HostedLink>>, scenario: &Scenario, tap: &mut TapGuard<'_>) -> f64 {
    let mut rows = 0;
    let begun = processor_s();
    for _ in 0..TRIALS {
        let trial = Trial { tap: tap.tap(), ..Trial::new(scenario, LawId::DqPi, 0) };
        rows += play(session, trial).map_or(0, |result| result.trace_rows.len());
    }
    (processor_s() - begun) * 1e9 / rows.max(1) as f64
}

fn processor_s() -> f64 {
    let spent = clock_gettime(ClockId::ThreadCPUTime);
    spent.tv_sec as f64 + spent.tv_nsec as f64 / 1e9
}

fn drain_until(mut reader: TapReader, is_finished: &AtomicBool) {
    while !is_finished.load(Ordering::Relaxed) {
        while reader.next_row().is_some() {}
        thread::sleep(POLL_INTERVAL);
    }
}

fn quartiles(values: &mut [f64]) -> [f64; 3] {
    values.sort_by(f64::total_cmp);
    [1, 2, 3].map(|quarter| values.get(values.len() * quarter / 4).copied().unwrap_or(f64::NAN))
}
