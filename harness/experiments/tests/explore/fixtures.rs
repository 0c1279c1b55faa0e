//! Provides the envelope of the repository and explorations of it, and judges an own law.

use platebench_engine::{Executor, ExecutorSettings, SafeEnds, law};
use platebench_experiments::explore::{Envelope, ExplorationBudget, ExploreConfig, ExploredLaw};
use platebench_experiments::trust::{Mutant, MutantController};
use platebench_model::scenario::OWN_LAW;
use platebench_rig::{BoxedLink, CancelToken, HostedLink};
use platebench_test_kit::{load_scenario, scenario_path};
use platebench_verdict::{Judgement, judge, measure};
use platebench_wire::LawId;
use std::collections::BTreeSet;
use std::path::PathBuf;

pub(crate) fn envelope_path() -> PathBuf {
    scenario_path("envelope.toml")
}

pub(crate) fn configuration(law: impl Into<ExploredLaw>, scenes: u64) -> ExploreConfig {
    ExploreConfig {
        envelope: Envelope::load(&envelope_path()).unwrap(),
        seed: 1,
        law: law.into(),
        laws: vec![LawId::DqPi, LawId::Deadbeat, LawId::DqPiFixed],
        budget: ExplorationBudget::Scenes(scenes),
        max_failed: 10,
        jobs: 2,
        own_clock: false,
        compares_reference: false,
        regressions: Vec::new(),
        sequences: None,
        has_endurance: true,
        is_guided: false,
        branch_outcomes: BTreeSet::new(),
    }
}

/// Plays a scenario of the repository with an own law.
pub(crate) fn judge_own_law(file: &str, build: fn() -> Box<dyn Mutant>) -> Judgement {
    let mut scenario = load_scenario(file);
    scenario.set_law(OWN_LAW);
    let connect = || Ok(Box::new(MutantController::new(HostedLink::new(), build)) as BoxedLink);
    let (cancel, ends) = (CancelToken::never(), SafeEnds::default());
    let mut executor = Executor::new(&connect, ExecutorSettings::lockstep(&cancel), &ends);
    let played = executor.play(&scenario, law(&scenario).unwrap(), 0, None).unwrap().unwrap();
    judge(&scenario, &[measure(&scenario, 0, &played.trace_rows, &played.telemetry)])
}
