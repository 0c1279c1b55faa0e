//! The person at the terminal, where there is one.

use crate::live::Shown;
use crate::play::follow;
use platebench_acceptance::plan::AnswerKind;
use platebench_acceptance::session::{StepKind, StepRecord};
use platebench_acceptance::{Answer, Desk, Question};
use platebench_report::{Progress, ProgressKind};
use platebench_runner::{Cancel, Event, Plan, Watch};
use std::io::{IsTerminal, Write, stderr, stdin};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread;
use std::time::Duration;

/// How often somebody looks whether the session was ended while an answer is waited for.
const LOOK: Duration = Duration::from_millis(50);

/// Questions and progress on a terminal.
pub(crate) struct Terminal {
    kind: ProgressKind,
    progress: Option<Progress>,
    /// It is the bench that is measured, not the controller.
    measuring: bool,
    yes: bool,
    /// What is typed, line by line; only where a person can type.
    lines: Option<Receiver<String>>,
    cancel: Cancel,
    shown: Shown,
}

impl Terminal {
    pub(crate) fn new(kind: ProgressKind, yes: bool, cancel: Cancel, shown: Shown) -> Self {
        let lines = (!yes && stdin().is_terminal()).then(|| {
            let (sender, lines) = channel();
            // It waits for the next line for as long as the program lives.
            thread::spawn(move || {
                for line in stdin().lines() {
                    let Ok(line) = line else { break };
                    if sender.send(line).is_err() {
                        break;
                    }
                }
            });
            lines
        });
        Self { kind, progress: None, measuring: false, yes, lines, cancel, shown }
    }

    /// The next line; `None` where the session was ended, or nobody types any more.
    fn line(&self) -> Option<String> {
        let lines = self.lines.as_ref()?;
        loop {
            match lines.recv_timeout(LOOK) {
                Ok(line) => return Some(line.trim().to_owned()),
                Err(RecvTimeoutError::Disconnected) => return None,
                Err(RecvTimeoutError::Timeout) if self.cancel.is_cancelled() => return None,
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    }

    fn say(&self, text: &str) {
        if self.kind != ProgressKind::Quiet {
            prompt(text);
        }
    }
}

/// Writes to standard error without a line's end; where nobody reads it, nobody is told.
fn prompt(text: &str) {
    let mut out = stderr().lock();
    let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
}

impl Desk for Terminal {
    fn ask(&mut self, question: &Question<'_>) -> Answer {
        match question.kind {
            AnswerKind::Confirm if self.yes => return Answer::CommandLine("yes".to_owned()),
            _ if self.lines.is_none() => return Answer::NotAsked,
            AnswerKind::Confirm => prompt(&format!("{} [yes/no] ", question.text)),
            AnswerKind::Text => prompt(&format!("{} ", question.text)),
        }
        while let Some(line) = self.line() {
            match (question.kind, line.to_lowercase().as_str()) {
                (AnswerKind::Text, _) => return Answer::Terminal(line),
                (AnswerKind::Confirm, "y" | "yes") => return Answer::Terminal("yes".to_owned()),
                (AnswerKind::Confirm, "n" | "no") => return Answer::Terminal("no".to_owned()),
                (AnswerKind::Confirm, _) => prompt("yes or no? "),
            }
        }
        Answer::NotAsked
    }

    fn begun(&mut self, step: &StepRecord) {
        self.say(&format!("{}  {}\n", step.id, step.title));
        self.progress = Some(Progress::new(self.kind));
        self.measuring = step.kind == StepKind::SelfTest;
    }

    fn ended(&mut self, step: &StepRecord) {
        self.shown.close();
        if let Some(mut progress) = self.progress.take() {
            progress.finish();
        }
        let verdict = step.verdict.map_or("done", |verdict| verdict.name());
        let reason = step.reason.as_deref().map_or_else(String::new, |reason| format!(", {reason}"));
        self.say(&format!("{}  {verdict}{reason}\n", step.id));
    }

    fn watch(&mut self, plan: &Plan) -> Watch {
        let Some(watch) = self.shown.open(plan) else { return Watch::default() };
        // The picture shows how far it is.
        self.progress = None;
        watch
    }

    fn event(&mut self, event: &Event) {
        self.shown.tell(event);
        let Some(progress) = &mut self.progress else { return };
        match event {
            // What the scenario expects of a controller is not what the bench is measured by.
            Event::ScenarioFinished(record) if self.measuring => {
                progress.finish();
                self.progress = Some(Progress::new(self.kind));
                let (trials, s) = (record.trials.len(), if record.trials.len() == 1 { "" } else { "s" });
                self.say(&format!("  {trials} trial{s} of {} measured, the bench's own; not judged\n", record.file));
            }
            event => follow(progress, event),
        }
    }
}
