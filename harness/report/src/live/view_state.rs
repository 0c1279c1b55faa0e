//! Holds what the view draws.

use crate::live::run_description::{RunDescription, ScenarioDescription};
use crate::live::signal_history::SignalHistory;
use crate::live::view_event::ViewEvent;
use platebench_engine::live_tap::{TapCounts, TapRow};
use platebench_model::record::Verdict;
use platebench_model::trace::Row;

#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct FinishedCounts {
    pub(crate) trials: u64,
    pub(crate) passed: usize,
    pub(crate) failed: usize,
    pub(crate) inconclusive: usize,
}

#[derive(Debug)]
pub(crate) struct ViewState {
    pub(crate) run: RunDescription,
    /// Indices of scenario and trial.
    newest_trial: Option<(usize, u32)>,
    pub(crate) newest_row: Option<Row>,
    pub(crate) history: SignalHistory,
    pub(crate) counts: TapCounts,
    pub(crate) finished: FinishedCounts,
    pub(crate) messages: Vec<String>,
}

impl ViewState {
    pub(crate) fn new(run: RunDescription) -> Self {
        Self {
            run,
            newest_trial: None,
            newest_row: None,
            history: SignalHistory::new(1.0, 1.0),
            counts: TapCounts::default(),
            finished: FinishedCounts::default(),
            messages: Vec::new(),
        }
    }

    /// A row of another trial, or with an earlier time, starts a new history.
    pub(crate) fn add_row(&mut self, tap_row: &TapRow) {
        let playing = Some((tap_row.scenario, tap_row.trial));
        let is_new = self.newest_trial != playing || self.newest_row.is_none_or(|newest| newest.t_s > tap_row.row.t_s);
        self.newest_trial = playing;
        self.newest_row = Some(tap_row.row);
        if is_new && let Some(scenario) = self.current_scenario() {
            self.history = SignalHistory::new(scenario.window_s(), scenario.spacing_s);
        }
        self.history.push(&tap_row.row);
    }

    pub(crate) fn current_trial(&self) -> Option<(&ScenarioDescription, u64)> {
        self.newest_trial.and_then(|(_, trial)| Some((self.current_scenario()?, u64::from(trial) + 1)))
    }

    fn current_scenario(&self) -> Option<&ScenarioDescription> {
        self.run.scenarios.get(self.newest_trial?.0)
    }

    pub(crate) fn apply_event(&mut self, event: ViewEvent) {
        match event {
            ViewEvent::RigLocation(location) => self.run.rig = location,
            ViewEvent::TrialFinished => self.finished.trials += 1,
            ViewEvent::ScenarioFinished(Verdict::Pass) => self.finished.passed += 1,
            ViewEvent::ScenarioFinished(Verdict::Fail) => self.finished.failed += 1,
            ViewEvent::ScenarioFinished(Verdict::Inconclusive) => self.finished.inconclusive += 1,
        }
    }
}
