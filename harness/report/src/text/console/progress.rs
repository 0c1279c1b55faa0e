//! Shows the progress of a run on stderr. Errors of the terminal are ignored.

use crate::format;
use crate::text::escape::printable;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use platebench_model::record::{Event, Verdict};
use std::io::{self, IsTerminal as _, Write};
use std::time::Duration;

const TICK: Duration = Duration::from_millis(500);
/// The message is cut at the width of the terminal.
const TRIALS: &str = "  {bar:24} {pos}/{len} trials  {elapsed}  {wide_msg}";

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProgressKind {
    Bar,
    /// A line at the start and one at the end of a scenario.
    Lines,
    Quiet,
}

impl ProgressKind {
    pub fn detect() -> Self {
        if io::stderr().is_terminal() { Self::Bar } else { Self::Lines }
    }
}

pub struct Progress {
    sink: Sink,
}

enum Sink {
    Bar { bar: ProgressBar, under_way: Vec<String>, not_passed: usize },
    Lines(Box<dyn Write + Send>),
    Quiet,
}

impl Progress {
    pub fn new(kind: ProgressKind) -> Self {
        let sink = match kind {
            ProgressKind::Bar => {
                let target = ProgressDrawTarget::stderr();
                let bar = ProgressBar::with_draw_target(Some(0), target).with_style(style(TRIALS));
                Sink::Bar { bar, under_way: Vec::new(), not_passed: 0 }
            }
            ProgressKind::Lines => Sink::Lines(Box::new(io::stderr())),
            ProgressKind::Quiet => Sink::Quiet,
        };
        Self { sink }
    }

    pub fn to_writer(out: impl Write + Send + 'static) -> Self {
        Self { sink: Sink::Lines(Box::new(out)) }
    }

    /// Sets the length of the bar. The default is the number of trials of the started scenarios.
    #[must_use]
    pub fn with_planned_trials(self, trials: u64) -> Self {
        if let Sink::Bar { bar, .. } = &self.sink {
            bar.set_length(trials);
        }
        self
    }

    /// The bar shows the elapsed time during a step without trials, such as mutation testing.
    #[must_use]
    pub fn with_elapsed_time(self, title: &str) -> Self {
        if let Sink::Bar { bar, .. } = &self.sink {
            bar.set_style(style("  {elapsed}  {wide_msg}"));
            bar.set_message(printable(title).into_owned());
            bar.enable_steady_tick(TICK);
        }
        self
    }

    pub fn show(&mut self, event: &Event) {
        match (&mut self.sink, event) {
            (Sink::Bar { bar, under_way, not_passed }, Event::ScenarioStarted { file, trials }) => {
                bar.set_style(style(TRIALS));
                bar.set_length(bar.length().unwrap_or(0).max(bar.position() + u64::from(*trials)));
                under_way.push(file.clone());
                bar.set_message(message(under_way, *not_passed));
            }
            (Sink::Bar { bar, .. }, Event::TrialFinished { .. }) => {
                // A scenario may play more trials than planned until its verdicts are conclusive.
                bar.set_length(bar.length().unwrap_or(0).max(bar.position() + 1));
                bar.inc(1);
            }
            (Sink::Bar { bar, under_way, not_passed }, Event::ScenarioFinished(scenario)) => {
                under_way.retain(|name| *name != scenario.file);
                *not_passed += usize::from(scenario.verdict != Verdict::Pass);
                bar.set_message(message(under_way, *not_passed));
            }
            (Sink::Lines(out), Event::ScenarioStarted { file, trials }) => {
                let trials = format::count(usize::try_from(*trials).unwrap_or(usize::MAX), "trial");
                write_line(out.as_mut(), &format!("… {}: {trials}", printable(file)));
            }
            (Sink::Lines(out), Event::ScenarioFinished(scenario)) => {
                let (sign, verdict) = (format::sign(scenario.verdict), scenario.verdict);
                let trials = format::count(scenario.trial_count, "trial");
                write_line(out.as_mut(), &format!("{sign} {}: {verdict}, {trials}", printable(&scenario.file)));
            }
            (Sink::Lines(_), Event::TrialFinished { .. }) | (Sink::Quiet, _) => {}
        }
    }

    pub fn finish(&mut self) {
        match &mut self.sink {
            Sink::Bar { bar, .. } => bar.finish_and_clear(),
            Sink::Lines(out) => {
                let _ = out.flush();
            }
            Sink::Quiet => {}
        }
    }
}

fn message(under_way: &[String], not_passed: usize) -> String {
    let count = if not_passed == 0 { String::new() } else { format!("{not_passed} not passed  ") };
    format!("{count}{}", printable(under_way.last().map_or("", String::as_str)))
}

fn write_line(out: &mut dyn Write, text: &str) {
    let _ = writeln!(out, "{text}");
}

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()).progress_chars("━╸ ")
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Closed;

    impl Write for Closed {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(io::ErrorKind::BrokenPipe.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Err(io::ErrorKind::BrokenPipe.into())
        }
    }

    #[test]
    fn a_closed_pipe_is_no_error() {
        let mut progress = Progress::to_writer(Closed);
        progress.show(&Event::ScenarioStarted { file: "a.toml".to_owned(), trials: 3 });
        progress.finish();
        super::super::print("text", &mut Closed).unwrap();
    }
}
