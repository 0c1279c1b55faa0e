//! Runs tasks on several threads.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;
use std::thread;
use tracing::subscriber::{NoSubscriber, with_default};

/// Calls `work` for each task on `jobs` threads. Each thread has its own state `S`. Passes the
/// results to `receive` in the order of the tasks, until `receive` returns false. Ends at the first
/// error. Suppresses log messages of `work`, because callers provoke faults on purpose.
pub fn in_parallel<S: Default, T: Sync, R: Send, E: Send>(
    jobs: usize,
    tasks: &[T],
    work: impl Fn(&mut S, &T) -> Result<R, E> + Sync,
    mut receive: impl FnMut(R) -> bool,
) -> Result<(), E> {
    let next = AtomicUsize::new(0);
    let (sender, results) = mpsc::channel();
    thread::scope(|scope| {
        for _ in 0..jobs.clamp(1, tasks.len().max(1)) {
            let (sender, next, work) = (sender.clone(), &next, &work);
            scope.spawn(move || {
                let mut state = S::default();
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let Some(task) = tasks.get(index) else { break };
                    let result = with_default(NoSubscriber::default(), || work(&mut state, task));
                    if sender.send(result.map(|result| (index, result))).is_err() {
                        break;
                    }
                }
            });
        }
        drop(sender);
        let (mut waiting, mut expected) = (BTreeMap::new(), 0);
        for result in results {
            let (index, result) = result.inspect_err(|_| next.store(tasks.len(), Ordering::Relaxed))?;
            waiting.insert(index, result);
            while let Some(result) = waiting.remove(&expected) {
                expected += 1;
                if !receive(result) {
                    next.store(tasks.len(), Ordering::Relaxed);
                    return Ok(());
                }
            }
        }
        Ok(())
    })
}

pub fn collect_in_parallel<T: Sync, R: Send, E: Send>(
    jobs: usize,
    tasks: &[T],
    work: impl Fn(&T) -> Result<R, E> + Sync,
) -> Result<Vec<R>, E> {
    let mut results = Vec::with_capacity(tasks.len());
    in_parallel(
        jobs,
        tasks,
        |(): &mut (), task| work(task),
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

    #[rstest]
    fn results_have_the_order_of_the_tasks(#[values(0, 1, 4, 200)] jobs: usize) {
        let tasks: Vec<u64> = (0..100).collect();
        let work = |task: &u64| {
            thread::sleep(std::time::Duration::from_micros(task % 7 * 50));
            Ok::<_, ()>(task * task)
        };
        assert_eq!(collect_in_parallel(jobs, &tasks, work), Ok(tasks.iter().map(|task| task * task).collect()));
        assert_eq!(collect_in_parallel(jobs, &[], work), Ok(Vec::new()));
    }

    #[test]
    fn ends_at_an_error_or_at_the_wish_of_the_receiver() {
        let tasks: Vec<u32> = (0..100).collect();
        let work = |(): &mut (), task: &u32| if *task == 20 { Err(*task) } else { Ok(*task) };
        assert_eq!(in_parallel(2, &tasks, work, |_| true), Err(20));
        let mut received = Vec::new();
        let receive = |task| {
            received.push(task);
            task < 15
        };
        assert_eq!(in_parallel(2, &tasks[..20], work, receive), Ok(()));
        assert_eq!(received, (0..=15).collect::<Vec<_>>());
    }
}
