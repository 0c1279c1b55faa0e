//! Whoever looks on changes nothing.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use platebench_rig::RigSpec;
use platebench_runner::watch::{Counts, Sight};
use platebench_runner::{Cancel, Clock, Company, Nobody, Pace, Pacing, Plan, RunFolder, Viewer, Watch, run_in_company};
use platebench_scenario::{Direction, Scenario, load};
use platebench_trace::{Flags, Row, read};
use platebench_verdict::RunRecord;
use platebench_verdict::record::Overrides;
use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

fn scenario(name: &str) -> Scenario {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios").join(name);
    load(&path, name).unwrap_or_else(|fault| panic!("{fault}"))
}

fn plan(names: &[&str], trials: u32, clock: Clock, jobs: usize) -> Plan {
    let mut scenarios: Vec<_> = names.iter().map(|name| scenario(name)).collect();
    for scenario in &mut scenarios {
        (scenario.trials.count, scenario.trials.max_count) = (trials, trials);
    }
    let overrides = Overrides::default();
    Plan { scenarios, jobs, clock, own_clock: false, rig: "hosted".to_owned(), overrides }
}

/// Plays `plan` and returns its record and every trace, in the record's order.
fn played(plan: &Plan, watch: &Watch) -> (RunRecord, Vec<Vec<u8>>) {
    let out = tempfile::tempdir().unwrap();
    let folder = RunFolder::create(Some(&out.path().join("run"))).unwrap();
    let connect = || match plan.clock {
        Clock::Lockstep { .. } => RigSpec::Hosted.connect(),
        Clock::RealTime(_) | Clock::OwnPlate => RigSpec::Hosted.connect_in_real_time(),
    };
    let company = Company { person: &Nobody, watch };
    let record = run_in_company(plan, &folder, &connect, &Cancel::default(), company, &mut |_| {}).unwrap();
    let trials = record.scenarios.iter().flat_map(|scenario| &scenario.trials);
    let traces = trials.map(|trial| fs::read(folder.path().join(&trial.trace)).unwrap()).collect();
    (record, traces)
}

fn taken(viewer: &mut Viewer) -> Vec<Sight> {
    std::iter::from_fn(|| viewer.take()).collect()
}

fn rows(trace: &[u8]) -> Vec<Row> {
    let file = tempfile::NamedTempFile::new().unwrap();
    fs::write(file.path(), trace).unwrap();
    read(file.path()).unwrap()
}

const LOCKSTEP: Clock = Clock::Lockstep { wire_time: false };
const NAMES: [&str; 3] =
    ["paper/fig13-closed-loop.toml", "paper/fig13-repeatability.toml", "faults/late-commands.toml"];

#[test]
fn traces_are_the_same_bytes_whether_somebody_looks_is_stuck_or_is_gone() {
    for jobs in [1, 3] {
        let plan = plan(&NAMES, 12, LOCKSTEP, jobs);
        let (_, alone) = played(&plan, &Watch::default());
        assert_eq!(alone.len(), 36);

        let (stalled, viewer) = Watch::new();
        assert!(played(&plan, &stalled).1 == alone, "{jobs} at once, a viewer that never looks");
        let counts = viewer.counts();
        // One trial is looked at at a time: of several at once so few that the queue may hold them all.
        assert!(counts.rows > counts.dropped && (counts.dropped > 0 || jobs > 1), "{counts:?}");

        let (looking, mut viewer) = Watch::new();
        let over = AtomicBool::new(false);
        thread::scope(|scope| {
            scope.spawn(|| {
                while !over.load(Ordering::Relaxed) {
                    taken(&mut viewer);
                }
            });
            assert!(played(&plan, &looking).1 == alone, "{jobs} at once, a viewer that always looks");
            over.store(true, Ordering::Relaxed);
        });

        let (left, viewer) = Watch::new();
        drop(viewer);
        assert!(played(&plan, &left).1 == alone, "{jobs} at once, a viewer that is gone");
    }
}

#[test]
fn whoever_looks_sees_the_rows_of_the_record() {
    let (watch, mut viewer) = Watch::new();
    let (_, traces) = played(&plan(&NAMES[..2], 2, LOCKSTEP, 1), &watch);
    let sights = taken(&mut viewer);
    let mut trials: Vec<_> = sights.iter().map(|sight| (sight.scenario, sight.trial)).collect();
    trials.dedup();
    trials.sort_unstable();
    assert_eq!(trials, [(0, 0), (0, 1), (1, 0), (1, 1)], "each one as a whole");
    for ((scenario, trial), trace) in trials.into_iter().zip(&traces) {
        let of_trial = sights.iter().filter(|sight| (sight.scenario, sight.trial) == (scenario, trial));
        let seen: Vec<Row> = of_trial.map(|sight| sight.row).collect();
        assert!(seen == rows(trace), "scenario {scenario}, trial {trial}");
    }
    assert_eq!(viewer.counts().dropped, 0);
}

#[test]
fn counts_are_those_of_the_record_in_lockstep() {
    let (watch, viewer) = Watch::new();
    let (_, traces) = played(&plan(&["faults/lost-sample.toml"], 3, LOCKSTEP, 1), &watch);
    let rows: Vec<Row> = traces.iter().flat_map(|trace| rows(trace)).collect();
    let missed = rows.iter().filter(|row| row.flags.contains(Flags::LINK_LOST)).count() as u64;
    let counts = viewer.counts();
    assert!(missed > 0);
    assert_eq!((counts.rows, counts.misses, counts.overruns), (rows.len() as u64, missed, 0));
}

#[test]
fn frames_that_cannot_be_read_are_counted() {
    let (watch, viewer) = Watch::new();
    let mut noisy = plan(&["faults/flipped-bit.toml"], 1, LOCKSTEP, 1);
    noisy.scenarios[0].faults[0].direction = Direction::FromController;
    played(&noisy, &watch);
    assert_eq!(viewer.counts().refused, 1);
    let (watch, viewer) = Watch::new();
    played(&plan(&NAMES[..1], 1, LOCKSTEP, 1), &watch);
    assert_eq!(viewer.counts().refused, 0);
}

#[test]
fn counts_are_those_of_the_record_in_real_time() {
    let pace = Pace { time_scale: 0.1, pacing: Pacing::Bench };
    let (watch, mut viewer) = Watch::new();
    let (record, traces) = played(&plan(&NAMES[..1], 1, Clock::RealTime(pace), 1), &watch);
    let timing = record.scenarios[0].trials[0].telemetry.timing.as_ref().unwrap();
    let Counts { rows: pushed, dropped, overruns, misses, refused, lateness } = viewer.counts();
    assert_eq!((overruns, misses, refused), (timing.overruns, timing.missed_replies, timing.refused_frames));
    assert_eq!(lateness.iter().sum::<u64>(), timing.periods);
    assert_eq!((pushed, dropped, timing.lost_rows), (rows(&traces[0]).len() as u64, 0, 0));
    let seen: Vec<Row> = taken(&mut viewer).iter().map(|sight| sight.row).collect();
    assert!(seen == rows(&traces[0]));
}
