//! Plays a scenario with a controller and judges it in memory.

use platebench_engine::{Executor, ExecutorSettings, RunError, SafeEnds, ScenarioEnd};
use platebench_model::record::ViolationKind;
use platebench_model::scenario::Scenario;
use platebench_rig::{BoxedLink, CancelToken};
use platebench_verdict::Judgement;
use platebench_wire::LawId;
use std::collections::BTreeSet;
use std::ops::ControlFlow;

#[derive(Debug, thiserror::Error)]
pub enum TrustError {
    #[error("{file}: unknown law `{law}`")]
    UnknownLaw { file: String, law: String },
    #[error("{file}, {controller}: {source}")]
    Run { file: String, controller: String, source: Box<RunError> },
    #[error("internal error: a worker thread ended early; please report it")]
    Internal,
}

#[derive(Debug, Clone)]
pub struct PlayResult {
    pub judgement: Judgement,
    /// Violations of the protocol; each kind occurs at most once.
    pub violations: Vec<ViolationKind>,
}

/// Connects to a new controller.
pub type Connect<'a> = dyn Fn() -> BoxedLink + Send + Sync + 'a;

/// Plays trials in lockstep until the verdict is decided. Fails like [`play_as`].
pub fn play(scenario: &Scenario, controller: &str, connect: &Connect<'_>) -> Result<PlayResult, TrustError> {
    play_as(scenario, scenario, controller, connect)
}

/// Plays trials of `variant` and judges them by `scenario`; the two differ only in the spread of
/// the trials. Fails if the controller does not answer or no controller could accept the scenario. A trial with a lost
/// link is no error, and it is judged like the others.
pub fn play_as(
    scenario: &Scenario,
    variant: &Scenario,
    controller: &str,
    connect: &Connect<'_>,
) -> Result<PlayResult, TrustError> {
    let name = &scenario.controller.law;
    let law = LawId::from_name(name)
        .ok_or_else(|| TrustError::UnknownLaw { file: scenario.file.clone(), law: name.clone() })?;
    let (connect, ends) = (|| Ok(connect()), SafeEnds::default());
    let mut executor = Executor::new(&connect, ExecutorSettings::lockstep(&CancelToken::never()), &ends);
    let mut violations = BTreeSet::new();
    let end = executor.play_until_decided(scenario, variant, law, |trial| {
        violations.extend(trial.telemetry.violations.iter().map(|violation| violation.kind));
        ControlFlow::<()>::Continue(())
    });
    match end {
        Ok(ScenarioEnd::Judged(judgement)) => {
            Ok(PlayResult { judgement, violations: violations.into_iter().collect() })
        }
        Ok(ScenarioEnd::Stopped(()) | ScenarioEnd::Cancelled) => Err(TrustError::Internal),
        Err(error) => Err(TrustError::Run {
            file: scenario.file.clone(),
            controller: controller.to_owned(),
            source: Box::new(error),
        }),
    }
}
