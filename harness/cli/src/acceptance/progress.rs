//! Shows the progress of a session.

use crate::live::SessionView;
use crate::stdio;
use platebench_engine::{Event, LiveTap, RunPlan};
use platebench_lab::acceptance::SessionObserver;
use platebench_lab::acceptance::session_record::{StepKind, StepRecord};
use platebench_report::format::count;
use platebench_report::{Progress, ProgressKind};

pub(crate) struct SessionProgress {
    kind: ProgressKind,
    progress: Option<Progress>,
    is_self_test: bool,
    live_view: SessionView,
}

impl SessionProgress {
    pub(crate) fn new(kind: ProgressKind, live_view: SessionView) -> Self {
        Self { kind, progress: None, is_self_test: false, live_view }
    }

    fn print(&self, text: &str) {
        if self.kind != ProgressKind::Quiet {
            stdio::note(text);
        }
    }
}

impl SessionObserver for SessionProgress {
    fn step_started(&mut self, step: &StepRecord) {
        // A progress bar would overwrite the question that the prompt shows.
        if step.kind == StepKind::Ask {
            return;
        }
        self.print(&format!("{}  {}", step.id, step.title));
        self.progress = Some(Progress::new(self.kind).with_elapsed_time(&step.title));
        self.is_self_test = step.kind == StepKind::SelfTest;
    }

    fn step_ended(&mut self, step: &StepRecord) {
        self.live_view.close();
        if let Some(mut progress) = self.progress.take() {
            progress.finish();
        }
        let is_answered = step.answer.as_ref().is_none_or(|answer| answer.text.is_some());
        let verdict = step.verdict.map_or(if is_answered { "done" } else { "no answer" }, |verdict| verdict.name());
        let reason = step.reason.as_deref().map_or_else(String::new, |reason| format!(", {reason}"));
        self.print(&format!("{}  {verdict}{reason}", step.id));
    }

    fn live_tap(&mut self, plan: &RunPlan) -> LiveTap {
        let live_tap = if self.is_self_test { None } else { self.live_view.open(plan) };
        if live_tap.is_some() {
            self.progress = None;
        }
        live_tap.unwrap_or_default()
    }

    fn run_event(&mut self, event: &Event) {
        self.live_view.send(event);
        let Some(progress) = &mut self.progress else { return };
        match event {
            // The self-test measures the bench, so the scenario's verdict does not count.
            Event::ScenarioFinished(scenario) if self.is_self_test => {
                progress.finish();
                self.progress = Some(Progress::new(self.kind));
                self.print(&format!(
                    "  {} measured in {}, not judged",
                    scenario.file,
                    count(scenario.trial_count, "trial")
                ));
            }
            event => progress.show(event),
        }
    }
}
