//! Plays a scenario with a controller and judges it in memory.

use platebench_record::ViolationKind;
use platebench_rig::{BoxedLink, FaultInjector, RigError, Session};
use platebench_runner::CancelToken;
use platebench_runner::trial::{self, TrialSpec};
use platebench_scenario::Scenario;
use platebench_verdict::{Judgement, SequentialDecision, judge_sequentially, measure};
use platebench_wire::LawId;
use std::collections::BTreeSet;

#[derive(Debug, thiserror::Error)]
pub enum TrustError {
    #[error("{file}: unknown law `{law}`")]
    UnknownLaw { file: String, law: String },
    #[error("{file}, {controller}: {source}")]
    Rig { file: String, controller: String, source: RigError },
    #[error("internal error: a worker thread ended early; please report it")]
    Internal,
}

#[derive(Debug, Clone)]
pub struct PlayResult {
    pub judgement: Judgement,
    /// Violations of the protocol; each kind occurs at most once.
    pub violations: Vec<ViolationKind>,
}

/// Plays trials in lockstep until the verdict is decided. Fails like [`play_as`].
pub fn play(scenario: &Scenario, controller: &str, link: BoxedLink) -> Result<PlayResult, TrustError> {
    play_as(scenario, scenario, controller, link)
}

/// Plays trials of `variant` and judges them by `scenario`; the two differ only in the spread of
/// the trials. Fails if the controller does not answer or rejects the scenario. A trial with a lost
/// link is no error, and it is judged like the others.
pub fn play_as(
    scenario: &Scenario,
    variant: &Scenario,
    controller: &str,
    link: BoxedLink,
) -> Result<PlayResult, TrustError> {
    let name = &scenario.controller.law;
    let law = LawId::from_name(name)
        .ok_or_else(|| TrustError::UnknownLaw { file: scenario.file.clone(), law: name.clone() })?;
    let failed = |source| TrustError::Rig { file: scenario.file.clone(), controller: controller.to_owned(), source };
    let mut session = Session::open(FaultInjector::new(link)).map_err(failed)?;
    let (mut trials, mut violations) = (Vec::new(), BTreeSet::new());
    loop {
        let goal = match judge_sequentially(scenario, &trials) {
            SequentialDecision::Stop(judgement) => {
                return Ok(PlayResult { judgement, violations: violations.into_iter().collect() });
            }
            SequentialDecision::Continue { trials } => trials,
        };
        for index in trials.len() as u32..goal {
            let spec = TrialSpec::new(variant, law, index);
            let Some(result) = trial::play(&mut session, &spec, &CancelToken::never(), None) else {
                return Err(TrustError::Internal);
            };
            if let Some(rejected @ RigError::ConfigurationRejected(_)) = result.link_error {
                return Err(failed(rejected));
            }
            violations.extend(result.telemetry.violations.iter().map(|violation| violation.kind));
            trials.push(measure(variant, index, &result.trace_rows, &result.telemetry));
        }
    }
}
