//! Defines the result of a trial.

use crate::campaign::definition::Campaign;
use crate::campaign::draw::Trial;
use crate::campaign::error::CampaignError;
use platebench_model::record::{Cause, Verdict};
use platebench_model::scenario::Expectation;
use platebench_verdict::{Judgement, TrialMeasures, judge};

const VERDICTS: [Verdict; 3] = [Verdict::Pass, Verdict::Fail, Verdict::Inconclusive];
pub(crate) const CAUSES: [Cause; 4] = [Cause::Rig, Cause::Bench, Cause::Infeasible, Cause::Evidence];
/// The columns verdict, cause, redraws and score.
const FIXED_COLUMNS: usize = 4;
/// Score of a trial without a finite margin, before its distance from the setpoint is subtracted.
/// Only the order of scores matters.
const NO_VALUE_SCORE: f64 = -1e3;
const MAX_DISTANCE: f64 = 1e3;
const SMALLEST_SCORE: f64 = 1e-12;
/// Other computers may round a margin differently.
const MARGIN_ROUNDING: f64 = 1e-9;
const EXPECT_PREFIX: &str = "expect.";

#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    pub trial: u64,
    /// Drawn values, as in [`Trial::values`].
    pub draws: Vec<f64>,
    /// One value per expectation; NaN if the trial has no value.
    pub values: Vec<f64>,
    /// One margin per expectation; negative infinity if the trial has no value.
    pub margins: Vec<f64>,
    pub verdict: Verdict,
    pub cause: Option<Cause>,
    pub redraws: u32,
    /// The smallest margin as a finite number. Negative if the trial fails, otherwise positive.
    pub score: f64,
}

impl Row {
    /// `distance` is the relative distance from the setpoint at the end of the trial.
    pub(crate) fn new(trial: &Trial, measures: TrialMeasures, distance: f64) -> Self {
        let Judgement { verdict, expectations } = judge(&trial.scenario, &[measures]);
        let undecided = expectations.iter().filter(|expectation| expectation.verdict == Verdict::Inconclusive);
        let margins = expectations.iter().map(|expectation| expectation.margin);
        let score = margins.map(|margin| {
            let distance = if distance.is_finite() { distance.min(MAX_DISTANCE) } else { MAX_DISTANCE };
            margin.filter(|margin| margin.is_finite()).unwrap_or(NO_VALUE_SCORE - distance)
        });
        let score = score.fold(MAX_DISTANCE, f64::min);
        let is_failure = verdict == Verdict::Fail;
        Self {
            trial: trial.number,
            draws: trial.values.clone(),
            values: expectations.iter().map(|expectation| expectation.value.unwrap_or(f64::NAN)).collect(),
            margins: expectations.iter().map(|expectation| expectation.margin.unwrap_or(f64::NEG_INFINITY)).collect(),
            verdict,
            cause: undecided.filter(|_| verdict == Verdict::Inconclusive).find_map(|expectation| expectation.cause),
            redraws: trial.redraws,
            score: if is_failure { score.min(-SMALLEST_SCORE) } else { score.max(SMALLEST_SCORE) },
        }
    }

    /// Smallest margin of all expectations.
    pub fn margin(&self) -> f64 {
        self.margins.iter().copied().fold(f64::INFINITY, f64::min)
    }

    pub(crate) fn trial_in(&self, campaign: &Campaign) -> Result<Trial, CampaignError> {
        campaign.trial_with(self.trial, self.draws.clone(), self.redraws)
    }

    /// False if a margin is not the one of its value, or if the row passes with a negative margin.
    pub(crate) fn agrees_with_limits(&self, campaign: &Campaign) -> Result<bool, CampaignError> {
        // Limits can be varied, so they may belong to the trial.
        let varied = campaign.variables.iter().any(|variable| variable.key.starts_with(EXPECT_PREFIX));
        let own = varied.then(|| self.trial_in(campaign)).transpose()?;
        let scenario = own.as_ref().map_or(&campaign.template.scenario, |trial| &trial.scenario);
        let agrees = |((expectation, value), found): ((&Expectation, &f64), &f64)| {
            let margin = expectation.margin(*value);
            let expected = margin.filter(|margin| margin.is_finite()).unwrap_or(f64::NEG_INFINITY);
            let is_equal = *found == expected || (found - expected).abs() <= MARGIN_ROUNDING * expected.abs().max(1.0);
            is_equal && !(self.verdict == Verdict::Pass && margin.is_some() && expected < -MARGIN_ROUNDING)
        };
        Ok(scenario.expectations.iter().zip(&self.values).zip(&self.margins).all(agrees))
    }

    pub(crate) const fn column_count(variables: usize, expectations: usize) -> usize {
        variables + 2 * expectations + FIXED_COLUMNS
    }

    pub(crate) fn encode(&self) -> impl Iterator<Item = f64> {
        let verdict = VERDICTS.iter().position(|verdict| *verdict == self.verdict).unwrap_or_default();
        let cause = CAUSES.iter().position(|cause| Some(*cause) == self.cause).map_or(0, |position| position + 1);
        let fixed = [verdict as f64, cause as f64, f64::from(self.redraws), self.score];
        self.draws.iter().chain(&self.values).chain(&self.margins).copied().chain(fixed)
    }

    pub(crate) fn decode(trial: u64, columns: &[f64], variables: usize) -> Option<Self> {
        let expectations = columns.len().checked_sub(variables + FIXED_COLUMNS)? / 2;
        let (draws, rest) = columns.split_at_checked(variables)?;
        let (values, rest) = rest.split_at_checked(expectations)?;
        let (margins, rest) = rest.split_at_checked(expectations)?;
        let [verdict, cause, redraws, score] = *rest else { return None };
        Some(Self {
            trial,
            draws: draws.to_vec(),
            values: values.to_vec(),
            margins: margins.to_vec(),
            verdict: *VERDICTS.get(verdict as usize)?,
            cause: (cause as usize).checked_sub(1).and_then(|position| CAUSES.get(position)).copied(),
            redraws: redraws as u32,
            score,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Row {
        pub(crate) fn example(trial: u64, verdict: Verdict, margin: f64) -> Self {
            let (draws, values, margins) = (vec![trial as f64], Vec::new(), vec![margin]);
            Self { trial, draws, values, margins, verdict, cause: None, redraws: 0, score: margin }
        }
    }

    #[test]
    fn a_row_survives_its_part() {
        let row = Row {
            trial: 7,
            draws: vec![1.0, 0.25],
            values: vec![1.5],
            margins: vec![f64::NEG_INFINITY],
            verdict: Verdict::Inconclusive,
            cause: Some(Cause::Infeasible),
            redraws: 2,
            score: -1_000.5,
        };
        let columns: Vec<f64> = row.encode().collect();
        assert_eq!(columns.len(), Row::column_count(2, 1));
        assert_eq!(Row::decode(7, &columns, 2), Some(row));
        assert_eq!(Row::decode(7, &columns[..columns.len() - 1], 2), None);
    }
}
