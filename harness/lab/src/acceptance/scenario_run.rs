//! Plays one scenario of a session into its own run folder.

use crate::acceptance::config::SessionHooks;
use crate::acceptance::error::AcceptError;
use platebench_engine::{Clock, RunError, RunHooks, RunPlan, rejudge, run};
use platebench_model::record::{Overrides, RunFolder, RunRecord};
use platebench_model::scenario::Scenario;
use platebench_rig::{ConnectOptions, RigSpec};
use std::path::Path;

pub(crate) struct ScenarioRun<'a> {
    pub(crate) scenario: &'a Scenario,
    pub(crate) trials: u32,
    pub(crate) rig: &'a RigSpec,
    pub(crate) clock: Clock,
    pub(crate) jobs: usize,
}

impl ScenarioRun<'_> {
    pub(crate) fn play(&self, folder: &Path, hooks: &mut SessionHooks<'_>) -> Result<RunRecord, AcceptError> {
        let overrides = Overrides { trials: Some(self.trials), ..Overrides::default() };
        let mut scenario = self.scenario.clone();
        rejudge::apply_overrides(&overrides, &mut scenario);
        let plan = RunPlan::new(self.rig, self.clock, self.jobs, vec![scenario], overrides);
        let folder = RunFolder::create(Some(folder)).map_err(RunError::from)?;
        let options = ConnectOptions { cancel: hooks.cancel.clone(), ..ConnectOptions::default() };
        let run_hooks = RunHooks {
            cancel: hooks.cancel.clone(),
            live_tap: hooks.observer.live_tap(&plan),
            on_event: Box::new(|event| hooks.observer.run_event(&event)),
            ..RunHooks::default()
        };
        run(&plan, &folder, &|| self.clock.connect(self.rig, &options), run_hooks).map_err(|error| match error {
            RunError::Cancelled => AcceptError::Cancelled,
            error => error.into(),
        })
    }
}
