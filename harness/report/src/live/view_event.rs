//! Defines the events that the view shows.

use platebench_engine::Event;
use platebench_model::record::Verdict;

#[derive(Debug)]
pub enum ViewEvent {
    RigLocation(String),
    TrialFinished,
    ScenarioFinished(Verdict),
}

impl ViewEvent {
    pub fn of(event: &Event) -> Option<Self> {
        match event {
            Event::ScenarioStarted { .. } => None,
            Event::TrialFinished { .. } => Some(Self::TrialFinished),
            Event::ScenarioFinished(scenario) => Some(Self::ScenarioFinished(scenario.verdict)),
        }
    }
}
