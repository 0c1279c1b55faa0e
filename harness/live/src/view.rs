//! The thread that looks and draws.

use crate::diverted::{Diverted, Kept};
use crate::draw::draw;
use crate::scope::Scope;
use crate::screen::Screen;
use crate::subject::Subject;
use crossterm::event::{Event, KeyCode, KeyEventKind, KeyModifiers, poll, read};
use crossterm::terminal::size;
use platebench_runner::{Event as RunEvent, Viewer};
use platebench_verdict::Verdict;
use ratatui::Terminal;
use ratatui::backend::{Backend, CrosstermBackend};
use rustix::process::{Signal, getpid, kill_process};
use std::io::{self, BufWriter, IsTerminal, stdin};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

/// Between two pictures.
const DRAW_EVERY: Duration = Duration::from_millis(50);
/// Between two looks into the queue, which holds much more than passes meanwhile in real time.
const LOOK_EVERY: Duration = Duration::from_millis(10);
/// Rows that are taken between two looks at anything else: time that does not wait may bring them as fast as they are taken.
const MOST: usize = 1 << 15;
/// A picture fits, so that it is one write.
const FRAME: usize = 1 << 16;
/// How long the last picture may take; a terminal that takes nothing holds nobody up for longer.
const LAST: Duration = Duration::from_millis(500);
/// Cells of the largest terminal that is drawn on, some hundred times what fits on a screen: a picture is held in memory twice.
const MOST_CELLS: u32 = 1 << 20;
/// Lines of standard error that a picture has room for.
const LINES: usize = 64;
/// How often whoever waits for a key looks whether it is over.
const KEYS_EVERY: Duration = Duration::from_millis(100);

/// Why there is no view. The run goes on without one.
#[derive(Debug, thiserror::Error)]
pub enum NoView {
    /// Nobody would see it.
    #[error("standard output is no terminal")]
    NoTerminal,
    /// It has no cursor to be moved.
    #[error("the terminal is a dumb one (TERM=dumb)")]
    Dumb,
    /// No picture of that size can be made.
    #[error("the terminal says that it has {columns} columns and {rows} rows")]
    Size {
        /// Its width.
        columns: u16,
        /// Its height.
        rows: u16,
    },
    /// Somebody else has the terminal.
    #[error("the program is not in the foreground of its terminal")]
    Background,
    /// The system refuses something.
    #[error(transparent)]
    Io(#[from] io::Error),
}

/// What the view is told, beside the rows.
#[derive(Debug)]
pub enum Told {
    /// Where the controller is to be found.
    Place(String),
    /// A trial has ended.
    TrialEnded,
    /// A scenario was judged.
    Judged(Verdict),
}

impl Told {
    /// What there is to tell of an event of the run.
    pub fn of(event: &RunEvent) -> Option<Self> {
        match event {
            RunEvent::ScenarioStarted { .. } => None,
            RunEvent::TrialFinished { .. } => Some(Self::TrialEnded),
            RunEvent::ScenarioFinished(record) => Some(Self::Judged(record.verdict)),
        }
    }
}

/// What the view's thread hears.
#[derive(Debug)]
enum Heard {
    News(Told),
    End,
}

/// A view that goes on until this is dropped; the terminal is then as it was before.
#[derive(Debug)]
pub struct View {
    // In the order in which they end: the picture, the screen, standard error.
    heard: Sender<Heard>,
    ended: Receiver<()>,
    /// Set where the terminal is gone or no longer the view's: nobody draws or takes keys any more.
    over: Arc<AtomicBool>,
    screen: Option<Screen>,
    _diverted: Option<Diverted>,
}

impl View {
    /// Takes the terminal and shows what passes.
    ///
    /// # Errors
    /// [`NoView`]; the terminal is then untouched.
    pub fn open(subject: Subject, viewer: Viewer) -> Result<Self, NoView> {
        if let Ok((columns, rows)) = size()
            && !can_be_drawn(columns, rows)
        {
            return Err(NoView::Size { columns, rows });
        }
        let screen = Screen::enter()?;
        let diverted = Diverted::begin()?;
        let over = Arc::new(AtomicBool::new(false));
        let pictures = BufWriter::with_capacity(FRAME, Screen::pictures(Arc::clone(&over))?);
        let mut terminal = Terminal::new(CrosstermBackend::new(pictures))?;
        let (heard, hears) = channel();
        let (end, ended) = channel::<()>();
        let mut onlooker = Onlooker {
            scope: Scope::new(subject),
            viewer,
            hears,
            kept: diverted.as_ref().map(Diverted::kept),
            over: Arc::clone(&over),
        };
        thread::Builder::new().name("view".to_owned()).spawn(move || {
            // Where it panics, nobody waits for it either.
            let _end = end;
            // A terminal that is gone takes no pictures any more; the run goes on, and whoever closed it has sent a signal.
            let _ = onlooker.look(&mut terminal);
        })?;
        Ok(Self { heard, ended, over, screen: Some(screen), _diverted: diverted })
    }

    /// Tells the view; never waits.
    pub fn tell(&self, news: Told) {
        // A view that has ended needs none.
        let _ = self.heard.send(Heard::News(news));
    }

    /// For whoever has something to tell on another thread.
    pub fn teller(&self) -> Teller {
        Teller(self.heard.clone())
    }

    /// From now on the key q ends the program as Ctrl-C does.
    pub fn quit_on_q(&self) {
        let over = Arc::clone(&self.over);
        // Not waited for: a terminal that hung up keeps it for ever.
        thread::spawn(move || {
            watch_keys(
                || over.load(Ordering::Relaxed),
                |letter| {
                    if letter == 'q' {
                        // A process may always signal itself.
                        let _ = kill_process(getpid(), Signal::INT);
                    }
                },
            );
        });
    }
}

/// Tells a view that may have ended.
#[derive(Debug, Clone)]
pub struct Teller(Sender<Heard>);

impl Teller {
    /// As [`View::tell`].
    pub fn tell(&self, news: Told) {
        let _ = self.0.send(Heard::News(news));
    }
}

impl Drop for View {
    fn drop(&mut self) {
        // Hanging up would not do: tellers may be left.
        let _ = self.heard.send(Heard::End);
        // An error is its end as well. A terminal that took nothing for so long is given back without waiting.
        let _ = self.ended.recv_timeout(LAST);
        self.over.store(true, Ordering::Relaxed);
        self.screen.take();
    }
}

/// What the view's thread has.
struct Onlooker {
    scope: Scope,
    viewer: Viewer,
    hears: Receiver<Heard>,
    kept: Option<Arc<Mutex<Kept>>>,
    /// As in [`View`].
    over: Arc<AtomicBool>,
}

impl Onlooker {
    /// Looks and draws until the end.
    fn look<B: Backend>(&mut self, terminal: &mut Terminal<B>) -> Result<(), B::Error> {
        let mut drawn: Option<Instant> = None;
        loop {
            let is_over = match self.hears.recv_timeout(LOOK_EVERY) {
                Ok(Heard::News(news)) => {
                    self.scope.hear(news);
                    false
                }
                Err(RecvTimeoutError::Timeout) => false,
                Ok(Heard::End) | Err(RecvTimeoutError::Disconnected) => true,
            };
            for _ in 0..MOST {
                let Some(sight) = self.viewer.take() else { break };
                self.scope.see(&sight);
            }
            if self.over.load(Ordering::Relaxed) {
                return Ok(());
            }
            if is_over || drawn.is_none_or(|drawn| drawn.elapsed() >= DRAW_EVERY) {
                self.scope.counts = self.viewer.counts();
                if let Some(kept) = &self.kept {
                    self.scope.messages = kept.lock().unwrap_or_else(PoisonError::into_inner).last(LINES);
                }
                if terminal.size().is_ok_and(|size| can_be_drawn(size.width, size.height)) {
                    terminal.draw(|frame| draw(frame, &self.scope))?;
                }
                drawn = Some(Instant::now());
            }
            if is_over {
                return Ok(());
            }
        }
    }
}

/// False for a size that nobody's terminal has: it can be set to anything.
fn can_be_drawn(columns: u16, rows: u16) -> bool {
    u32::from(columns) * u32::from(rows) <= MOST_CELLS
}

/// What [`watch_keys`] gives for Ctrl-C where that is a key: in a raw terminal. In the view's it is a signal.
pub const INTERRUPT: char = '\u{3}';

/// Gives letters that are typed to `typed` until `is_over`; returns at once where nobody types.
pub fn watch_keys(is_over: impl Fn() -> bool, mut typed: impl FnMut(char)) {
    if !stdin().is_terminal() {
        return;
    }
    while !is_over() {
        match poll(KEYS_EVERY) {
            Ok(true) => {}
            Ok(false) => continue,
            // A terminal that is gone.
            Err(_) => return,
        }
        if let Ok(Event::Key(key)) = read()
            && key.kind != KeyEventKind::Release
            && let KeyCode::Char(letter) = key.code
        {
            let is_interrupt = letter == 'c' && key.modifiers.contains(KeyModifiers::CONTROL);
            typed(if is_interrupt { INTERRUPT } else { letter });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_size_that_nobody_s_terminal_has_is_not_drawn() {
        assert!(can_be_drawn(0, 0) && can_be_drawn(1024, 1024));
        assert!(!can_be_drawn(1025, 1024) && !can_be_drawn(u16::MAX, u16::MAX));
    }
}
