//! Runs the probe on its own thread, because a hanging USB transfer cannot be interrupted. After a
//! time-out the thread is abandoned. Further calls then fail at once, and the end of the process
//! releases the probe.

use super::error::ProbeError;
use std::cell::Cell;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::Duration;
use tracing::warn;

type Job<T> = Box<dyn FnOnce(&mut T) + Send>;

#[derive(Debug)]
pub(super) struct ProbeThread<T> {
    jobs: Option<Sender<Job<T>>>,
    /// This channel disconnects when the thread has ended and its value is dropped.
    ended: Receiver<()>,
    abandoned: Cell<bool>,
}

impl<T: 'static> ProbeThread<T> {
    pub(super) fn spawn<R: Send + 'static>(
        doing: &'static str,
        timeout: Duration,
        build: impl FnOnce() -> Result<(T, R), ProbeError> + Send + 'static,
    ) -> Result<(Self, R), ProbeError> {
        let (jobs, queue) = channel::<Job<T>>();
        let (built, answer) = channel();
        let (alive, ended) = channel::<()>();
        let run = move || {
            // Declared before `value`, so that it is dropped after `value`.
            let _alive = alive;
            let mut value = match build() {
                Ok((value, result)) => {
                    if built.send(Ok(result)).is_err() {
                        return;
                    }
                    value
                }
                Err(error) => {
                    let _ = built.send(Err(error));
                    return;
                }
            };
            drop(built);
            for job in queue {
                job(&mut value);
            }
        };
        thread::Builder::new().name("debug-probe".to_owned()).spawn(run)?;
        let result = receive_within(&answer, doing, timeout)??;
        Ok((Self { jobs: Some(jobs), ended, abandoned: Cell::new(false) }, result))
    }

    pub(super) fn call<R: Send + 'static>(
        &self,
        doing: &'static str,
        timeout: Duration,
        job: impl FnOnce(&mut T) -> Result<R, ProbeError> + Send + 'static,
    ) -> Result<R, ProbeError> {
        if self.abandoned.get() {
            return Err(ProbeError::ProbeHangs { doing });
        }
        let (answer, answered) = channel();
        let sent = self.jobs.as_ref().map(|jobs| {
            jobs.send(Box::new(move |value| {
                let _ = answer.send(job(value));
            }))
        });
        let Some(Ok(())) = sent else { return Err(ProbeError::ProbeThreadGone { doing }) };
        let result = receive_within(&answered, doing, timeout);
        self.abandoned.set(result.is_err());
        result?
    }

    /// Ends the thread. Warns if it has not dropped its value within `timeout`.
    pub(super) fn stop(&mut self, timeout: Duration) {
        self.jobs = None;
        let timeout = if self.abandoned.get() { Duration::ZERO } else { timeout };
        if self.ended.recv_timeout(timeout) == Err(RecvTimeoutError::Timeout) {
            warn!("the debug probe is not released before the end of the process");
        }
    }
}

fn receive_within<R>(answer: &Receiver<R>, doing: &'static str, timeout: Duration) -> Result<R, ProbeError> {
    answer.recv_timeout(timeout).map_err(|error| match error {
        RecvTimeoutError::Timeout => ProbeError::CallTimedOut { doing, waited: timeout },
        RecvTimeoutError::Disconnected => ProbeError::ProbeThreadGone { doing },
    })
}
