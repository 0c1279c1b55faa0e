//! One worker of a run: a link to a controller of its own, over which it plays and measures one trial after the other.

use crate::folder::{RunFolder, hexadecimal, sha256_of, trace_file};
use crate::measured::{delay_budget, measured};
use crate::plan::{Clock, Company, Connect, Plan, RunError};
use crate::trial::{self, Order};
use crate::{Cancel, real_plate, real_time};
use platebench_rig::{AnyLink, Faulty, RigError};
use platebench_trace::{Row, TraceError, Writer};
use platebench_verdict::judge::trial_record;
use platebench_verdict::{TrialMeasures, TrialRecord};
use platebench_wire::{Identity, LawId};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc;
use std::time::Instant;
use tracing::{debug, error, info_span};

/// A controller on any rig, with a line that may be harmed.
pub(crate) type Session = platebench_rig::Session<Faulty<AnyLink>>;

/// A run and what all its parts share.
#[derive(Clone, Copy)]
pub(crate) struct Run<'a> {
    pub(crate) plan: &'a Plan,
    pub(crate) laws: &'a [LawId],
    pub(crate) folder: &'a RunFolder,
    pub(crate) connect: &'a Connect<'a>,
    /// Who is in the record.
    pub(crate) identity: Identity,
    pub(crate) cancel: &'a Cancel,
    pub(crate) company: Company<'a>,
    /// Set where a controller was let go that did not confirm 0 V.
    pub(crate) unconfirmed: &'a AtomicBool,
}

/// Drives the plate to 0 V and lets go of its controller.
pub(crate) fn end(session: &mut Option<Session>, unconfirmed: &AtomicBool) {
    let Some(session) = session.take() else { return };
    // A link that panics has confirmed nothing.
    let confirmed = catch_unwind(AssertUnwindSafe(|| session.close())).unwrap_or(false);
    unconfirmed.fetch_or(!confirmed, Ordering::Relaxed);
}

/// One trial that is to be played.
#[derive(Clone, Copy)]
pub(crate) struct Task {
    pub(crate) scenario: usize,
    pub(crate) index: u32,
}

pub(crate) fn trials_of(scenario: usize, from: u32, to: u32) -> impl Iterator<Item = Task> {
    (from..to).map(move |index| Task { scenario, index })
}

/// One trial that was played.
pub(crate) struct Done {
    pub(crate) measures: TrialMeasures,
    pub(crate) record: TrialRecord,
}

pub(crate) enum Progress {
    Started(usize),
    Done(usize, Box<Done>),
}

/// What all workers share.
pub(crate) struct Work<'a> {
    pub(crate) run: Run<'a>,
    pub(crate) tasks: &'a [Task],
    pub(crate) next: AtomicUsize,
}

impl Work<'_> {
    /// Plays trials until none is left, each worker over a link of its own.
    pub(crate) fn worker(&self, session: &mut Option<Session>, results: &mpsc::Sender<Result<Progress, RunError>>) {
        while !self.run.cancel.is_cancelled() {
            let Some(&task) = self.tasks.get(self.next.fetch_add(1, Ordering::Relaxed)) else { break };
            if task.index == 0 && results.send(Ok(Progress::Started(task.scenario))).is_err() {
                break;
            }
            let played = catch_unwind(AssertUnwindSafe(|| self.play(session, task)));
            let result = match played {
                Ok(Ok(Some(done))) => Ok(Progress::Done(task.scenario, Box::new(done))),
                Ok(Ok(None)) => break,
                Ok(Err(error)) => Err(error),
                Err(panic) => Err(RunError::Bench(panic_message(panic.as_ref()))),
            };
            let is_over = result.is_err();
            if is_over {
                // At once, and not once the others have come to their end.
                end(session, self.run.unconfirmed);
            }
            if results.send(result).is_err() || is_over {
                break;
            }
        }
    }

    /// A new link to the controller that the record names.
    fn connected(&self) -> Result<Session, RunError> {
        let session = Session::open(Faulty::new((self.run.connect)()?))?;
        let (found, expected) = (*session.identity(), self.run.identity);
        if found == expected {
            return Ok(session);
        }
        end(&mut Some(session), self.run.unconfirmed);
        Err(RunError::OtherController { found: who(&found), expected: who(&expected) })
    }

    /// Plays and measures one trial. `None` where it was given up.
    fn play(&self, session: &mut Option<Session>, task: Task) -> Result<Option<Done>, RunError> {
        let (Some(scenario), Some(&law)) =
            (self.run.plan.scenarios.get(task.scenario), self.run.laws.get(task.scenario))
        else {
            return Ok(None);
        };
        let _span = info_span!("trial", scenario = %scenario.file, index = task.index).entered();
        let started = Instant::now();
        let open = match session {
            Some(open) => open,
            None => session.insert(self.connected()?),
        };
        let wire_time = self.run.plan.clock == Clock::Lockstep { wire_time: true };
        let order = Order { scenario, law, index: task.index, wire_time, own_clock: self.run.plan.own_clock };
        let mut lent = self.run.company.watch.lend(task.scenario, task.index);
        let played = match self.run.plan.clock {
            Clock::OwnPlate => real_plate::play(open, &order, self.run.company.person, self.run.cancel)?,
            Clock::Lockstep { .. } => trial::play_watched(open, &order, self.run.cancel, lent.tap()),
            Clock::RealTime(pace) => real_time::play_watched(open, &order, pace, self.run.cancel, lent.tap()),
        };
        drop(lent);
        let Some(mut played) = played else { return Ok(None) };
        if let Some(timing) = &mut played.telemetry.timing {
            timing.loop_delay_budget_us = delay_budget(scenario, law).map(|budget| budget.seconds() * 1e6);
        }
        if let Some(refused @ RigError::Refused(_)) = played.lost {
            return Err(refused.into());
        }
        let trace = trace_file(scenario.name(), task.index);
        let path = self.run.folder.path().join(&trace);
        write_trace(&path, &played.rows)?;
        let measures = measured(scenario, law, task.index, &played.rows, &played.telemetry);
        let wall_ms = started.elapsed().as_secs_f64() * 1e3;
        debug!(rows = played.rows.len(), wall_ms, measures = ?measures.measures, "trial measured");
        let mut record = trial_record(scenario, &measures, trace, Some(wall_ms));
        record.sha256 = Some(sha256_of(&path).map_err(|source| TraceError::Io { path, source })?);
        if let Some(lost) = played.lost {
            error!(error = %lost, "controller lost");
            // The next trial starts over a new link.
            end(session, self.run.unconfirmed);
        }
        Ok(Some(Done { measures, record }))
    }
}

fn write_trace(path: &Path, rows: &[Row]) -> Result<(), TraceError> {
    let mut writer = Writer::create(path)?;
    rows.iter().try_for_each(|row| writer.write(row))?;
    writer.finish()
}

fn panic_message(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str).or_else(|| panic.downcast_ref::<&str>().copied());
    text.unwrap_or("no message").to_owned()
}

/// A controller by what tells it from others.
fn who(identity: &Identity) -> String {
    let [major, minor, patch] = identity.version;
    let [build, unique] = [&identity.build[..], &identity.unique[..]].map(hexadecimal);
    format!("{} {major}.{minor}.{patch}, build {build}, number {unique}", platebench_rig::printable_name(identity))
}
