//! Nobody who takes no output keeps the program alive: a terminal that was stopped with Ctrl-S, a pager that is not scrolled, a reader that hangs.
//!
//! As long as nobody asks for the end, output waits for its reader as that of any program does. Once a signal has asked for it, the run is told so from here, whatever
//! the thread that listens for signals is waiting for; and output that nobody takes is then not waited for any more.

use crate::signals::Signals;
use crossterm::terminal::disable_raw_mode;
use platebench_runner::Cancel;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::io::{self, Write, stderr, stdout};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, Once, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

/// Between two looks at whether output is taken.
const LOOK_EVERY: Duration = Duration::from_millis(50);
/// Output that nobody took for this long is not waited for, once the end was asked for and nothing is driven.
const STUCK: Duration = Duration::from_secs(1);
/// As `STUCK`, while there is still somebody who drives: longer than any controller takes to be let go.
const STUCK_WHILE_BUSY: Duration = Duration::from_secs(10);
/// How long the log waits for a reader; then the line is lost, and the next ones do not wait until one is taken again.
const LOG_WAITS: Timespec = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
const NOT_AT_ALL: Timespec = Timespec { tv_sec: 0, tv_nsec: 0 };
/// What a pipe that takes anything takes at once (`PIPE_BUF`), bytes.
const AT_ONCE: usize = 4096;

/// What is to be told of a signal: the work that goes on.
static WORK: Mutex<Option<(Cancel, Arc<AtomicBool>)>> = Mutex::new(None);
static BEGUN: Once = Once::new();
/// True once the log found nobody who takes it.
static UNHEARD: AtomicBool = AtomicBool::new(false);

/// Work that may drive a plate, until this is dropped.
#[derive(Debug)]
pub(crate) struct Busy(Arc<AtomicBool>);

impl Busy {
    /// Begins it: a signal cancels it by `cancel`.
    pub(crate) fn begin(cancel: &Cancel) -> Self {
        let busy = Arc::new(AtomicBool::new(true));
        *WORK.lock().unwrap_or_else(PoisonError::into_inner) = Some((cancel.clone(), Arc::clone(&busy)));
        BEGUN.call_once(|| {
            // Without another thread all is as it would be without this module.
            let _ = thread::Builder::new().name("guard".to_owned()).spawn(watch);
        });
        Self(busy)
    }
}

impl Drop for Busy {
    fn drop(&mut self) {
        self.0.store(false, Ordering::Relaxed);
    }
}

fn watch() {
    let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_all().build() else { return };
    runtime.block_on(async {
        let Ok(mut signals) = Signals::listen() else { return };
        let first = signals.next().await;
        let mut taken = Instant::now();
        loop {
            let work = WORK.lock().unwrap_or_else(PoisonError::into_inner).clone();
            if let Some((cancel, _)) = &work {
                cancel.cancel();
            }
            if takes(stdout().as_fd(), NOT_AT_ALL) && takes(stderr().as_fd(), NOT_AT_ALL) {
                taken = Instant::now();
            }
            let is_busy = work.is_some_and(|(_, busy)| busy.load(Ordering::Relaxed));
            if taken.elapsed() > if is_busy { STUCK_WHILE_BUSY } else { STUCK } {
                // What there is to be said was said to nobody.
                let _ = disable_raw_mode();
                std::process::exit(i32::from(crate::exit::Exit::Signal(first).code()));
            }
            tokio::time::sleep(LOOK_EVERY).await;
        }
    });
}

/// True where `output` takes something within `patience`, or would say at once why not.
fn takes(output: BorrowedFd<'_>, patience: Timespec) -> bool {
    poll(&mut [PollFd::new(&output, PollFlags::OUT)], Some(&patience)).map_or(true, |ready| ready > 0)
}

/// Standard error for those who must not wait, which is whoever talks to a controller: what nobody takes is lost.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Log;

impl Write for Log {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let error = stderr();
        let patience = if UNHEARD.load(Ordering::Relaxed) { NOT_AT_ALL } else { LOG_WAITS };
        let is_heard = takes(error.as_fd(), patience);
        UNHEARD.store(!is_heard, Ordering::Relaxed);
        if !is_heard {
            return Ok(bytes.len());
        }
        // Not through the lock of standard error: whoever waits for a reader may have it.
        rustix::io::write(error.as_fd(), bytes.get(..AT_ONCE).unwrap_or(bytes)).map_err(io::Error::from)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
