//! Plays trials of charts, and runs whose processor time is measured.

use crate::cost::process_cpu_time;
use crate::error::ChartError;
use platebench_engine::{Clock, RunHooks, RunPlan, TrialResult, lockstep, run};
use platebench_model::record::{Overrides, RunFolder, RunRecord};
use platebench_model::scenario::Scenario;
use platebench_rig::{ConnectOptions, RigSpec};
use platebench_wire::LawId;

pub(crate) const LOCKSTEP: Clock = Clock::Lockstep { wire_time: false };

pub(crate) struct MeasuredRun {
    pub(crate) record: RunRecord,
    /// Processor time of the whole run per control period, including trace and child processes.
    pub(crate) period_us: f64,
}

impl MeasuredRun {
    pub(crate) fn play(scenarios: Vec<Scenario>, rig: &RigSpec, clock: Clock) -> Result<Self, ChartError> {
        let temporary = tempfile::tempdir()?;
        let folder = RunFolder::create(Some(&temporary.path().join("run")))?;
        let plan = RunPlan::new(rig, clock, 1, scenarios, Overrides::default());
        let connect = || clock.connect(rig, &ConnectOptions::default());
        let started = process_cpu_time();
        let record = run(&plan, &folder, &connect, RunHooks::default())?;
        let elapsed_us = process_cpu_time().saturating_sub(started).as_secs_f64() * 1e6;
        let periods = |scenario: &Scenario| scenario.duration.seconds() / scenario.controller.period.seconds();
        let trials = |scenario: &Scenario| {
            record.scenarios.iter().find(|played| played.file == scenario.file).map_or(0, |played| played.trials.len())
        };
        let count: f64 = plan.scenarios.iter().map(|scenario| periods(scenario) * trials(scenario) as f64).sum();
        Ok(Self { record, period_us: elapsed_us / count })
    }
}

pub(crate) fn play_hosted(what: &str, scenario: &Scenario, law: LawId, index: u32) -> Result<TrialResult, ChartError> {
    let lost = |source| ChartError::Lost { what: what.to_owned(), source };
    let mut played = lockstep::play_hosted(scenario, law, index).map_err(lost)?;
    played.link_error.take().map_or(Ok(played), |error| Err(lost(error)))
}
