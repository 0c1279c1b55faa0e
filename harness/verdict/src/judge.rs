//! Judges the expectations of a scenario by its trials.
//!
//! A look is an evaluation of the trials so far. A scenario with `max_count` has looks after
//! `count` trials, after twice as many and so on. The looks depend on the scenario alone, and a
//! decision depends on the trials up to its look. Therefore a stored run gets the same verdict as
//! the live run, for any order of play.

mod expectation_judge;
mod outcome;
mod over_trials;

use crate::statistics::alpha_spending::{Look, plan_looks};
use crate::trial::TrialMeasures;
use expectation_judge::ExpectationJudge;
use platebench_model::record::{Cause, ExpectationRecord, Verdict};
use platebench_model::scenario::Scenario;
use std::borrow::Cow;

#[derive(Debug, Clone, PartialEq)]
pub struct Judgement {
    pub verdict: Verdict,
    pub expectations: Vec<ExpectationRecord>,
}

#[derive(Debug, Clone, PartialEq)]
pub enum SequentialDecision {
    /// More trials cannot change the judgement.
    Stop(Judgement),
    Continue {
        /// Number of trials at the next look, including those already played.
        trials: u32,
    },
}

/// A look decides if every expectation passes, one fails, or one is inconclusive and more trials
/// cannot change that. The last look always decides.
pub fn judge_sequentially(scenario: &Scenario, trials: &[TrialMeasures]) -> SequentialDecision {
    match judge_at_deciding_look(scenario, &sorted_by_index(trials)) {
        Ok(judgement) => SequentialDecision::Stop(judgement),
        Err(next) => SequentialDecision::Continue { trials: next.trials },
    }
}

pub fn judge(scenario: &Scenario, trials: &[TrialMeasures]) -> Judgement {
    let trials = sorted_by_index(trials);
    judge_at_deciding_look(scenario, &trials).unwrap_or_else(|next| judge_at_look(scenario, &trials, next))
}

fn judge_at_deciding_look(scenario: &Scenario, trials: &[TrialMeasures]) -> Result<Judgement, Look> {
    let mut planned = plan_looks(scenario.trials.count, scenario.trials.max_count).into_iter().peekable();
    loop {
        let Some(look) = planned.next() else { return Ok(judge_at_look(scenario, trials, Look::SINGLE)) };
        let played = trials.partition_point(|trial| trial.index < look.trials);
        if played < look.trials as usize {
            return Err(look);
        }
        let judgement = judge_at_look(scenario, trials.get(..played).unwrap_or(trials), look);
        if planned.peek().is_none() || is_final(&judgement) {
            return Ok(judgement);
        }
    }
}

fn is_final(judgement: &Judgement) -> bool {
    let is_decided = |expectation: &ExpectationRecord| match expectation.verdict {
        Verdict::Pass => false,
        Verdict::Fail => true,
        Verdict::Inconclusive => expectation.cause != Some(Cause::Evidence),
    };
    judgement.verdict == Verdict::Pass || judgement.expectations.iter().any(is_decided)
}

fn judge_at_look(scenario: &Scenario, trials: &[TrialMeasures], look: Look) -> Judgement {
    let judge = |(expectation_index, expectation)| {
        ExpectationJudge { scenario, expectation, expectation_index, trials, look }.judge()
    };
    let expectations: Vec<_> = scenario.expectations.iter().enumerate().map(judge).collect();
    Judgement { verdict: Verdict::combine(expectations.iter().map(|expectation| expectation.verdict)), expectations }
}

fn sorted_by_index(trials: &[TrialMeasures]) -> Cow<'_, [TrialMeasures]> {
    if trials.is_sorted_by_key(|trial| trial.index) {
        return Cow::Borrowed(trials);
    }
    let mut sorted = trials.to_vec();
    sorted.sort_by_key(|trial| trial.index);
    Cow::Owned(sorted)
}

#[cfg(test)]
mod tests;
