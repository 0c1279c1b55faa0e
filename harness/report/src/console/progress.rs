//! How far a run is.
//!
//! Neighbours: whoever receives the events of a run calls this, from one thread. Nothing of the result stands here
//! only: it is a comfort, and what cannot be written is dropped without a word.

use crate::shown;
use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use platebench_verdict::ScenarioRecord;
use std::io::{self, IsTerminal as _, Write};

/// What progress looks like.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProgressKind {
    /// A bar for each scenario under way, on stderr.
    Bars,
    /// A line when a scenario starts and one when it ends, on stderr.
    Lines,
    /// Nothing.
    Quiet,
}

impl ProgressKind {
    /// Bars where stderr is a terminal, lines where it is not.
    pub fn detect() -> Self {
        if io::stderr().is_terminal() { Self::Bars } else { Self::Lines }
    }
}

/// Shows how far a run is. Scenarios go by the name of their file, as in the record, and several may be under way.
pub struct Progress {
    sink: Sink,
}

enum Sink {
    Bars { all: MultiProgress, under_way: Vec<(String, ProgressBar)> },
    Lines(Box<dyn Write + Send>),
    Quiet,
}

impl Progress {
    /// Progress on stderr.
    pub fn new(kind: ProgressKind) -> Self {
        let sink = match kind {
            ProgressKind::Bars => {
                Sink::Bars { all: MultiProgress::with_draw_target(ProgressDrawTarget::stderr()), under_way: Vec::new() }
            }
            ProgressKind::Lines => Sink::Lines(Box::new(io::stderr())),
            ProgressKind::Quiet => Sink::Quiet,
        };
        Self { sink }
    }

    /// Progress in lines, to wherever `out` leads.
    pub fn lines_to(out: impl Write + Send + 'static) -> Self {
        Self { sink: Sink::Lines(Box::new(out)) }
    }

    /// The scenario in file `name` starts, with so many trials to come.
    pub fn scenario_started(&mut self, name: &str, trials: u32) {
        match &mut self.sink {
            Sink::Bars { all, under_way } => {
                let bar = all.add(ProgressBar::new(u64::from(trials)).with_style(bar_style()));
                bar.set_message(name.to_owned());
                bar.tick();
                under_way.push((name.to_owned(), bar));
            }
            Sink::Lines(out) => {
                let trials = shown::count(usize::try_from(trials).unwrap_or(usize::MAX), "trial");
                line(out.as_mut(), &format!("… {name}: {trials}"));
            }
            Sink::Quiet => {}
        }
    }

    /// The trial with number `index`, counted from 0, of the scenario in file `name` is over.
    pub fn trial_finished(&mut self, name: &str, index: u32) {
        let Sink::Bars { under_way, .. } = &mut self.sink else { return };
        if let Some((_, bar)) = under_way.iter().find(|(scenario, _)| scenario == name) {
            // A scenario may go on beyond its count until its verdicts are conclusive.
            let length = bar.length().unwrap_or(0).max(u64::from(index) + 1);
            bar.set_length(length);
            bar.inc(1);
        }
    }

    /// A scenario is over and judged.
    pub fn scenario_finished(&mut self, scenario: &ScenarioRecord) {
        let verdict = scenario.verdict;
        let trials = shown::count(scenario.trials.len(), "trial");
        let text = format!("{} {}: {verdict}, {trials}", shown::sign(verdict), scenario.file);
        match &mut self.sink {
            Sink::Bars { all, under_way } => {
                under_way.retain(|(name, bar)| {
                    let goes_on = *name != scenario.file;
                    if !goes_on {
                        bar.finish_and_clear();
                    }
                    goes_on
                });
                // A terminal that is gone has no reader.
                let _ = all.println(text);
            }
            Sink::Lines(out) => line(out.as_mut(), &text),
            Sink::Quiet => {}
        }
    }

    /// The run is over; bars that are left (a run cut short) go away.
    pub fn finish(&mut self) {
        match &mut self.sink {
            Sink::Bars { all, under_way } => {
                for (_, bar) in under_way.drain(..) {
                    bar.finish_and_clear();
                }
                let _ = all.clear();
            }
            Sink::Lines(out) => {
                let _ = out.flush();
            }
            Sink::Quiet => {}
        }
    }
}

fn line(out: &mut dyn Write, text: &str) {
    // Nobody to tell when stderr itself is gone.
    let _ = writeln!(out, "{text}");
}

fn bar_style() -> ProgressStyle {
    let template = "  {bar:24} {pos:>3}/{len} {msg} {elapsed}";
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
    fn a_closed_pipe_is_nobodys_problem() {
        let mut progress = Progress::lines_to(Closed);
        progress.scenario_started("a.toml", 3);
        progress.trial_finished("a.toml", 0);
        progress.finish();
        super::super::print("text", &mut Closed).unwrap();
    }
}
