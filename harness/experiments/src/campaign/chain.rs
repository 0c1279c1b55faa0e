//! Runs chains of trials, in which the values of a trial depend on the scores of earlier trials.
//!
//! The points of a chain depend only on the campaign, the number of the chain and the scores.
//! Therefore a merge can repeat the chain from stored scores, without playing trials.

use crate::campaign::definition::{Campaign, Method};
use crate::campaign::draw::Trial;
use crate::campaign::error::CampaignError;
use crate::campaign::rare::{self, ChainEstimate};
use crate::campaign::search::search;
use std::ops::Range;

/// Largest number of moves towards the middle of the range if the scenario refuses a point.
const MAX_STEPS: u32 = 12;

impl Campaign {
    /// Calls `score` with points until it returns `None`. Only `rare` returns an estimate.
    pub(crate) fn run_chain(
        &self,
        trials: &Range<u64>,
        score: &mut dyn FnMut(&[f64]) -> Option<f64>,
    ) -> Option<ChainEstimate> {
        let chain = trials.start / self.chain_trials();
        let seed = self.seed.wrapping_add((chain + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let dimensions = self.variables.len();
        if self.method == Method::Rare {
            return rare::estimate(dimensions, seed, trials.end - trials.start, score);
        }
        search(dimensions, seed, score);
        None
    }

    /// For `rare`, `point` contains standard normal scores. For `search`, it contains positions
    /// from 0 to 1 in the ranges of the values.
    pub(crate) fn chain_trial(&self, number: u64, point: &[f64]) -> Result<Trial, CampaignError> {
        if self.method == Method::Rare {
            let scores = self.correlation.as_ref().map(|correlation| correlation.apply(point));
            let scores = scores.as_deref().unwrap_or(point);
            let values = self.variables.iter().zip(scores);
            let values = values.map(|(variable, score)| variable.distribution.at_score(*score)).collect();
            return self.trial_with(number, values, 0);
        }
        let mut point = point.to_vec();
        for step in 0.. {
            let values = self.variables.iter().zip(&point);
            let values = values.map(|(variable, share)| variable.distribution.at_share_of_range(*share)).collect();
            match self.trial_with(number, values, step) {
                Err(CampaignError::Trial { .. }) if step < MAX_STEPS => {}
                result => return result,
            }
            for (share, variable) in point.iter_mut().zip(&self.variables) {
                if variable.distribution.is_normal() {
                    *share = 0.5 + (*share - 0.5) * 0.7;
                }
            }
        }
        Err(CampaignError::Cancelled)
    }
}
