use crate::fixtures::{LOCKSTEP, plan};
use platebench_engine::live_tap::{TapCounts, TapRow};
use platebench_engine::{Clock, LiveTap, Pacing, RunHooks, RunPlan, TapReader, TimeBase, run};
use platebench_model::record::{RunFolder, RunRecord};
use platebench_model::scenario::Direction;
use platebench_model::trace::{Flags, Row, read_trace};
use platebench_rig::RigSpec;
use platebench_test_kit::load_scenario;
use std::sync::atomic::{AtomicBool, Ordering};
use std::{fs, thread};

fn plan_of(names: &[&str], trials: u32, clock: Clock) -> RunPlan {
    let mut scenarios: Vec<_> = names.iter().map(|name| load_scenario(name)).collect();
    for scenario in &mut scenarios {
        (scenario.trials.count, scenario.trials.max_count) = (trials, trials);
    }
    plan(scenarios, clock)
}

fn run_with_tap(plan: &RunPlan, tap: &LiveTap) -> (RunRecord, Vec<Vec<u8>>) {
    let out = tempfile::tempdir().unwrap();
    let folder = RunFolder::create(Some(&out.path().join("run"))).unwrap();
    let connect = || match plan.clock {
        Clock::Lockstep { .. } => RigSpec::hosted().connect(),
        Clock::RealTime(_) | Clock::RealPlate => RigSpec::hosted().connect_real_time(),
    };
    let hooks = RunHooks { live_tap: tap.clone(), ..RunHooks::default() };
    let record = run(plan, &folder, &connect, hooks).unwrap();
    let trials = record.scenarios.iter().flat_map(|scenario| &scenario.trials);
    let traces = trials.map(|trial| fs::read(folder.path().join(&trial.trace)).unwrap()).collect();
    (record, traces)
}

fn drain(reader: &mut TapReader) -> Vec<TapRow> {
    std::iter::from_fn(|| reader.next_row()).collect()
}

fn read_rows(trace: &[u8]) -> Vec<Row> {
    let file = tempfile::NamedTempFile::new().unwrap();
    fs::write(file.path(), trace).unwrap();
    read_trace(file.path()).unwrap()
}

const NAMES: [&str; 3] =
    ["paper/fig13-closed-loop.toml", "paper/fig13-repeatability.toml", "faults/late-commands.toml"];

#[test]
fn a_reader_does_not_change_the_traces() {
    for jobs in [1, 3] {
        let plan = RunPlan { jobs, ..plan_of(&NAMES, 12, LOCKSTEP) };
        let (_, expected) = run_with_tap(&plan, &LiveTap::default());
        assert_eq!(expected.len(), 36);

        let (stalled, reader) = LiveTap::new();
        assert!(run_with_tap(&plan, &stalled).1 == expected, "{jobs} jobs, a reader that never reads");
        let counts = reader.counts();
        // With several jobs, the tap follows only some trials. Their rows may fit into the queue.
        assert!(counts.rows > counts.dropped_rows && (counts.dropped_rows > 0 || jobs > 1), "{counts:?}");

        let (active, mut reader) = LiveTap::new();
        let is_finished = AtomicBool::new(false);
        thread::scope(|scope| {
            scope.spawn(|| {
                while !is_finished.load(Ordering::Relaxed) {
                    drain(&mut reader);
                }
            });
            assert!(run_with_tap(&plan, &active).1 == expected, "{jobs} jobs, a reader that always reads");
            is_finished.store(true, Ordering::Relaxed);
        });

        let (dropped, reader) = LiveTap::new();
        drop(reader);
        assert!(run_with_tap(&plan, &dropped).1 == expected, "{jobs} jobs, a dropped reader");
    }
}

#[test]
fn a_reader_sees_the_rows_of_the_record() {
    let (tap, mut reader) = LiveTap::new();
    let (_, traces) = run_with_tap(&plan_of(&NAMES[..2], 2, LOCKSTEP), &tap);
    let rows = drain(&mut reader);
    let mut trials: Vec<_> = rows.iter().map(|row| (row.scenario, row.trial)).collect();
    trials.dedup();
    trials.sort_unstable();
    assert_eq!(trials, [(0, 0), (0, 1), (1, 0), (1, 1)], "each trial as a whole");
    for ((scenario, trial), trace) in trials.into_iter().zip(&traces) {
        let of_trial = rows.iter().filter(|row| (row.scenario, row.trial) == (scenario, trial));
        let trial_rows: Vec<Row> = of_trial.map(|row| row.row).collect();
        assert!(trial_rows == read_rows(trace), "scenario {scenario}, trial {trial}");
    }
    assert_eq!(reader.counts().dropped_rows, 0);
}

#[test]
fn lockstep_counts_equal_the_record() {
    let (tap, reader) = LiveTap::new();
    let (_, traces) = run_with_tap(&plan_of(&["faults/lost-sample.toml"], 3, LOCKSTEP), &tap);
    let rows: Vec<Row> = traces.iter().flat_map(|trace| read_rows(trace)).collect();
    let missed = rows.iter().filter(|row| row.flags.contains(Flags::LINK_LOST)).count() as u64;
    let counts = reader.counts();
    assert!(missed > 0);
    assert_eq!((counts.rows, counts.missed_replies, counts.overruns), (rows.len() as u64, missed, 0));
}

#[test]
fn invalid_frames_are_counted() {
    let (tap, reader) = LiveTap::new();
    let mut noisy = plan_of(&["faults/flipped-bit.toml"], 1, LOCKSTEP);
    noisy.scenarios[0].faults[0].direction = Direction::FromController;
    run_with_tap(&noisy, &tap);
    assert_eq!(reader.counts().rejected_frames, 1);
    let (tap, reader) = LiveTap::new();
    run_with_tap(&plan_of(&NAMES[..1], 1, LOCKSTEP), &tap);
    assert_eq!(reader.counts().rejected_frames, 0);
}

#[test]
fn real_time_counts_equal_the_record() {
    let time_base = TimeBase { time_scale: 0.1, pacing: Pacing::Bench };
    let (tap, mut reader) = LiveTap::new();
    let (record, traces) = run_with_tap(&plan_of(&NAMES[..1], 1, Clock::RealTime(time_base)), &tap);
    let timing = record.scenarios[0].trials[0].telemetry.timing.as_ref().unwrap();
    let TapCounts { rows, dropped_rows, overruns, missed_replies, rejected_frames, lateness } = reader.counts();
    assert_eq!(
        (overruns, missed_replies, rejected_frames),
        (timing.overruns, timing.missed_replies, timing.rejected_frames)
    );
    assert_eq!(lateness.iter().sum::<u64>(), timing.periods);
    assert_eq!((rows, dropped_rows, timing.lost_rows), (read_rows(&traces[0]).len() as u64, 0, 0));
    let trial_rows: Vec<Row> = drain(&mut reader).iter().map(|row| row.row).collect();
    assert!(trial_rows == read_rows(&traces[0]));
}
