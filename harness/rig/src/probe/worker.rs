//! A thread that may hang without the bench hanging.
//!
//! A USB transfer that never ends cannot be interrupted from outside. So the probe lives on a thread of its own, and whoever waits for it waits for a
//! stated time. A thread that did not answer in time is given up: nothing more is asked of it, and the end of the process frees the probe.

use super::error::ProbeError;
use std::cell::Cell;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::Duration;
use tracing::warn;

type Job<T> = Box<dyn FnOnce(&mut T) + Send>;

/// Something that is used from one thread only, reached from another.
#[derive(Debug)]
pub(super) struct Worker<T> {
    jobs: Option<Sender<Job<T>>>,
    /// Hangs up when the thread has ended and everything on it is released.
    ended: Receiver<()>,
    given_up: Cell<bool>,
}

impl<T: 'static> Worker<T> {
    /// Starts the thread and makes on it what it is for; `R` is what is to be known of that here.
    pub(super) fn start<R: Send + 'static>(
        doing: &'static str,
        patience: Duration,
        make: impl FnOnce() -> Result<(T, R), ProbeError> + Send + 'static,
    ) -> Result<(Self, R), ProbeError> {
        let (jobs, queue) = channel::<Job<T>>();
        let (made, answer) = channel();
        let (alive, ended) = channel::<()>();
        let run = move || {
            // Locals go in reverse order: what was made is released before `alive` hangs up.
            let _alive = alive;
            let mut thing = match make() {
                Ok((thing, known)) => {
                    if made.send(Ok(known)).is_err() {
                        return;
                    }
                    thing
                }
                Err(error) => {
                    let _ = made.send(Err(error));
                    return;
                }
            };
            drop(made);
            for job in queue {
                job(&mut thing);
            }
        };
        thread::Builder::new().name("debug-probe".to_owned()).spawn(run)?;
        let known = wait(&answer, doing, patience)??;
        Ok((Self { jobs: Some(jobs), ended, given_up: Cell::new(false) }, known))
    }

    /// Does `job` over there and waits for it.
    pub(super) fn call<R: Send + 'static>(
        &self,
        doing: &'static str,
        patience: Duration,
        job: impl FnOnce(&mut T) -> Result<R, ProbeError> + Send + 'static,
    ) -> Result<R, ProbeError> {
        if self.given_up.get() {
            return Err(ProbeError::Hung { doing, waited: Duration::ZERO });
        }
        let (answer, answered) = channel();
        let sent = self.jobs.as_ref().map(|jobs| {
            jobs.send(Box::new(move |thing| {
                let _ = answer.send(job(thing));
            }))
        });
        let Some(Ok(())) = sent else { return Err(ProbeError::Crashed { doing }) };
        let result = wait(&answered, doing, patience);
        self.given_up.set(result.is_err());
        result?
    }

    /// Ends the thread. True where everything on it was released in time.
    pub(super) fn stop(&mut self, patience: Duration) -> bool {
        self.jobs = None;
        let patience = if self.given_up.get() { Duration::ZERO } else { patience };
        let released = !matches!(self.ended.recv_timeout(patience), Err(RecvTimeoutError::Timeout));
        if !released {
            warn!("the debug probe was not released; the end of the process will");
        }
        released
    }
}

fn wait<R>(answer: &Receiver<R>, doing: &'static str, patience: Duration) -> Result<R, ProbeError> {
    answer.recv_timeout(patience).map_err(|error| match error {
        RecvTimeoutError::Timeout => ProbeError::Hung { doing, waited: patience },
        RecvTimeoutError::Disconnected => ProbeError::Crashed { doing },
    })
}
