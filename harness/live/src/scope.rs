//! What was seen so far.

use crate::history::History;
use crate::subject::{Show, Subject};
use crate::view::Told;
use platebench_runner::watch::{Counts, Sight};
use platebench_trace::Row;
use platebench_verdict::Verdict;

/// Scenarios and trials that have come to their end.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Ended {
    pub(crate) trials: u64,
    pub(crate) passed: usize,
    pub(crate) failed: usize,
    pub(crate) inconclusive: usize,
}

/// See the module.
#[derive(Debug)]
pub(crate) struct Scope {
    pub(crate) subject: Subject,
    /// Scenario and trial of the newest row.
    playing: Option<(usize, u32)>,
    pub(crate) newest: Option<Row>,
    pub(crate) history: History,
    pub(crate) counts: Counts,
    pub(crate) ended: Ended,
    /// The last things said on standard error, oldest first.
    pub(crate) messages: Vec<String>,
}

impl Scope {
    pub(crate) fn new(subject: Subject) -> Self {
        Self {
            subject,
            playing: None,
            newest: None,
            history: History::new(1.0, 1.0),
            counts: Counts::default(),
            ended: Ended::default(),
            messages: Vec::new(),
        }
    }

    /// Takes a row. Another trial, or time that begins anew, starts a new picture.
    pub(crate) fn see(&mut self, sight: &Sight) {
        let playing = Some((sight.scenario, sight.trial));
        let is_new = self.playing != playing || self.newest.is_none_or(|newest| newest.t_s > sight.row.t_s);
        self.playing = playing;
        self.newest = Some(sight.row);
        if is_new && let Some(show) = self.show() {
            self.history = History::new(show.window_s(), show.spacing_s);
        }
        self.history.take(&sight.row);
    }

    /// What is being played, and the number of the trial counted from 1.
    pub(crate) fn playing(&self) -> Option<(&Show, u64)> {
        self.playing.and_then(|(_, trial)| Some((self.show()?, u64::from(trial) + 1)))
    }

    fn show(&self) -> Option<&Show> {
        self.subject.shows.get(self.playing?.0)
    }

    /// Takes what there is to know beside the rows.
    pub(crate) fn hear(&mut self, news: Told) {
        match news {
            Told::Place(place) => self.subject.place = place,
            Told::TrialEnded => self.ended.trials += 1,
            Told::Judged(Verdict::Pass) => self.ended.passed += 1,
            Told::Judged(Verdict::Fail) => self.ended.failed += 1,
            Told::Judged(Verdict::Inconclusive) => self.ended.inconclusive += 1,
        }
    }
}
