//! Runs tasks on several threads: one pool with a source of tasks, one state per worker and a sink
//! of results.

use std::collections::BTreeMap;
use std::iter;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc;
use std::thread;
use tracing::subscriber::{NoSubscriber, with_default};

/// Number of results that workers can send before they wait for the sink.
const RESULT_QUEUE: usize = 256;

/// Sends a result to the sink. Returns false if the sink receives no further results.
pub type Emit<'a, R> = dyn FnMut(R) -> bool + 'a;

/// Calls `work` on one thread per worker, with the next task of `source`, until `source` is empty.
/// A task may have any number of results, which `sink` receives on the thread of the caller. Ends at
/// the first error. After `Break` or an error of the sink, no task starts and no further result is
/// received. After an error of a worker, no task starts, and the results of the others that already
/// run are received.
pub fn run_workers<S: Send, T, R: Send, E: Send>(
    workers: impl IntoIterator<Item = S>,
    source: impl Fn() -> Option<T> + Sync,
    work: impl Fn(&mut S, T, &mut Emit<'_, R>) -> Result<(), E> + Sync,
    sink: &mut impl FnMut(R) -> Result<ControlFlow<()>, E>,
) -> Result<(), E> {
    let is_over = AtomicBool::new(false);
    let (sender, results) = mpsc::sync_channel(RESULT_QUEUE);
    thread::scope(|scope| {
        for mut worker in workers {
            let (sender, source, work, is_over) = (sender.clone(), &source, &work, &is_over);
            scope.spawn(move || {
                while !is_over.load(Ordering::Relaxed)
                    && let Some(task) = source()
                {
                    let outcome = work(&mut worker, task, &mut |result| {
                        sender.send(Ok(result)).is_ok() && !is_over.load(Ordering::Relaxed)
                    });
                    if let Err(error) = outcome {
                        is_over.store(true, Ordering::Relaxed);
                        // If the receiver is gone, the work has already ended.
                        let _ = sender.send(Err(error));
                    }
                }
            });
        }
        drop(sender);
        let mut first_error = None;
        let outcome = loop {
            let received = match results.recv() {
                Ok(Ok(result)) => sink(result),
                Ok(Err(error)) => {
                    first_error = first_error.or(Some(error));
                    Ok(ControlFlow::Continue(()))
                }
                Err(_) => Ok(ControlFlow::Break(())),
            };
            match received {
                Ok(ControlFlow::Continue(())) => {}
                Ok(ControlFlow::Break(())) => break Ok(()),
                Err(error) => break Err(error),
            }
        };
        is_over.store(true, Ordering::Relaxed);
        // A worker that waits for the queue then ends.
        drop(results);
        first_error.map_or(outcome, Err)
    })
}

/// Puts numbered results into the order of their numbers.
#[derive(Debug)]
pub struct InOrder<R> {
    next: u64,
    waiting: BTreeMap<u64, R>,
}

impl<R> InOrder<R> {
    pub fn starting_at(first: u64) -> Self {
        Self { next: first, waiting: BTreeMap::new() }
    }

    pub fn insert(&mut self, number: u64, result: R) {
        self.waiting.insert(number, result);
    }

    /// Removes the result with the next number.
    pub fn take_next(&mut self) -> Option<R> {
        let result = self.waiting.remove(&self.next)?;
        self.next += 1;
        Some(result)
    }

    /// The first number whose result was not taken.
    pub fn next_number(&self) -> u64 {
        self.next
    }
}

/// Calls `work` for each task and passes the results to `receive` in the order of the tasks, until
/// `receive` returns false. Suppresses log messages of `work`, because callers provoke faults on
/// purpose.
pub fn in_parallel<S: Send, T: Sync, R: Send, E: Send>(
    workers: impl IntoIterator<Item = S>,
    tasks: &[T],
    work: impl Fn(&mut S, &T) -> Result<R, E> + Sync,
    mut receive: impl FnMut(R) -> bool,
) -> Result<(), E> {
    let next = AtomicUsize::new(0);
    let source = || {
        let number = next.fetch_add(1, Ordering::Relaxed);
        tasks.get(number).map(|task| (number as u64, task))
    };
    let numbered = |worker: &mut S, (number, task): (u64, &T), emit: &mut Emit<'_, (u64, R)>| {
        let result = with_default(NoSubscriber::default(), || work(worker, task))?;
        emit((number, result));
        Ok(())
    };
    let mut ordered = InOrder::starting_at(0);
    let workers = workers.into_iter().take(tasks.len());
    let outcome = run_workers(workers, source, numbered, &mut |(number, result): (u64, R)| {
        ordered.insert(number, result);
        while let Some(result) = ordered.take_next() {
            if !receive(result) {
                return Ok(ControlFlow::Break(()));
            }
        }
        Ok(ControlFlow::Continue(()))
    });
    if outcome.is_err() {
        // Results after the task with the error.
        ordered.waiting.into_values().all(receive);
    }
    outcome
}

pub fn collect_in_parallel<T: Sync, R: Send, E: Send>(
    jobs: usize,
    tasks: &[T],
    work: impl Fn(&T) -> Result<R, E> + Sync,
) -> Result<Vec<R>, E> {
    let mut results = Vec::with_capacity(tasks.len());
    let workers = iter::repeat_n((), jobs.max(1));
    in_parallel(
        workers,
        tasks,
        |(), task| work(task),
        |result| {
            results.push(result);
            true
        },
    )?;
    Ok(results)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;
    use std::sync::atomic::AtomicU32;
    use std::time::Duration;

    #[rstest]
    fn results_have_the_order_of_the_tasks(#[values(0, 1, 4, 200)] jobs: usize) {
        let tasks: Vec<u64> = (0..100).collect();
        let work = |task: &u64| {
            thread::sleep(Duration::from_micros(task % 7 * 50));
            Ok::<_, ()>(task * task)
        };
        assert_eq!(collect_in_parallel(jobs, &tasks, work), Ok(tasks.iter().map(|task| task * task).collect()));
        assert_eq!(collect_in_parallel(jobs, &[], work), Ok(Vec::new()));
    }

    #[test]
    fn ends_at_an_error_or_at_the_wish_of_the_receiver() {
        let tasks: Vec<u32> = (0..100).collect();
        let work = |(): &mut (), task: &u32| if *task == 20 { Err(*task) } else { Ok(*task) };
        assert_eq!(in_parallel([(), ()], &tasks, work, |_| true), Err(20));
        let mut received = Vec::new();
        let receive = |task| {
            received.push(task);
            task < 15
        };
        assert_eq!(in_parallel([(), ()], &tasks[..20], work, receive), Ok(()));
        assert_eq!(received, (0..=15).collect::<Vec<_>>());
    }

    #[test]
    fn results_of_running_tasks_survive_an_error() {
        let (is_failed, is_running) = (AtomicBool::new(false), AtomicBool::new(false));
        let work = |(): &mut (), task: &u32| {
            if *task == 0 {
                while !is_running.load(Ordering::Relaxed) {
                    thread::yield_now();
                }
                is_failed.store(true, Ordering::Relaxed);
                return Err(*task);
            }
            is_running.store(true, Ordering::Relaxed);
            while !is_failed.load(Ordering::Relaxed) {
                thread::yield_now();
            }
            // The sink receives the error first.
            thread::sleep(Duration::from_millis(20));
            Ok(*task)
        };
        let mut received = Vec::new();
        let receive = |task| {
            received.push(task);
            true
        };
        assert_eq!(in_parallel([(), ()], &[0, 1], work, receive), Err(0));
        assert_eq!(received, [1]);
    }

    /// Workers that wait for a full queue must end, and no task may start.
    #[test]
    fn an_error_of_the_sink_ends_workers_that_wait_for_the_queue() {
        let started = AtomicU32::new(0);
        let source = || Some(started.fetch_add(1, Ordering::Relaxed));
        let work = |(): &mut (), task, emit: &mut Emit<'_, u32>| {
            while emit(task) {}
            Ok::<_, u32>(())
        };
        let outcome = run_workers([(), ()], source, work, &mut |task: u32| {
            while started.load(Ordering::Relaxed) < 2 {
                thread::yield_now();
            }
            // The queue becomes full.
            thread::sleep(Duration::from_millis(20));
            Err(task)
        });
        assert!(outcome.is_err_and(|task| task < 2));
        assert_eq!(started.into_inner(), 2);
    }
}
