//! Holds a recording and the scenario that configures the controller for its replay.

use platebench_model::scenario::Scenario;
use platebench_verdict::replay::Recording;

#[derive(Debug)]
pub struct ReplayInput {
    pub recording: Recording,
    pub scenario: Scenario,
}

impl ReplayInput {
    #[must_use]
    pub fn with_law(mut self, law: Option<&str>) -> Self {
        if let Some(name) = law {
            name.clone_into(&mut self.scenario.controller.law);
        }
        self
    }
}
