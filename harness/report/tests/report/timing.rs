//! How real time was kept, as the console says it.

use super::made;
use platebench_report::{Style, console};
use platebench_verdict::record::{Quantiles, Timing};
use platebench_verdict::{Telemetry, TrialRecord};

fn timing() -> Timing {
    Timing {
        pacing: "bench".to_owned(),
        time_scale: 1.0,
        scheduling: "SCHED_FIFO".to_owned(),
        memory_locked: true,
        periods: 60,
        overruns: 0,
        skipped: 0,
        missed_replies: 0,
        lost_replies: 0,
        refused_frames: 0,
        lost_rows: 0,
        lateness_us: Quantiles { p50: 4.0, p99: 30.0, p999: 55.0, max: 61.0 },
        loop_delay_us: Some(Quantiles { p50: 210.0, p99: 400.0, p999: 500.0, max: 525.0 }),
        loop_delay_budget_us: Some(1050.0),
        target_clock_ppm: Some(12.4),
        target_clock_error_ppm: Some(3.1),
        safe_confirmed: true,
    }
}

fn table(trials: impl IntoIterator<Item = Option<Timing>>) -> String {
    let mut scenario = made::scenario(
        "paper/a.toml",
        "A",
        "dq-pi",
        vec![made::passed("settling_time_ms", ("at_most", 2.0.into()), 1.9)],
    );
    scenario.trials = trials
        .into_iter()
        .map(|timing| TrialRecord {
            telemetry: Telemetry { timing, ..Telemetry::default() },
            ..made::trial("paper/a.toml", 0, &[])
        })
        .collect();
    let table = console::table(&made::run(vec![scenario]), Style::default());
    table.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[test]
fn delay_is_shown_against_what_the_law_bears() {
    let table = table([Some(timing()), Some(Timing { overruns: 2, missed_replies: 1, ..timing() })]);
    for expected in [
        "real time, paced by the bench; loop delay 210 µs typical, 525 µs longest, 20 % and 50 % of the 1050 µs that the law bears",
        "samples late by 4 µs typical, 61 µs at most; 2 overruns, 1 missed replies in 120 periods",
        "the controller's clock +12 ± 3 ppm",
    ] {
        assert!(table.contains(expected), "{expected}\nnot in\n{table}");
    }
    assert!(!table.contains("SCHED") && !table.contains("confirmed"), "nothing is said of what is as it should be");
}

#[test]
fn what_is_not_as_it_should_be_is_said() {
    let refused = Timing {
        scheduling: "SCHED_OTHER, because SCHED_FIFO was not granted: 1".to_owned(),
        safe_confirmed: false,
        loop_delay_us: None,
        time_scale: 0.1,
        ..timing()
    };
    let table = table([Some(timing()), Some(refused.clone())]);
    assert!(table.contains("0 V was not confirmed"), "{table}");
    let table = self::table([Some(refused)]);
    for expected in ["at a time scale of 0.1", "SCHED_FIFO was not granted", "nothing missed in 60 periods"] {
        assert!(table.contains(expected), "{expected}\nnot in\n{table}");
    }
    assert!(!table.contains("loop delay"), "no answer, no delay: {table}");
}

#[test]
fn lockstep_says_nothing_of_it() {
    assert!(!table([None]).contains("real time"));
}
