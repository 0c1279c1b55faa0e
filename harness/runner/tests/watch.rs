//! Whoever looks on changes nothing.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use platebench_record::Overrides;
use platebench_record::RunFolder;
use platebench_record::RunRecord;
use platebench_rig::RigSpec;
use platebench_runner::live_tap::{TapCounts, TapRow};
use platebench_runner::{Clock, LiveTap, Pacing, RunHooks, RunPlan, TapReader, TimeBase, run};
use platebench_scenario::{Direction, Scenario, load};
use platebench_trace::{Flags, Row, read_trace};
use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

fn scenario(name: &str) -> Scenario {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios").join(name);
    load(&path, name).unwrap_or_else(|fault| panic!("{fault}"))
}

fn plan(names: &[&str], trials: u32, clock: Clock, jobs: usize) -> RunPlan {
    let mut scenarios: Vec<_> = names.iter().map(|name| scenario(name)).collect();
    for scenario in &mut scenarios {
        (scenario.trials.count, scenario.trials.max_count) = (trials, trials);
    }
    let overrides = Overrides::default();
    RunPlan { scenarios, jobs, clock, own_clock: false, rig: "hosted".to_owned(), overrides }
}

/// Plays `plan` and returns its record and every trace, in the record's order.
fn run_with_tap(plan: &RunPlan, watch: &LiveTap) -> (RunRecord, Vec<Vec<u8>>) {
    let out = tempfile::tempdir().unwrap();
    let folder = RunFolder::create(Some(&out.path().join("run"))).unwrap();
    let connect = || match plan.clock {
        Clock::Lockstep { .. } => RigSpec::Hosted.connect(),
        Clock::RealTime(_) | Clock::RealPlate => RigSpec::Hosted.connect_real_time(),
    };
    let hooks = RunHooks { live_tap: watch.clone(), ..RunHooks::default() };
    let record = run(plan, &folder, &connect, hooks).unwrap();
    let trials = record.scenarios.iter().flat_map(|scenario| &scenario.trials);
    let traces = trials.map(|trial| fs::read(folder.path().join(&trial.trace)).unwrap()).collect();
    (record, traces)
}

fn drain(viewer: &mut TapReader) -> Vec<TapRow> {
    std::iter::from_fn(|| viewer.next_row()).collect()
}

fn read_rows(trace: &[u8]) -> Vec<Row> {
    let file = tempfile::NamedTempFile::new().unwrap();
    fs::write(file.path(), trace).unwrap();
    read_trace(file.path()).unwrap()
}

const LOCKSTEP: Clock = Clock::Lockstep { wire_time: false };
const NAMES: [&str; 3] =
    ["paper/fig13-closed-loop.toml", "paper/fig13-repeatability.toml", "faults/late-commands.toml"];

#[test]
fn traces_are_the_same_bytes_whether_somebody_looks_is_stuck_or_is_gone() {
    for jobs in [1, 3] {
        let plan = plan(&NAMES, 12, LOCKSTEP, jobs);
        let (_, alone) = run_with_tap(&plan, &LiveTap::default());
        assert_eq!(alone.len(), 36);

        let (stalled, viewer) = LiveTap::new();
        assert!(run_with_tap(&plan, &stalled).1 == alone, "{jobs} at once, a viewer that never looks");
        let counts = viewer.counts();
        // One trial is looked at at a time: of several at once so few that the queue may hold them all.
        assert!(counts.rows > counts.dropped_rows && (counts.dropped_rows > 0 || jobs > 1), "{counts:?}");

        let (looking, mut viewer) = LiveTap::new();
        let over = AtomicBool::new(false);
        thread::scope(|scope| {
            scope.spawn(|| {
                while !over.load(Ordering::Relaxed) {
                    drain(&mut viewer);
                }
            });
            assert!(run_with_tap(&plan, &looking).1 == alone, "{jobs} at once, a viewer that always looks");
            over.store(true, Ordering::Relaxed);
        });

        let (left, viewer) = LiveTap::new();
        drop(viewer);
        assert!(run_with_tap(&plan, &left).1 == alone, "{jobs} at once, a viewer that is gone");
    }
}

#[test]
fn whoever_looks_sees_the_rows_of_the_record() {
    let (watch, mut viewer) = LiveTap::new();
    let (_, traces) = run_with_tap(&plan(&NAMES[..2], 2, LOCKSTEP, 1), &watch);
    let sights = drain(&mut viewer);
    let mut trials: Vec<_> = sights.iter().map(|sight| (sight.scenario, sight.trial)).collect();
    trials.dedup();
    trials.sort_unstable();
    assert_eq!(trials, [(0, 0), (0, 1), (1, 0), (1, 1)], "each one as a whole");
    for ((scenario, trial), trace) in trials.into_iter().zip(&traces) {
        let of_trial = sights.iter().filter(|sight| (sight.scenario, sight.trial) == (scenario, trial));
        let seen: Vec<Row> = of_trial.map(|sight| sight.row).collect();
        assert!(seen == read_rows(trace), "scenario {scenario}, trial {trial}");
    }
    assert_eq!(viewer.counts().dropped_rows, 0);
}

#[test]
fn counts_are_those_of_the_record_in_lockstep() {
    let (watch, viewer) = LiveTap::new();
    let (_, traces) = run_with_tap(&plan(&["faults/lost-sample.toml"], 3, LOCKSTEP, 1), &watch);
    let rows: Vec<Row> = traces.iter().flat_map(|trace| read_rows(trace)).collect();
    let missed = rows.iter().filter(|row| row.flags.contains(Flags::LINK_LOST)).count() as u64;
    let counts = viewer.counts();
    assert!(missed > 0);
    assert_eq!((counts.rows, counts.missed_replies, counts.overruns), (rows.len() as u64, missed, 0));
}

#[test]
fn frames_that_cannot_be_read_are_counted() {
    let (watch, viewer) = LiveTap::new();
    let mut noisy = plan(&["faults/flipped-bit.toml"], 1, LOCKSTEP, 1);
    noisy.scenarios[0].faults[0].direction = Direction::FromController;
    run_with_tap(&noisy, &watch);
    assert_eq!(viewer.counts().rejected_frames, 1);
    let (watch, viewer) = LiveTap::new();
    run_with_tap(&plan(&NAMES[..1], 1, LOCKSTEP, 1), &watch);
    assert_eq!(viewer.counts().rejected_frames, 0);
}

#[test]
fn counts_are_those_of_the_record_in_real_time() {
    let pace = TimeBase { time_scale: 0.1, pacing: Pacing::Bench };
    let (watch, mut viewer) = LiveTap::new();
    let (record, traces) = run_with_tap(&plan(&NAMES[..1], 1, Clock::RealTime(pace), 1), &watch);
    let timing = record.scenarios[0].trials[0].telemetry.timing.as_ref().unwrap();
    let TapCounts {
        rows: pushed,
        dropped_rows: dropped,
        overruns,
        missed_replies: misses,
        rejected_frames: refused,
        lateness,
    } = viewer.counts();
    assert_eq!((overruns, misses, refused), (timing.overruns, timing.missed_replies, timing.rejected_frames));
    assert_eq!(lateness.iter().sum::<u64>(), timing.periods);
    assert_eq!((pushed, dropped, timing.lost_rows), (read_rows(&traces[0]).len() as u64, 0, 0));
    let seen: Vec<Row> = drain(&mut viewer).iter().map(|sight| sight.row).collect();
    assert!(seen == read_rows(&traces[0]));
}
