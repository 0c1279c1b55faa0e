//! Which trials are judged, and whether more are needed.
//!
//! A scenario with `max_count` is looked at after `count` trials, after twice as many and so on; [`spending`](crate::statistics::spending) says how that is
//! paid for. Which looks there are depends on the scenario alone and what is decided at each on the trials up to there, so that a stored run is judged at the
//! same look as it was live, whatever the order in which its trials were played.

use super::case::Case;
use super::{Judgement, TrialMeasures};
use crate::record::{Cause, ExpectationRecord, Verdict};
use crate::statistics::spending::{Look, looks};
use platebench_scenario::Scenario;
use std::borrow::Cow;

/// What to do after the trials that there are.
#[derive(Debug, Clone, PartialEq)]
pub enum Decision {
    /// This is the verdict; further trials would not be looked at.
    Stop(Judgement),
    /// Play on until there are so many trials.
    Go {
        /// How many, those that there are included.
        trials: u32,
    },
}

/// Judges a scenario by its trials at the first planned look that decides, or says how many trials the next look needs.
///
/// A look decides where every expectation passes, where one fails, or where one is in doubt for a reason that no further trial takes away. The last one
/// decides whatever comes.
pub fn sequential(scenario: &Scenario, trials: &[TrialMeasures]) -> Decision {
    match decided(scenario, &in_order(trials)) {
        Ok(judgement) => Decision::Stop(judgement),
        Err(next) => Decision::Go { trials: next.trials },
    }
}

/// Judges a scenario by its trials, whether all of them are there or not.
pub fn judge(scenario: &Scenario, trials: &[TrialMeasures]) -> Judgement {
    let trials = in_order(trials);
    decided(scenario, &trials).unwrap_or_else(|next| at_look(scenario, &trials, next))
}

/// The judgement of the first look that decides, or else the first look for which there are too few trials.
fn decided(scenario: &Scenario, trials: &[TrialMeasures]) -> Result<Judgement, Look> {
    let mut planned = looks(scenario.trials.count, scenario.trials.max_count).into_iter().peekable();
    loop {
        let Some(look) = planned.next() else { return Ok(at_look(scenario, trials, Look::ONLY)) };
        let played = trials.partition_point(|trial| trial.index < look.trials);
        if played < look.trials as usize {
            return Err(look);
        }
        let judgement = at_look(scenario, trials.get(..played).unwrap_or(trials), look);
        if planned.peek().is_none() || is_settled(&judgement) {
            return Ok(judgement);
        }
    }
}

/// True where further trials would change nothing.
fn is_settled(judgement: &Judgement) -> bool {
    let hopeless = |found: &ExpectationRecord| match found.verdict {
        Verdict::Pass => false,
        Verdict::Fail => true,
        Verdict::Inconclusive => found.cause != Some(Cause::Evidence),
    };
    judgement.verdict == Verdict::Pass || judgement.expectations.iter().any(hopeless)
}

fn at_look(scenario: &Scenario, trials: &[TrialMeasures], look: Look) -> Judgement {
    let expectations: Vec<_> = (0..)
        .zip(&scenario.expectations)
        .map(|(number, expectation)| Case { scenario, expectation, number, trials, look }.judge())
        .collect();
    Judgement { verdict: Verdict::over(expectations.iter().map(|expectation| expectation.verdict)), expectations }
}

fn in_order(trials: &[TrialMeasures]) -> Cow<'_, [TrialMeasures]> {
    if trials.is_sorted_by_key(|trial| trial.index) {
        return Cow::Borrowed(trials);
    }
    let mut ordered = trials.to_vec();
    ordered.sort_by_key(|trial| trial.index);
    Cow::Owned(ordered)
}
