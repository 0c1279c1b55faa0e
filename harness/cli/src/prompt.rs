//! Asks the operator questions on standard error and reads the answers from standard input.
//!
//! With a real plate, the operator answers with lines: for an action, an empty line means done and
//! `n` not done. A terminal also shows the force as a bar. With `--yes`, or at the end of the
//! input, the operator is absent and what needs the operator stays inconclusive. An acceptance
//! session asks only at a terminal.

use crate::stdio::{self, NonBlockingStderr};
use platebench_engine::{Answer, CancelToken, Operator, Question, QuestionKind};
use platebench_plate::Time;
use std::io::{BufRead, IsTerminal, Write, stderr, stdin};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

/// If the operator does not confirm an action within this time, the operator counts as absent.
const ACTION_TIMEOUT: Duration = Duration::from_mins(15);
const POLL_INTERVAL: Duration = Duration::from_millis(50);
const REDRAW_INTERVAL: Duration = Duration::from_millis(100);
const BAR_CELLS: usize = 30;
/// Minimum force at the right end of the bar, N.
const BAR_FULL_N: f64 = 3.0;

pub(crate) struct TerminalOperator {
    is_interactive: bool,
    assume_yes: bool,
    shows_bar: bool,
    state: Mutex<PromptState>,
}

#[derive(Default)]
struct PromptState {
    /// Lines of standard input. `None` until the first question starts the reader.
    lines: Option<Receiver<String>>,
    next_action: String,
    last_drawn: Option<Instant>,
}

impl TerminalOperator {
    /// If `asks` is false, the operator counts as absent.
    pub(crate) fn at_plate(asks: bool) -> Self {
        let shows_bar = asks && stderr().is_terminal();
        Self { is_interactive: asks, assume_yes: false, shows_bar, state: Mutex::default() }
    }

    /// With `assume_yes` nothing is asked: a question with yes or no gets the answer yes.
    pub(crate) fn in_session(assume_yes: bool) -> Self {
        let is_interactive = !assume_yes && stdin().is_terminal();
        Self { is_interactive, assume_yes, shows_bar: false, state: Mutex::default() }
    }

    fn clear_bar(&self, state: &mut PromptState) {
        if self.shows_bar && state.last_drawn.take().is_some() {
            let _ = write!(NonBlockingStderr, "\r\x1b[K");
        }
    }
}

/// The channel closes at the end of the input. The reading thread may block, so it is not joined.
fn read_stdin_lines() -> Receiver<String> {
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

/// Returns `None` at the end of the input, on cancellation, or after `timeout`.
fn read_line(lines: &Receiver<String>, cancel: &CancelToken, timeout: Option<Duration>) -> Option<String> {
    let started = Instant::now();
    while !cancel.is_cancelled() && timeout.is_none_or(|timeout| started.elapsed() < timeout) {
        match lines.recv_timeout(POLL_INTERVAL) {
            Ok(line) => return Some(line.trim().to_owned()),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return None,
        }
    }
    None
}

/// An error is ignored: the operator cannot see a question if standard error is closed.
fn write_prompt(text: &str) {
    let mut out = stderr().lock();
    let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
}

impl Operator for TerminalOperator {
    fn ask(&self, question: Question<'_>, cancel: &CancelToken) -> Answer {
        let Question { text, kind } = question;
        if self.assume_yes && kind == QuestionKind::Confirm {
            return Answer::CommandLine("yes".to_owned());
        }
        if !self.is_interactive {
            return Answer::Absent;
        }
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        self.clear_bar(&mut state);
        let timeout = match kind {
            QuestionKind::Action => {
                stdio::note(&format!("please {text}; press Enter when it is done, n and Enter if it cannot be done"));
                Some(ACTION_TIMEOUT)
            }
            QuestionKind::Confirm => {
                write_prompt(&format!("{text} [yes/no] "));
                None
            }
            QuestionKind::Text => {
                write_prompt(&format!("{text} "));
                None
            }
            QuestionKind::Number => {
                write_prompt(&format!("{text} [number] "));
                None
            }
        };
        let lines = state.lines.get_or_insert_with(read_stdin_lines);
        while let Some(line) = read_line(lines, cancel, timeout) {
            if let Some(answer) = parse_answer(kind, &line) {
                return Answer::Terminal(answer);
            }
            write_prompt(if kind == QuestionKind::Number { "a number, such as 23.5? " } else { "yes or no? " });
        }
        Answer::Absent
    }

    fn announce(&self, action: &str, seconds: u32) {
        let text = if seconds == 0 { format!("now: {action}") } else { format!("in {seconds} s: {action}") };
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if self.shows_bar {
            state.next_action = text;
            state.last_drawn = None;
        } else {
            stdio::note(&text);
        }
    }

    fn show_force(&self, now: Time, demanded_n: f64, measured_n: Option<f64>) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if !self.shows_bar || state.last_drawn.is_some_and(|drawn| drawn.elapsed() < REDRAW_INTERVAL) {
            return;
        }
        state.last_drawn = Some(Instant::now());
        let text = bar(demanded_n, measured_n);
        let _ = write!(NonBlockingStderr, "\r\x1b[K{:6.1} s  {text}  {}", now.seconds(), state.next_action);
    }

    fn trial_ended(&self) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        self.clear_bar(&mut state);
        state.next_action.clear();
    }
}

/// Repeats the question until the answer is a choice or its first letter; `?` prints what each
/// choice does. `None` without input.
pub(crate) fn ask_choice(meanings: &[(&'static str, &str)]) -> Option<&'static str> {
    let choices: Vec<_> = meanings.iter().map(|(choice, _)| *choice).collect();
    let mut lines = stdin().lock().lines().map_while(Result::ok);
    loop {
        write_prompt(&format!("{}? ", choices.join(", ")));
        let line = lines.next()?.trim().to_lowercase();
        if line == "?" {
            for (choice, meaning) in meanings {
                write_prompt(&format!(
                    "  {:<9}{meaning}\n",
                    format!("{} {choice}", choice.get(..1).unwrap_or_default())
                ));
            }
        }
        let is_meant = |choice: &&&str| **choice == line || choice.get(..1) == Some(line.as_str());
        if let Some(choice) = choices.iter().find(is_meant) {
            return Some(choice);
        }
    }
}

/// Returns `None` for an unclear answer: neither yes nor no, or not a finite number.
fn parse_answer(kind: QuestionKind, line: &str) -> Option<String> {
    let answer = match (kind, line.to_lowercase().as_str()) {
        (QuestionKind::Text, _) => line,
        (QuestionKind::Number, _) => {
            // Accepts a decimal comma too, which is common in Europe.
            let number = line.replace(',', ".").parse::<f64>().ok().filter(|number| number.is_finite())?;
            return Some(number.to_string());
        }
        (QuestionKind::Action, "" | "y" | "yes") | (QuestionKind::Confirm, "y" | "yes") => "yes",
        (QuestionKind::Action, _) | (QuestionKind::Confirm, "n" | "no") => "no",
        (QuestionKind::Confirm, _) => return None,
    };
    Some(answer.to_owned())
}

fn bar(demanded_n: f64, measured_n: Option<f64>) -> String {
    let Some(force) = measured_n else { return format!("{demanded_n:.2} N demanded, not measured") };
    let full = BAR_FULL_N.max(1.25 * demanded_n);
    let cell = |newton: f64| ((newton / full * BAR_CELLS as f64).round().max(0.0) as usize).min(BAR_CELLS - 1);
    let (filled, mark) = (cell(force), cell(demanded_n));
    let drawn: String = (0..BAR_CELLS)
        .map(|number| match number {
            _ if number == mark => '|',
            _ if number < filled => '#',
            _ => '.',
        })
        .collect();
    format!("[{drawn}] {force:.2} of {demanded_n:.2} N")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bar_shows_measured_and_demanded_force() {
        assert_eq!(bar(1.5, Some(0.5)), "[#####..........|..............] 0.50 of 1.50 N");
        assert_eq!(bar(0.5, Some(9.0)), "[#####|#######################.] 9.00 of 0.50 N");
        assert_eq!(bar(8.0, Some(-1.0)), "[........................|.....] -1.00 of 8.00 N");
        assert_eq!(bar(2.0, None), "2.00 N demanded, not measured");
    }

    #[test]
    fn parses_answers_by_kind_of_question() {
        use QuestionKind::{Action, Confirm, Number, Text};
        for (kind, line, expected) in [
            (Action, "", Some("yes")),
            (Action, "Y", Some("yes")),
            (Action, "yes", Some("yes")),
            (Action, "n", Some("no")),
            (Action, "what?", Some("no")),
            (Confirm, "Yes", Some("yes")),
            (Confirm, "n", Some("no")),
            (Confirm, "", None),
            (Text, "Lab 2", Some("Lab 2")),
            (Number, "23,5", Some("23.5")),
            (Number, "-4", Some("-4")),
            (Number, "warm", None),
            (Number, "inf", None),
            (Number, "", None),
        ] {
            assert_eq!(parse_answer(kind, line).as_deref(), expected, "{kind:?} {line}");
        }
    }

    #[test]
    fn an_absent_operator_is_not_asked() {
        let question = Question { text: "warm the plate", kind: QuestionKind::Action };
        assert_eq!(TerminalOperator::at_plate(false).ask(question, &CancelToken::never()), Answer::Absent);
    }
}
