//! Runs the thread that reads rows and draws frames.

use crate::live::draw::draw;
use crate::live::events::{LiveViewError, MAX_CELLS, RunDescription, watch_keys};
use crate::live::screen::Screen;
use crate::live::screen::{CapturedLines, StderrCapture};
use crate::live::view_state::{FinishedCounts, ViewState};
use crossterm::terminal::size;
use platebench_engine::{Event, TapReader};
use ratatui::Terminal;
use ratatui::backend::{Backend, CrosstermBackend};
use rustix::process::{Signal, getpid, kill_process};
use std::io::BufWriter;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

const FRAME_INTERVAL: Duration = Duration::from_millis(50);
const POLL_INTERVAL: Duration = Duration::from_millis(10);
/// Limits the rows of one poll, because in lockstep they may arrive as fast as the view reads them.
const MAX_ROWS_PER_POLL: usize = 1 << 15;
/// A usual frame fits into this buffer, so the terminal gets it in one write.
const FRAME_CAPACITY: usize = 1 << 16;
const LAST_FRAME_TIMEOUT: Duration = Duration::from_millis(500);
const MAX_MESSAGES: usize = 64;

/// What the view knows of the run besides its rows.
#[derive(Debug, Default)]
struct RunState {
    finished: FinishedCounts,
    /// Replaces the rig of the description.
    rig: Option<String>,
    is_over: bool,
}

/// The drop of this value ends the view and restores the terminal.
#[derive(Debug)]
pub struct LiveView {
    // The order of the fields is the order of their drops: frames, screen, standard error.
    sender: ViewSender,
    finished: Receiver<()>,
    /// Set if the terminal is gone or restored. The view then draws no frame and reads no key.
    is_stopped: Arc<AtomicBool>,
    screen: Option<Screen>,
    _stderr_capture: Option<StderrCapture>,
}

impl LiveView {
    /// Takes the terminal and starts to draw. On an error the terminal is unchanged.
    pub fn open(run: RunDescription, tap_reader: TapReader) -> Result<Self, LiveViewError> {
        if let Ok((columns, rows)) = size()
            && !is_drawable(columns, rows)
        {
            return Err(LiveViewError::Size { columns, rows });
        }
        let screen = Screen::enter()?;
        let stderr_capture = StderrCapture::start()?;
        let is_stopped = Arc::new(AtomicBool::new(false));
        let writer = BufWriter::with_capacity(FRAME_CAPACITY, Screen::frame_writer(Arc::clone(&is_stopped))?);
        let mut terminal = Terminal::new(CrosstermBackend::new(writer))?;
        let sender = ViewSender::default();
        let (end, finished) = channel::<()>();
        let mut view_thread = ViewThread {
            state: ViewState::new(run),
            tap_reader,
            run: sender.clone(),
            captured_lines: stderr_capture.as_ref().map(StderrCapture::lines),
            is_stopped: Arc::clone(&is_stopped),
        };
        thread::Builder::new().name("view".to_owned()).spawn(move || {
            // A panic of this thread also drops `end`, so that `LiveView::drop` does not wait.
            let _end = end;
            // An error means that the terminal is gone. Its hang-up signal then ends the run.
            let _ = view_thread.run(&mut terminal);
        })?;
        Ok(Self { sender, finished, is_stopped, screen: Some(screen), _stderr_capture: stderr_capture })
    }

    pub fn show(&self, event: &Event) {
        self.sender.lock().finished.add(event);
    }

    pub fn sender(&self) -> ViewSender {
        self.sender.clone()
    }

    /// Makes the key q end the program like Ctrl-C.
    pub fn quit_on_q(&self) {
        let is_stopped = Arc::clone(&self.is_stopped);
        // The thread is not joined, because `poll` may never return after a hang-up.
        thread::spawn(move || {
            watch_keys(
                || is_stopped.load(Ordering::Relaxed),
                |letter| {
                    if letter == 'q' {
                        let _ = kill_process(getpid(), Signal::INT);
                    }
                },
            );
        });
    }
}

#[derive(Debug, Clone, Default)]
pub struct ViewSender(Arc<Mutex<RunState>>);

impl ViewSender {
    /// Shows the location of the rig instead of its name.
    pub fn set_rig(&self, location: String) {
        self.lock().rig = Some(location);
    }

    fn lock(&self) -> MutexGuard<'_, RunState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for LiveView {
    fn drop(&mut self) {
        self.sender.lock().is_over = true;
        // The terminal is restored after the last frame or after the time-out.
        let _ = self.finished.recv_timeout(LAST_FRAME_TIMEOUT);
        self.is_stopped.store(true, Ordering::Relaxed);
        self.screen.take();
    }
}

struct ViewThread {
    state: ViewState,
    tap_reader: TapReader,
    run: ViewSender,
    captured_lines: Option<Arc<Mutex<CapturedLines>>>,
    is_stopped: Arc<AtomicBool>,
}

impl ViewThread {
    fn run<B: Backend>(&mut self, terminal: &mut Terminal<B>) -> Result<(), B::Error> {
        let mut drawn: Option<Instant> = None;
        loop {
            thread::sleep(POLL_INTERVAL);
            let is_over = self.run.lock().is_over;
            for _ in 0..MAX_ROWS_PER_POLL {
                let Some(row) = self.tap_reader.next_row() else { break };
                self.state.add_row(&row);
            }
            if self.is_stopped.load(Ordering::Relaxed) {
                return Ok(());
            }
            if is_over || drawn.is_none_or(|drawn| drawn.elapsed() >= FRAME_INTERVAL) {
                self.state.counts = self.tap_reader.counts();
                let run = self.run.lock();
                self.state.finished = run.finished;
                if let Some(rig) = &run.rig {
                    self.state.rig.clone_from(rig);
                }
                drop(run);
                if let Some(captured) = &self.captured_lines {
                    self.state.messages =
                        captured.lock().unwrap_or_else(PoisonError::into_inner).last_lines(MAX_MESSAGES);
                }
                if terminal.size().is_ok_and(|size| is_drawable(size.width, size.height)) {
                    terminal.draw(|frame| draw(frame, &self.state))?;
                }
                drawn = Some(Instant::now());
            }
            if is_over {
                return Ok(());
            }
        }
    }
}

fn is_drawable(columns: u16, rows: u16) -> bool {
    u32::from(columns) * u32::from(rows) <= MAX_CELLS
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejects_a_terminal_with_more_than_the_largest_number_of_cells() {
        assert!(is_drawable(0, 0) && is_drawable(1024, 1024));
        assert!(!is_drawable(1025, 1024) && !is_drawable(u16::MAX, u16::MAX));
    }
}
