//! Plays one trial in real time: every microsecond that bench, line and controller take acts on the plate.
//!
//! One thread owns the loop. It neither allocates nor logs; rows leave it through a bounded queue. The plate moves
//! exactly to the instant of every event: it is sampled at the deadline, however late the sample leaves, and driven
//! anew when a command arrives. Lateness therefore acts as loop delay and nothing else.

mod control_loop;
mod manual_control;
mod ticks;
mod time_base;

pub use manual_control::ManualControl;
pub use rtrb::Consumer;
pub use time_base::{Pacing, TimeBase};

use crate::abort::TrialAbort;
use crate::configure::configure;
use crate::fault::wire_faults;
use crate::live_tap::TapWriter;
use crate::plant_simulation::{PlantSimulation, expected_rows};
use crate::row_queue::{RowQueue, collect_rows};
use crate::scheduling::ThreadScheduling;
use crate::trial::{TrialResult, TrialSpec};
use control_loop::RealTimeLoop;
use platebench_record::Telemetry;
use platebench_rig::{CancelToken, FaultInjector, Link, RigError, Session};
use platebench_trace::Row;
use std::panic::resume_unwind;
use std::thread;

/// Plays a trial; `tap` receives its rows. `None` if it was cancelled. The rig must support real time.
///
/// Blocks the calling thread, which only collects rows; the loop has its own thread.
pub fn play<L: Link>(
    session: &mut Session<FaultInjector<L>>,
    spec: &TrialSpec<'_>,
    time_base: TimeBase,
    cancel: &CancelToken,
    tap: Option<&mut TapWriter>,
) -> Option<TrialResult> {
    let collect = |rows| collect_rows(rows, expected_rows(spec.scenario));
    let (trace_rows, end) = run_loop(session, spec, time_base, cancel, None, tap, collect);
    end.map(|(telemetry, link_error)| TrialResult { trace_rows, telemetry, link_error })
}

/// Plays the plate to the controller until `cancel`, a lost controller or a stop. `manual` replaces the scenario's
/// profiles once it is used. `consume` and `tap` receive the rows.
pub fn emulate_plate<L: Link>(
    session: &mut Session<FaultInjector<L>>,
    spec: &TrialSpec<'_>,
    time_base: TimeBase,
    cancel: &CancelToken,
    manual: &ManualControl,
    tap: Option<&mut TapWriter>,
    consume: impl FnOnce(Consumer<Row>),
) -> EmulationEnd {
    let ((), end) = run_loop(session, spec, time_base, cancel, Some(manual), tap, consume);
    match end {
        None => EmulationEnd::Cancelled,
        Some((_, Some(error))) => EmulationEnd::Lost(error),
        Some((telemetry, None)) => EmulationEnd::Stopped(telemetry.stopped),
    }
}

/// Why an emulation ended.
#[derive(Debug)]
pub enum EmulationEnd {
    /// It was cancelled.
    Cancelled,
    /// The controller was lost.
    Lost(RigError),
    /// The controller stopped, for the reason that it reported, and waits for a configuration.
    Stopped(Option<String>),
}

/// Runs the loop on its own thread; `consume` receives its rows. The second result is `None` if it was cancelled.
fn run_loop<L: Link, T>(
    session: &mut Session<FaultInjector<L>>,
    spec: &TrialSpec<'_>,
    time_base: TimeBase,
    cancel: &CancelToken,
    manual: Option<&ManualControl>,
    tap: Option<&mut TapWriter>,
    consume: impl FnOnce(Consumer<Row>) -> T,
) -> (T, Option<(Telemetry, Option<RigError>)>) {
    let (queue, consumer) = RowQueue::new();
    let plant = PlantSimulation::new(spec.scenario, spec.index, queue, tap);
    session.link_mut().set_faults(&wire_faults(spec.scenario, spec.index));
    thread::scope(|scope| {
        let real_time = scope.spawn(move || {
            let scheduling = ThreadScheduling::request();
            // A target that paces itself ticks from its configuration on, so this comes last.
            let configuration = time_base.with_target_timing(configure(spec.scenario, spec.law));
            let started = session.start_trial(&configuration).map_err(TrialAbort::Lost);
            let mut real_time = RealTimeLoop::new(session, spec, time_base, plant, manual);
            let abort = started.and_then(|gains| real_time.run(&configuration, &gains, cancel)).err();
            real_time.finish(abort, &scheduling)
        });
        let consumed = consume(consumer);
        match real_time.join() {
            Ok(end) => (consumed, end),
            Err(panic) => resume_unwind(panic),
        }
    })
}
