//! Defines the events that the view shows.

use platebench_record::Verdict;
use platebench_runner::Event;

/// Events for the view; rows arrive through the tap.
#[derive(Debug)]
pub enum ViewEvent {
    /// Port or address of the controller.
    RigLocation(String),
    /// A trial has ended.
    TrialFinished,
    /// A scenario was judged.
    ScenarioFinished(Verdict),
}

impl ViewEvent {
    /// The part of a run event that the view shows.
    pub fn of(event: &Event) -> Option<Self> {
        match event {
            Event::ScenarioStarted { .. } => None,
            Event::TrialFinished { .. } => Some(Self::TrialFinished),
            Event::ScenarioFinished(record) => Some(Self::ScenarioFinished(record.verdict)),
        }
    }
}
