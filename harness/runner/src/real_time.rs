//! One trial in real time: every microsecond that bench, line and controller take acts on the plate.
//!
//! One thread owns the loop. It neither allocates nor logs; rows leave it through a bounded queue. The plate is moved exactly to the instant of every event:
//! it is sampled at the deadline, however late the sample leaves, and driven anew when a command is there. So lateness is loop delay, as it would be on the
//! line, and nothing else.
//!
//! `live` is the loop, `pace` how plate time passes on the wall's clock, `ticks` the control instants that a target makes, `hand` whoever presses an emulated plate.

mod hand;
mod live;
mod pace;
mod ticks;

pub use hand::Hand;
pub use pace::{Pace, Pacing};
pub use rtrb::Consumer;

use crate::configure::configure;
use crate::end::End;
use crate::fault::wire_faults;
use crate::queue::{Queue, collect};
use crate::scheduling::Granted;
use crate::stage::{Stage, expected_rows};
use crate::trial::{Order, Patience, Played};
use crate::watch::Tap;
use live::Live;
use platebench_rig::{Faulty, Link, RigError, Session};
use platebench_trace::Row;
use platebench_verdict::Telemetry;
use std::panic::resume_unwind;
use std::thread;

/// Plays a trial. `None` where it was given up. The rig has to be one that can be used in real time.
///
/// Blocks the calling thread, which only collects rows: the loop has a thread of its own.
pub fn play<L: Link>(
    session: &mut Session<Faulty<L>>,
    order: &Order<'_>,
    pace: Pace,
    patience: &(impl Patience + Sync),
) -> Option<Played> {
    play_watched(session, order, pace, patience, None)
}

/// As [`play`], while somebody may look on.
pub fn play_watched<L: Link>(
    session: &mut Session<Faulty<L>>,
    order: &Order<'_>,
    pace: Pace,
    patience: &(impl Patience + Sync),
    tap: Option<&mut Tap>,
) -> Option<Played> {
    let rows = |rows| collect(rows, expected_rows(order.scenario));
    let (rows, ended) = drive(session, order, pace, patience, None, tap, rows);
    ended.map(|(telemetry, lost)| Played { rows, telemetry, lost })
}

/// Plays the plate to whatever controller is there until `patience` is over or the controller is gone; `hand` takes over from the scenario's
/// profiles once it is used, and `show` is given the rows; so is whoever looks on. Returns why nobody drives the plate any more.
pub fn emulate<L: Link>(
    session: &mut Session<Faulty<L>>,
    order: &Order<'_>,
    pace: Pace,
    patience: &(impl Patience + Sync),
    hand: &Hand,
    tap: Option<&mut Tap>,
    show: impl FnOnce(Consumer<Row>),
) -> Emulated {
    let ((), ended) = drive(session, order, pace, patience, Some(hand), tap, show);
    match ended {
        None => Emulated::GivenUp,
        Some((_, Some(error))) => Emulated::Lost(error),
        Some((telemetry, None)) => Emulated::Stopped(telemetry.stopped),
    }
}

/// Why nobody drives an emulated plate any more.
#[derive(Debug)]
pub enum Emulated {
    /// Somebody asked for the end.
    GivenUp,
    /// The controller is no longer there.
    Lost(RigError),
    /// The controller has stopped, for this reason by its own account, and waits to be configured.
    Stopped(Option<String>),
}

/// The loop on a thread of its own; its rows go to `take`.
fn drive<L: Link, T>(
    session: &mut Session<Faulty<L>>,
    order: &Order<'_>,
    pace: Pace,
    patience: &(impl Patience + Sync),
    hand: Option<&Hand>,
    tap: Option<&mut Tap>,
    take: impl FnOnce(Consumer<Row>) -> T,
) -> (T, Option<(Telemetry, Option<RigError>)>) {
    let (queue, consumer) = Queue::new();
    let stage = Stage::new(order.scenario, order.index, queue, tap);
    session.link_mut().arm(&wire_faults(order.scenario, order.index));
    thread::scope(|scope| {
        let live = scope.spawn(move || {
            let granted = Granted::ask();
            // Only now: a target that paces itself ticks from its configuration on.
            let begun = session.begin(&pace.of_target(configure(order.scenario, order.law)));
            let mut live = Live::new(session, order, pace, stage, hand);
            let ended = begun.map_err(End::Lost).and_then(|_| live.play(patience)).err();
            live.finish(ended, &granted)
        });
        let taken = take(consumer);
        match live.join() {
            Ok(ended) => (taken, ended),
            Err(panic) => resume_unwind(panic),
        }
    })
}
