//! Tests the summary of real-time runs in the console.

use super::fixtures;
use platebench_document::Style;
use platebench_model::record::{Quantiles, Telemetry, TimingRecord, TrialRecord};
use platebench_report::console;

fn timing() -> TimingRecord {
    TimingRecord {
        pacing: "bench".to_owned(),
        time_scale: 1.0,
        scheduling: "SCHED_FIFO".to_owned(),
        memory_locked: true,
        periods: 60,
        overruns: 0,
        skipped: 0,
        missed_replies: 0,
        lost_replies: 0,
        rejected_frames: 0,
        lost_rows: 0,
        lateness_us: Quantiles { p50: 4.0, p99: 30.0, p999: 55.0, max: 61.0 },
        loop_delay_us: Some(Quantiles { p50: 210.0, p99: 400.0, p999: 500.0, max: 525.0 }),
        loop_delay_budget_us: Some(1050.0),
        target_clock_ppm: Some(12.4),
        target_clock_error_ppm: Some(3.1),
        safe_confirmed: true,
        steal_ms: Some(0.0),
    }
}

fn table(trials: impl IntoIterator<Item = Option<TimingRecord>>) -> String {
    let mut scenario = fixtures::scenario(
        "paper/a.toml",
        "A",
        "dq-pi",
        vec![fixtures::passed_expectation("settling_time_ms", ("at_most", 2.0.into()), 1.9)],
    );
    scenario.trials = trials
        .into_iter()
        .map(|timing| TrialRecord {
            telemetry: Telemetry { timing: timing.map(Box::new), ..Telemetry::default() },
            ..fixtures::trial("paper/a.toml", 0, &[])
        })
        .collect();
    let table = console::run_table(&fixtures::run(vec![scenario]), Style::default());
    table.split_whitespace().collect::<Vec<_>>().join(" ")
}

fn summary(trials: impl IntoIterator<Item = Option<TimingRecord>>) -> Option<String> {
    let table = table(trials);
    let start = table.find("real time")?;
    Some(table[start..].split(" metric ").next().unwrap().to_owned())
}

#[test]
fn compares_the_delay_with_the_budget() {
    let second = TimingRecord { overruns: 2, missed_replies: 1, steal_ms: Some(20.0), ..timing() };
    assert_eq!(
        summary([Some(timing()), Some(second)]).unwrap(),
        "real time, paced by the bench; loop delay 210 µs median, 525 µs maximum, 20 % and 50 % of the 1050 µs of the \
         law's budget; samples late by 4 µs median, 61 µs maximum; 2 overruns, 1 missed replies in 120 periods; \
         controller's clock +12 ± 3 ppm; the hypervisor took 20 ms of processor time from this machine"
    );
}

#[test]
fn names_missing_permissions_and_confirmations() {
    let refused = TimingRecord {
        scheduling: "SCHED_OTHER, because SCHED_FIFO was not granted: 1".to_owned(),
        safe_confirmed: false,
        loop_delay_us: None,
        time_scale: 0.1,
        ..timing()
    };
    assert_eq!(
        summary([Some(refused)]).unwrap(),
        "real time at a time scale of 0.1, paced by the bench; samples late by 4 µs median, 61 µs maximum; no losses \
         in 60 periods; controller's clock +12 ± 3 ppm; SCHED_OTHER, because SCHED_FIFO was not granted: 1; 0 V was \
         not confirmed at the end"
    );
}

#[test]
fn lockstep_has_no_timing() {
    assert_eq!(summary([None]), None);
}
