//! The person at a real plate: prompts on standard error, answers on standard input.
//!
//! On a terminal the force is a live bar; elsewhere every prompt is a line, and every answer a line as well: an empty one for done, `n` for not done. Without anybody there
//! (`--yes`, or a standard input that has ended) what needs a person stays undecided.

use crate::guard::Log;
use crate::output;
use platebench_plate::Time;
use platebench_runner::{Answer, Person};
use std::io::{BufRead, IsTerminal, Write, stderr, stdin};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

/// Somebody who has not answered by then is not there.
const PATIENCE: Duration = Duration::from_mins(15);
/// Between two looks at whether the run is to end.
const LOOK_UP: Duration = Duration::from_millis(50);
/// Between two drawings of the bar.
const REDRAW: Duration = Duration::from_millis(100);
/// Cells of the bar, and the force that fills it at least, N.
const CELLS: usize = 30;
const FULL_N: f64 = 3.0;

/// Somebody at the desk, or nobody.
pub(crate) struct Desk {
    asks: bool,
    shows_bar: bool,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// Lines from standard input; listened for from the first question on.
    lines: Option<Receiver<String>>,
    /// What is to be done next, beside the bar.
    cue: String,
    drawn: Option<Instant>,
}

impl Desk {
    /// A person who is asked, or nobody.
    pub(crate) fn new(asks: bool) -> Self {
        let shows_bar = asks && stderr().is_terminal();
        Self { asks, shows_bar, state: Mutex::default() }
    }

    /// Ends the line that the bar is on.
    fn leave_bar(&self, state: &mut State) {
        if self.shows_bar && state.drawn.take().is_some() {
            // Nobody is left to tell.
            let _ = write!(Log, "\r\x1b[K");
        }
    }
}

/// Lines of standard input; the channel closes with it. The thread ends with the process.
fn listen() -> Receiver<String> {
    let (sender, receiver) = channel();
    thread::spawn(move || {
        for line in stdin().lock().lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                break;
            }
        }
    });
    receiver
}

impl Person for Desk {
    fn ask(&self, what: &str, is_over: &dyn Fn() -> bool) -> Answer {
        if !self.asks {
            return Answer::Absent;
        }
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        self.leave_bar(&mut state);
        output::note(&format!("please {what}; Enter when it is so, n and Enter if it cannot be done"));
        let lines = state.lines.get_or_insert_with(listen);
        let asked = Instant::now();
        while asked.elapsed() < PATIENCE {
            if is_over() {
                return Answer::GivenUp;
            }
            match lines.recv_timeout(LOOK_UP) {
                Ok(line) => return answer(&line),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return Answer::Absent,
            }
        }
        Answer::Absent
    }

    fn cue(&self, what: &str, seconds: u32) {
        let told = if seconds == 0 { format!("now: {what}") } else { format!("in {seconds} s: {what}") };
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if self.shows_bar {
            state.cue = told;
            state.drawn = None;
        } else {
            output::note(&told);
        }
    }

    fn bar(&self, now: Time, wished_n: f64, force_n: Option<f64>) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if !self.shows_bar || state.drawn.is_some_and(|drawn| drawn.elapsed() < REDRAW) {
            return;
        }
        state.drawn = Some(Instant::now());
        let text = bar(wished_n, force_n);
        let _ = write!(Log, "\r\x1b[K{:6.1} s  {text}  {}", now.seconds(), state.cue);
    }

    fn rest(&self) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        self.leave_bar(&mut state);
        state.cue.clear();
    }
}

/// What an answer means: nothing but a plain yes is one.
fn answer(line: &str) -> Answer {
    match line.trim().to_ascii_lowercase().as_str() {
        "" | "y" | "yes" => Answer::Done,
        _ => Answer::Declined,
    }
}

/// The finger's force as a bar, with a mark where it should be.
fn bar(wished_n: f64, force_n: Option<f64>) -> String {
    let Some(force) = force_n else { return format!("{wished_n:.2} N asked for, not measured") };
    let full = FULL_N.max(1.25 * wished_n);
    let cell = |newton: f64| ((newton / full * CELLS as f64).round().max(0.0) as usize).min(CELLS - 1);
    let (filled, mark) = (cell(force), cell(wished_n));
    let drawn: String = (0..CELLS)
        .map(|number| match number {
            _ if number == mark => '|',
            _ if number < filled => '#',
            _ => '.',
        })
        .collect();
    format!("[{drawn}] {force:.2} of {wished_n:.2} N")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bar_shows_what_is_and_what_should_be() {
        assert_eq!(bar(1.5, Some(0.5)), "[#####..........|..............] 0.50 of 1.50 N");
        assert_eq!(bar(0.5, Some(9.0)), "[#####|#######################.] 9.00 of 0.50 N");
        assert_eq!(bar(8.0, Some(-1.0)), "[........................|.....] -1.00 of 8.00 N");
        assert_eq!(bar(2.0, None), "2.00 N asked for, not measured");
    }

    #[test]
    fn only_a_plain_yes_is_one() {
        for (line, expected) in [("", true), ("  ", true), ("Y", true), ("yes", true), ("n", false), ("what?", false)] {
            assert_eq!(answer(line) == Answer::Done, expected, "{line}");
        }
    }

    #[test]
    fn nobody_is_not_asked() {
        assert_eq!(Desk::new(false).ask("warm the plate", &|| false), Answer::Absent);
    }
}
