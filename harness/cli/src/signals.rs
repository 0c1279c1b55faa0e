//! Work on a thread of its own, while this one listens for signals.

use crate::guard::Busy;
use platebench_runner::Cancel;
use std::io;
use std::time::{Duration, Instant};
use tokio::signal::unix::{SignalKind, signal};

/// The polite ends: terminal closed, Ctrl-C, Ctrl-\, asked to end.
const POLITE: [u8; 4] = [1, 2, 3, 15];
const HANG_UP: u8 = 1;
/// A file that grew beyond what is allowed (`ulimit -f`): listened for, so that the write fails instead of the program.
const FILE_SIZE: u8 = 25;

/// How long the work has to come to its end once that was asked for; only then another signal ends the program without it.
pub(crate) const PATIENCE: Duration = Duration::from_secs(3);

/// What became of the work.
pub(crate) enum Ended<T> {
    /// It is done, and this signal had asked for its end.
    Done(T, Option<u8>),
    /// This signal was the last that it was given.
    GivenUp(u8),
}

/// The next of the signals that ask a program to end.
pub(crate) struct Signals(Vec<(tokio::signal::unix::Signal, u8)>);

impl Signals {
    /// From now on they are listened for, instead of ending the program. Inside a runtime.
    ///
    /// # Errors
    /// What the system says.
    pub(crate) fn listen() -> io::Result<Self> {
        let listened = |number: u8| Ok((signal(SignalKind::from_raw(number.into()))?, number));
        // Whoever started the program with `nohup` wants it to outlive the terminal.
        let wanted = POLITE.into_iter().filter(|number| *number != HANG_UP || !is_ignored(HANG_UP));
        let listens = wanted.map(listened).collect::<io::Result<_>>().map(Self)?;
        // It is never asked for: that somebody listens is enough.
        let _ = signal(SignalKind::from_raw(FILE_SIZE.into()))?;
        Ok(listens)
    }

    /// The number of the next one.
    pub(crate) async fn next(&mut self) -> u8 {
        std::future::poll_fn(|context| {
            for (signal, number) in &mut self.0 {
                if signal.poll_recv(context).is_ready() {
                    return std::task::Poll::Ready(*number);
                }
            }
            std::task::Poll::Pending
        })
        .await
    }
}

/// True where whoever started the program has it ignore the signal.
fn is_ignored(number: u8) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0);
    mask >> (number - 1) & 1 == 1
}

/// Does `work` until it is done, a signal asks for the end or `longest` is over; `cancel` then tells it so. What it came to, and the signal.
///
/// A signal that comes much later than the first one does not wait for it any more.
///
/// # Errors
/// What the system says where there are no signals or no threads to be had, and where the work panicked.
pub(crate) fn until_signal<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
    cancel: &Cancel,
    longest: Option<Duration>,
) -> io::Result<Ended<T>> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let result = runtime.block_on(async {
        let mut signals = Signals::listen()?;
        let busy = Busy::begin(cancel);
        let mut working = tokio::task::spawn_blocking(move || {
            let _busy = busy;
            work()
        });
        let mut received = None;
        let mut asked = None;
        let end = async {
            match longest {
                Some(longest) => tokio::time::sleep(longest).await,
                None => std::future::pending().await,
            }
        };
        tokio::pin!(end);
        let mut ended = false;
        loop {
            tokio::select! {
                done = &mut working => return done.map(|done| Ended::Done(done, received)).map_err(io::Error::other),
                () = &mut end, if !ended => ended = true,
                number = signals.next() => {
                    let first = *asked.get_or_insert_with(Instant::now);
                    if first.elapsed() > PATIENCE {
                        return Ok(Ended::GivenUp(number));
                    }
                    received.get_or_insert(number);
                }
            }
            cancel.cancel();
        }
    });
    runtime.shutdown_background();
    result
}
