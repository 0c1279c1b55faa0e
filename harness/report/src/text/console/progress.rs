//! Shows the progress of a run on stderr. Errors of the terminal are ignored.

use crate::format;
use crate::text::escape::printable;
use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use platebench_record::ScenarioRecord;
use std::io::{self, IsTerminal as _, Write};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProgressKind {
    Bars,
    /// A line at the start and one at the end of a scenario.
    Lines,
    Quiet,
}

impl ProgressKind {
    /// Bars if stderr is a terminal, otherwise lines.
    pub fn detect() -> Self {
        if io::stderr().is_terminal() { Self::Bars } else { Self::Lines }
    }
}

/// Scenarios are named by their files; several may run at once.
pub struct Progress {
    sink: Sink,
}

enum Sink {
    Bars { all: MultiProgress, under_way: Vec<(String, ProgressBar)> },
    Lines(Box<dyn Write + Send>),
    Quiet,
}

impl Progress {
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

    pub fn to_writer(out: impl Write + Send + 'static) -> Self {
        Self { sink: Sink::Lines(Box::new(out)) }
    }

    pub fn scenario_started(&mut self, name: &str, trials: u32) {
        match &mut self.sink {
            Sink::Bars { all, under_way } => {
                let bar = all.add(ProgressBar::new(u64::from(trials)).with_style(bar_style()));
                bar.set_message(printable(name).into_owned());
                bar.tick();
                under_way.push((name.to_owned(), bar));
            }
            Sink::Lines(out) => {
                let trials = format::count(usize::try_from(trials).unwrap_or(usize::MAX), "trial");
                write_line(out.as_mut(), &format!("… {}: {trials}", printable(name)));
            }
            Sink::Quiet => {}
        }
    }

    pub fn trial_finished(&mut self, name: &str, index: u32) {
        let Sink::Bars { under_way, .. } = &mut self.sink else { return };
        if let Some((_, bar)) = under_way.iter().find(|(scenario, _)| scenario == name) {
            // A scenario may play more trials than planned until its verdicts are conclusive.
            let length = bar.length().unwrap_or(0).max(u64::from(index) + 1);
            bar.set_length(length);
            bar.inc(1);
        }
    }

    pub fn scenario_finished(&mut self, scenario: &ScenarioRecord) {
        let verdict = scenario.verdict;
        let trials = format::count(scenario.trials.len(), "trial");
        let text = format!("{} {}: {verdict}, {trials}", format::sign(verdict), printable(&scenario.file));
        match &mut self.sink {
            Sink::Bars { all, under_way } => {
                under_way.retain(|(name, bar)| {
                    let goes_on = *name != scenario.file;
                    if !goes_on {
                        bar.finish_and_clear();
                    }
                    goes_on
                });
                let _ = all.println(text);
            }
            Sink::Lines(out) => write_line(out.as_mut(), &text),
            Sink::Quiet => {}
        }
    }

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

fn write_line(out: &mut dyn Write, text: &str) {
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
        let mut progress = Progress::to_writer(Closed);
        progress.scenario_started("a.toml", 3);
        progress.trial_finished("a.toml", 0);
        progress.finish();
        super::super::print("text", &mut Closed).unwrap();
    }
}
