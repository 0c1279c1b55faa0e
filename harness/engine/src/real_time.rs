//! Plays one trial in real time, so that delays of bench, line and controller act on the plate.
//!
//! The loop has its own thread and neither allocates nor logs. A sample contains the plate's state
//! at the control instant, even if the bench sends it late. A command acts when it arrives. So
//! lateness of the bench acts only as loop delay.

mod control_loop;

pub use rtrb::Consumer;

use crate::plant_simulation::{ManualControl, PlantSimulation, RowQueue, collect_rows, expected_rows};
use crate::timing::{ThreadScheduling, TimeBase};
use crate::trial::{Trial, TrialAbort, TrialResult, configure, set_line_faults};
use control_loop::RealTimeLoop;
use platebench_model::record::Telemetry;
use platebench_model::trace::Row;
use platebench_rig::{FaultInjector, Link, RigError, Session};
use rustix::param::clock_ticks_per_second;
use std::panic::resume_unwind;
use std::thread;

/// Blocks the calling thread, which collects the rows. The link must support real time. `None` if
/// the trial was cancelled.
pub fn play<L: Link>(
    session: &mut Session<FaultInjector<L>>,
    trial: Trial<'_>,
    time_base: TimeBase,
) -> Option<TrialResult> {
    let expected = expected_rows(trial.scenario);
    let (trace_rows, end) = run_loop(session, trial, time_base, None, |rows| collect_rows(rows, expected));
    end.map(|(telemetry, link_error)| {
        let safe_confirmed = telemetry.timing.as_ref().is_some_and(|timing| timing.safe_confirmed);
        TrialResult { trace_rows, telemetry, link_error, safe_confirmed }
    })
}

/// Runs until the trial is cancelled, or the controller stops or is lost. The scenario's profiles
/// apply until the first change of `manual`.
pub fn emulate_plate<L: Link>(
    session: &mut Session<FaultInjector<L>>,
    trial: Trial<'_>,
    time_base: TimeBase,
    manual: &ManualControl,
    consume: impl FnOnce(Consumer<Row>),
) -> EmulationEnd {
    let ((), end) = run_loop(session, trial, time_base, Some(manual), consume);
    match end {
        None => EmulationEnd::Cancelled,
        Some((_, Some(error))) => EmulationEnd::Lost(error),
        Some((telemetry, None)) => EmulationEnd::Stopped(telemetry.stopped),
    }
}

#[derive(Debug)]
pub enum EmulationEnd {
    Cancelled,
    Lost(RigError),
    /// The controller stopped for this reason and waits for a configuration.
    Stopped(Option<String>),
}

fn run_loop<L: Link, T>(
    session: &mut Session<FaultInjector<L>>,
    mut trial: Trial<'_>,
    time_base: TimeBase,
    manual: Option<&ManualControl>,
    consume: impl FnOnce(Consumer<Row>) -> T,
) -> (T, Option<(Telemetry, Option<RigError>)>) {
    let (queue, consumer) = RowQueue::new();
    let plant = PlantSimulation::new(trial.scenario, trial.index, queue, trial.tap.take());
    set_line_faults(session.link_mut(), trial.scenario, trial.index);
    let steal_before = StealTime::now();
    thread::scope(|scope| {
        let real_time = scope.spawn(move || {
            let scheduling = ThreadScheduling::request();
            // The controller is configured last, because a target that paces itself ticks from then
            // on.
            let configuration = time_base.with_target_timing(configure(trial.scenario, trial.law));
            let started = session.start_line().and_then(|()| session.begin_trial(&configuration, trial.continues));
            let started = started.map_err(TrialAbort::Lost);
            let mut real_time = RealTimeLoop::new(session, &trial, time_base, plant, manual);
            let abort = started.and_then(|gains| real_time.run(&configuration, &gains)).err();
            real_time.finish(abort, &scheduling)
        });
        let consumed = consume(consumer);
        let mut end = real_time.join().unwrap_or_else(|panic| resume_unwind(panic));
        if let Some(timing) = end.as_mut().and_then(|(telemetry, _)| telemetry.timing.as_mut()) {
            timing.steal_ms = steal_before.ms_until(StealTime::now());
        }
        (consumed, end)
    })
}

/// Stolen clock ticks since the boot, summed over all processors. `None` if unknown.
#[derive(Debug, Clone, Copy)]
pub(crate) struct StealTime(Option<u64>);

impl StealTime {
    pub(crate) fn now() -> Self {
        Self(std::fs::read_to_string("/proc/stat").ok().and_then(|text| steal_ticks(&text)))
    }

    /// The resolution is one clock tick, usually 10 ms.
    pub(crate) fn ms_until(self, later: Self) -> Option<f64> {
        let ticks = later.0?.checked_sub(self.0?)?;
        Some(ticks as f64 * 1e3 / clock_ticks_per_second() as f64)
    }
}

fn steal_ticks(stat: &str) -> Option<u64> {
    stat.lines().find_map(|line| line.strip_prefix("cpu "))?.split_whitespace().nth(7)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_the_eighth_number_of_all_processors() {
        let stat = "intr 7\ncpu0 9 9 9 9 9 9 9 9 9 9\ncpu  1 2 3 4 5 6 7 694 10 11\n";
        assert_eq!(steal_ticks(stat), Some(694));
        assert_eq!(steal_ticks("cpu  1 2 3 4 5 6 7\n"), None);
        assert_eq!(steal_ticks("cpu0 9 9 9 9 9 9 9 9 9 9\n"), None);
    }

    #[test]
    fn an_unknown_time_has_no_difference() {
        let [unknown, early, late] = [None, Some(3), Some(5)].map(StealTime);
        assert_eq!(early.ms_until(late), Some(2e3 / clock_ticks_per_second() as f64));
        assert_eq!(late.ms_until(early), None);
        assert_eq!(unknown.ms_until(late), None);
    }
}
