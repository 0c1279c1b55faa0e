//! A scenario played to a controller and judged, in memory: what a run does, without its folder.

use platebench_rig::{AnyLink, Faulty, RigError, Session};
use platebench_runner::Cancel;
use platebench_runner::trial::{self, Order};
use platebench_scenario::Scenario;
use platebench_verdict::{Decision, Judgement, measure, sequential};
use platebench_wire::LawId;

/// Why there is no verdict at all.
#[derive(Debug, thiserror::Error)]
pub enum TrustError {
    /// A scenario asks for a law that there is not.
    #[error("{file}: unknown law `{law}`")]
    Law {
        /// The scenario.
        file: String,
        /// What it asks for.
        law: String,
    },
    /// The controller cannot be worked with.
    #[error("{file}, {controller}: {source}")]
    Rig {
        /// The scenario.
        file: String,
        /// Who was to play it.
        controller: String,
        /// What happened.
        source: RigError,
    },
    /// A worker came to grief: a fault of the bench itself.
    #[error("the bench has a fault of its own, please report it: a worker ended early")]
    Bench,
}

/// Plays trials of `scenario` over a link in lockstep until it is decided.
///
/// # Errors
/// As [`play_as`].
pub fn play(scenario: &Scenario, controller: &str, link: AnyLink) -> Result<Judgement, TrustError> {
    play_as(scenario, scenario, controller, link)
}

/// Plays trials of `scene` and judges them as those of `scenario`, which is the same but for what is left to chance: a plate that is a little off is judged
/// as hard as the nominal one.
///
/// # Errors
/// [`TrustError`] where the controller does not answer or refuses the scenario. One that is lost within a trial is judged.
pub fn play_as(
    scenario: &Scenario,
    scene: &Scenario,
    controller: &str,
    link: AnyLink,
) -> Result<Judgement, TrustError> {
    let name = &scenario.controller.law;
    let law =
        LawId::from_name(name).ok_or_else(|| TrustError::Law { file: scenario.file.clone(), law: name.clone() })?;
    let failed = |source| TrustError::Rig { file: scenario.file.clone(), controller: controller.to_owned(), source };
    let mut session = Session::open(Faulty::new(link)).map_err(failed)?;
    let mut trials = Vec::new();
    loop {
        let goal = match sequential(scenario, &trials) {
            Decision::Stop(judgement) => return Ok(judgement),
            Decision::Go { trials } => trials,
        };
        for index in trials.len() as u32..goal {
            let order = Order { scenario: scene, law, index, wire_time: false, own_clock: false };
            let Some(played) = trial::play(&mut session, &order, &Cancel::default()) else {
                return Err(TrustError::Bench);
            };
            if let Some(refused @ RigError::Refused(_)) = played.lost {
                return Err(failed(refused));
            }
            trials.push(measure(scene, index, &played.rows, &played.telemetry));
        }
    }
}
