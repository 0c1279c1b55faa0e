//! Runs work that a signal can cancel, with one listener for all signals.
//!
//! The listener thread has the program's only async runtime. It passes through these states:
//!
//! ```text
//! listening --signal--> cancelled --a signal after SHUTDOWN_TIMEOUT--> abandoned: the program ends without the work
//!                           '--output not read for OUTPUT_TIMEOUT--> the process ends at once
//! ```

use crate::exit::{Exit, Failure};
use crate::stdio;
use crossterm::terminal::disable_raw_mode;
use platebench_engine::{CancelToken, RunError};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::process::{Pid, PidfdFlags, Signal as SignalName, getpid, kill_process, pidfd_open};
use std::future::poll_fn;
use std::sync::mpsc::{RecvTimeoutError, SyncSender, TrySendError, channel, sync_channel};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};
use std::task::Poll;
use std::time::{Duration, Instant};
use std::{io, thread};
use tokio::signal::unix::{Signal, SignalKind, signal};

const HANG_UP: u8 = 1;
/// Signals of a closed terminal, Ctrl-C, Ctrl-\, SIGABRT, SIGTERM, SIGXCPU (`ulimit -t`).
const TERMINATION_SIGNALS: [u8; 6] = [HANG_UP, 2, 3, 6, 15, 24];
/// Number of the process that started the bench, or of the one that it works for, such as pytest.
/// The bench ends with it as after SIGTERM.
const PARENT_VARIABLE: &str = "PLATEBENCH_PARENT";
/// SIGXFSZ (`ulimit -f`). It is caught so that the write fails and the program continues.
const FILE_SIZE: u8 = 25;
/// A signal this long after the first one abandons the work. An earlier second signal does not,
/// because a closing terminal sends two signals.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(3);
/// After a signal, the process ends if the output is not read for this time.
const OUTPUT_TIMEOUT: Duration = Duration::from_secs(1);
/// The same time while work may drive a plate: longer than a controller needs to confirm 0 V.
const OUTPUT_TIMEOUT_WHILE_BUSY: Duration = Duration::from_secs(10);
const POLL_INTERVAL: Duration = Duration::from_millis(50);
const MAX_QUEUED_EVENTS: usize = 64;
/// After cancellation, an event is dropped if the queue stays full for this time.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(1);
const RETRY_INTERVAL: Duration = Duration::from_millis(1);

static STATE: Mutex<State> = Mutex::new(State { first_signal: None, late_signal: None, work: None, is_busy: false });

struct State {
    first_signal: Option<(u8, Instant)>,
    /// Signal that came more than [`SHUTDOWN_TIMEOUT`] after the first one.
    late_signal: Option<u8>,
    work: Option<CancelToken>,
    is_busy: bool,
}

impl State {
    fn lock() -> MutexGuard<'static, Self> {
        STATE.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn receive(&mut self, number: u8) {
        let (_, first) = *self.first_signal.get_or_insert_with(|| (number, Instant::now()));
        if first.elapsed() > SHUTDOWN_TIMEOUT {
            self.late_signal = Some(number);
        }
        if let Some(work) = &self.work {
            work.cancel();
        }
    }
}

pub(crate) fn received_signal() -> Option<u8> {
    State::lock().first_signal.map(|(number, _)| number)
}

/// Starts the listener on the first call. Signals then no longer end the process by themselves.
pub(crate) fn listen() -> io::Result<()> {
    static STARTED: OnceLock<Result<(), String>> = OnceLock::new();
    let started = STARTED.get_or_init(|| {
        let (sender, receiver) = channel();
        let listener = move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
            let _ = runtime.and_then(|runtime| {
                let signals = runtime.block_on(async { Signals::register() });
                let _ = sender.send(signals.as_ref().map(|_| ()).map_err(io::Error::to_string));
                runtime.block_on(handle_signals(signals?));
                Ok(())
            });
        };
        thread::Builder::new().name("signals".to_owned()).spawn(listener).map_err(|error| error.to_string())?;
        receiver.recv().map_err(|error| error.to_string())??;
        watch_parent().map_err(|error| format!("{PARENT_VARIABLE}: {error}"))
    });
    started.clone().map_err(io::Error::other)
}

/// Sends SIGTERM to this process when the process of [`PARENT_VARIABLE`] ends, however it ends.
fn watch_parent() -> io::Result<()> {
    let Some(number) = std::env::var_os(PARENT_VARIABLE).filter(|number| !number.is_empty()) else { return Ok(()) };
    let number = number.to_str().and_then(|number| number.parse().ok()).and_then(Pid::from_raw);
    let number = number.ok_or_else(|| io::Error::other("expected the number of a process"))?;
    let parent = match pidfd_open(number, PidfdFlags::empty()) {
        Err(rustix::io::Errno::SRCH) => return Ok(kill_process(getpid(), SignalName::TERM)?),
        opened => opened?,
    };
    let watch = move || {
        // The descriptor becomes readable when the process ends.
        while poll(&mut [PollFd::new(&parent, PollFlags::IN)], None).is_err() {
            thread::sleep(POLL_INTERVAL);
        }
        let _ = kill_process(getpid(), SignalName::TERM);
    };
    thread::Builder::new().name("parent".to_owned()).spawn(watch).map(drop)
}

struct Signals(Vec<(Signal, u8)>);

impl Signals {
    fn register() -> io::Result<Self> {
        let register = |number: u8| Ok((signal(SignalKind::from_raw(number.into()))?, number));
        // `nohup` ignores SIGHUP, so that the program outlives its terminal. It must stay ignored.
        let wanted = TERMINATION_SIGNALS.into_iter().filter(|number| *number != HANG_UP || !is_ignored(HANG_UP));
        let signals = wanted.map(register).collect::<io::Result<_>>().map(Self)?;
        let _ = signal(SignalKind::from_raw(FILE_SIZE.into()))?;
        Ok(signals)
    }

    async fn next(&mut self) -> u8 {
        poll_fn(|context| {
            let ready =
                self.0.iter_mut().find_map(|(signal, number)| signal.poll_recv(context).is_ready().then_some(*number));
            ready.map_or(Poll::Pending, Poll::Ready)
        })
        .await
    }
}

fn is_ignored(number: u8) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0);
    mask >> (number - 1) & 1 == 1
}

async fn handle_signals(mut signals: Signals) {
    let first = signals.next().await;
    State::lock().receive(first);
    let mut last_read = Instant::now();
    loop {
        tokio::select! {
            number = signals.next() => State::lock().receive(number),
            () = tokio::time::sleep(POLL_INTERVAL) => {}
        }
        if stdio::is_output_drained() {
            last_read = Instant::now();
        }
        let timeout = if State::lock().is_busy { OUTPUT_TIMEOUT_WHILE_BUSY } else { OUTPUT_TIMEOUT };
        if last_read.elapsed() > timeout {
            let _ = disable_raw_mode();
            std::process::exit(i32::from(Exit::Signal(first).code()));
        }
    }
}

struct BusyGuard;

impl BusyGuard {
    fn new(cancel: &CancelToken) -> Self {
        let mut state = State::lock();
        if state.first_signal.is_some() {
            cancel.cancel();
        }
        (state.work, state.is_busy) = (Some(cancel.clone()), true);
        Self
    }
}

impl Drop for BusyGuard {
    fn drop(&mut self) {
        State::lock().is_busy = false;
    }
}

/// Result of work, and the first signal that came before its end. The error is `Cancelled` if a late
/// signal abandoned the work, and `Internal` if it panicked.
pub(crate) type WorkEnd<T> = (Result<T, RunError>, Option<u8>);

pub(crate) struct EventSender<E> {
    sender: SyncSender<E>,
    cancel: CancelToken,
    cancelled: Option<Instant>,
}

impl<E> EventSender<E> {
    /// Sends `event`. Drops it if the receiver is gone, or stays full after cancellation.
    pub(crate) fn send(&mut self, mut event: E) {
        while let Err(TrySendError::Full(back)) = self.sender.try_send(event) {
            if self.cancel.is_cancelled() && self.cancelled.get_or_insert_with(Instant::now).elapsed() > DRAIN_TIMEOUT {
                return;
            }
            event = back;
            thread::sleep(RETRY_INTERVAL);
        }
    }
}

/// Runs `work` on its own thread until it returns, and passes its events to `on_event` on the
/// calling thread. A signal or the end of `max_duration` cancels the work.
pub(crate) fn run_until_signal<T: Send + 'static, E: Send + 'static>(
    max_duration: Option<Duration>,
    work: impl FnOnce(&CancelToken, &mut EventSender<E>) -> T + Send + 'static,
    on_event: impl FnMut(E),
) -> WorkEnd<T> {
    let result = run_work(max_duration, work, on_event);
    // A late signal is not the first one.
    let late = State::lock().late_signal.filter(|_| matches!(result, Err(RunError::Cancelled)));
    (result, late.or_else(received_signal))
}

fn run_work<T: Send + 'static, E: Send + 'static>(
    max_duration: Option<Duration>,
    work: impl FnOnce(&CancelToken, &mut EventSender<E>) -> T + Send + 'static,
    mut on_event: impl FnMut(E),
) -> Result<T, RunError> {
    let defect = |error: io::Error| RunError::Internal(error.to_string());
    listen().map_err(defect)?;
    let cancel = CancelToken::default();
    let (sender, events) = sync_channel(MAX_QUEUED_EVENTS);
    let busy = BusyGuard::new(&cancel);
    let mut sender = EventSender { sender, cancel: cancel.clone(), cancelled: None };
    let worker = thread::Builder::new().name("work".to_owned()).spawn(move || {
        let result = work(&sender.cancel.clone(), &mut sender);
        drop(busy);
        result
    });
    let worker = worker.map_err(defect)?;
    let started = Instant::now();
    loop {
        match events.recv_timeout(POLL_INTERVAL) {
            Ok(event) => on_event(event),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => {
                return worker.join().map_err(|_| RunError::Internal("a thread of the bench panicked".to_owned()));
            }
        }
        if State::lock().late_signal.is_some() {
            return Err(RunError::Cancelled);
        }
        if max_duration.is_some_and(|longest| started.elapsed() > longest) {
            cancel.cancel();
        }
    }
}

/// Runs `work`, which drives no plate, on its own thread. `None` if a signal comes before `work`
/// ends; the thread then ends with the process.
pub(crate) fn run_unless_signalled<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> io::Result<Option<T>> {
    let (sender, result) = sync_channel(1);
    thread::Builder::new().name("reports".to_owned()).spawn(move || {
        // The receiver is gone after a signal.
        let _ = sender.send(work());
    })?;
    loop {
        match result.recv_timeout(POLL_INTERVAL) {
            Ok(result) => return Ok(Some(result)),
            Err(RecvTimeoutError::Disconnected) => return Err(io::Error::other("a thread of the bench panicked")),
            Err(RecvTimeoutError::Timeout) if received_signal().is_some() => return Ok(None),
            Err(RecvTimeoutError::Timeout) => {}
        }
    }
}

pub(crate) fn unless_signalled<T, F: Into<Failure>>((result, signal): WorkEnd<Result<T, F>>) -> Result<T, Failure> {
    match (result, signal) {
        (Err(error @ RunError::Internal(_)), _) => Err(error.into()),
        (_, Some(signal)) => Err(Exit::Signal(signal).into()),
        (result, None) => result?.map_err(Into::into),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_signal_ends_the_wait_for_reports() {
        assert_eq!(run_unless_signalled(|| 7).unwrap(), Some(7));
        let (_open, blocked) = channel::<()>();
        State::lock().first_signal = Some((2, Instant::now()));
        let ended = run_unless_signalled(move || blocked.recv());
        State::lock().first_signal = None;
        assert!(ended.unwrap().is_none());
    }
}
