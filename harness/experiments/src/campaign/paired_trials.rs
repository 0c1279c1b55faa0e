//! Plays a trial again with one of its imperfections removed. The difference of the values is the
//! error that the imperfection causes, for any controller.
//!
//! Converters: each trial is played once more without them. Noise of the sensor: the trials with the
//! same listed values share pairs of trials, with and without noise, and the standard deviation of
//! their differences. The pairs depend only on the campaign and the listed values.

use crate::campaign::definition::Campaign;
use crate::campaign::draw::DrawnTrial;
use crate::campaign::error::CampaignError;
use platebench_engine::{Executor, law};
use platebench_model::scenario::Scenario;
use platebench_plate::{Amplifier, Effects, Lockin, Plate, Time};
use platebench_verdict::uncertainty::TypeA;
use platebench_verdict::{TrialMeasures, judge, measure};
use std::collections::HashMap;
use std::ops::RangeInclusive;
use std::sync::{Arc, Mutex, PoisonError};

/// Numbers of pairs with and without noise. The largest is for values with a long tail, such as an
/// overshoot near 0.
const PAIRS: RangeInclusive<u64> = 32..=128;
/// Relative standard error of the standard deviations at which no more pairs are played. A factor of
/// 1.5 is then 3.5 standard errors.
const MAX_RELATIVE_ERROR: f64 = 0.115;
/// A standard deviation of fewer differences is unknown.
const MIN_DIFFERENCES: usize = 8;

/// Errors of the values of a trial, one per expectation, in its unit; NaN if one is unknown.
#[derive(Debug, Clone, Default)]
pub(crate) struct PairedErrors {
    /// `None` without converters.
    pub(crate) quantisation: Option<Vec<f64>>,
    /// Standard deviation by the noise of the sensor; `None` without noise.
    pub(crate) noise: Option<Vec<f64>>,
}

pub(crate) struct PairedTrials<'a> {
    campaign: &'a Campaign,
    /// Standard deviations per µm of noise, by the number of the listed values.
    scatter: Mutex<HashMap<usize, Arc<[f64]>>>,
}

impl<'a> PairedTrials<'a> {
    pub(crate) fn new(campaign: &'a Campaign) -> Self {
        Self { campaign, scatter: Mutex::default() }
    }

    /// `values` are those of `trial`, which was played.
    pub(crate) fn errors(
        &self,
        executor: &mut Executor<'_>,
        trial: &DrawnTrial,
        values: &[f64],
    ) -> Result<PairedErrors, CampaignError> {
        let mut errors = PairedErrors::default();
        let plate = without_converters(&trial.scenario.plate);
        if plate != trial.scenario.plate {
            let exact = play(executor, &Scenario { plate, ..trial.scenario.clone() })?;
            let difference = |(value, exact): (&f64, f64)| (value - exact).abs();
            errors.quantisation = exact.map(|exact| values.iter().zip(exact).map(difference).collect());
        }
        let noise = trial.scenario.plate.noise_um_rms;
        if noise > 0.0 {
            let scatter = self.scatter(executor, trial)?;
            errors.noise = scatter.map(|scatter| scatter.iter().map(|per_um| per_um * noise).collect());
        }
        Ok(errors)
    }

    /// `None` if the campaign was cancelled.
    fn scatter(&self, executor: &mut Executor<'_>, trial: &DrawnTrial) -> Result<Option<Arc<[f64]>>, CampaignError> {
        let cell = self.campaign.cell(&trial.values);
        let known = || self.scatter.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(scatter) = known().get(&cell) {
            return Ok(Some(Arc::clone(scatter)));
        }
        // Two workers may play the same pairs, which gives the same result twice.
        let Some(differences) = self.play_pairs(executor, trial)? else { return Ok(None) };
        let scatter = differences.iter().map(|differences| {
            let known: Vec<f64> = differences.iter().copied().filter(|difference| difference.is_finite()).collect();
            let spread = TypeA::of_single(&known).filter(|_| known.len() >= MIN_DIFFERENCES);
            spread.map_or(f64::NAN, |spread| spread.standard)
        });
        let scatter: Arc<[f64]> = scatter.collect();
        known().insert(cell, Arc::clone(&scatter));
        Ok(Some(scatter))
    }

    /// Differences of each value per µm of noise.
    fn play_pairs(
        &self,
        executor: &mut Executor<'_>,
        trial: &DrawnTrial,
    ) -> Result<Option<Vec<Vec<f64>>>, CampaignError> {
        let mut differences = vec![Vec::new(); trial.scenario.expectations.len()];
        let mut last: Option<(Vec<f64>, Vec<f64>)> = None;
        for place in 0..*PAIRS.end() {
            if place >= *PAIRS.start() && differences.iter().all(|differences| is_precise(differences)) {
                break;
            }
            let reference = match self.campaign.reference_trial(trial, place) {
                Ok(reference) => reference,
                // The scenario refuses the drawn values.
                Err(CampaignError::Trial { .. }) => continue,
                Err(error) => return Err(error),
            };
            let DrawnTrial { scenario, values: draws, .. } = reference;
            let noise = scenario.plate.noise_um_rms;
            if noise <= 0.0 {
                continue;
            }
            // The seed also determines the jitter of the delay.
            let is_same = scenario.controller.loop_delay_jitter == Time::ZERO;
            let exact = if let Some((_, exact)) = last.take_if(|(known, _)| is_same && *known == draws) {
                exact
            } else {
                let plate = Plate { noise_um_rms: 0.0, ..scenario.plate.clone() };
                let Some(exact) = play(executor, &Scenario { plate, ..scenario.clone() })? else { return Ok(None) };
                exact
            };
            let Some(noisy) = play(executor, &scenario)? else { return Ok(None) };
            for ((known, noisy), exact) in differences.iter_mut().zip(noisy).zip(&exact) {
                known.push((noisy - exact) / noise);
            }
            last = Some((draws, exact));
        }
        Ok(Some(differences))
    }
}

/// True if the standard deviation of the finite differences is precise, or if all are equal or none is
/// finite. Its relative standard error with n differences of kurtosis κ is √((κ − 1)/4n).
fn is_precise(differences: &[f64]) -> bool {
    let known = || differences.iter().filter(|difference| difference.is_finite());
    let count = known().count() as f64;
    let mean = known().sum::<f64>() / count;
    let moment = |order: i32| known().map(|difference| (difference - mean).powi(order)).sum::<f64>() / count;
    let (second, fourth) = (moment(2), moment(4));
    count == 0.0 || second == 0.0 || (fourth / second.powi(2) - 1.0) / (4.0 * count) <= MAX_RELATIVE_ERROR.powi(2)
}

/// Values of the expectations; NaN if there is none. `None` if the trial was cancelled.
fn play(executor: &mut Executor<'_>, scenario: &Scenario) -> Result<Option<Vec<f64>>, CampaignError> {
    let law = law(scenario).map_err(|problem| CampaignError::Files(vec![problem]))?;
    let Some(played) = executor.play(scenario, law, 0, None)? else { return Ok(None) };
    Ok(Some(values_of(scenario, measure(scenario, 0, &played.trace_rows, &played.telemetry))))
}

fn values_of(scenario: &Scenario, measures: TrialMeasures) -> Vec<f64> {
    let expectations = judge(scenario, &[measures]).expectations;
    expectations.iter().map(|expectation| expectation.value.unwrap_or(f64::NAN)).collect()
}

fn without_converters(plate: &Plate) -> Plate {
    let amplifier = Amplifier { converter: None, ..plate.effects.amplifier };
    Plate {
        resolution: None,
        lockin: plate.lockin.map(|lockin| Lockin { resolution: None, ..lockin }),
        effects: Effects { amplifier, ..plate.effects },
        ..plate.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::is_precise;

    #[test]
    fn a_long_tail_needs_more_differences() {
        // The kurtosis of a normal value is 3, which needs 0.5/0.115² = 37.8 differences.
        let differences = |count: usize| -> Vec<f64> {
            let normal = [0.0, 0.0, 0.0, 0.0, 3.0_f64.sqrt(), -(3.0_f64.sqrt())];
            (0..count).map(|number| normal[number % 6]).collect()
        };
        assert!(!is_precise(&differences(36)));
        assert!(is_precise(&differences(42)));
        let mut with_a_tail = differences(126);
        with_a_tail[0] = 20.0;
        assert!(!is_precise(&with_a_tail));
    }

    #[test]
    fn equal_or_missing_differences_need_no_more() {
        assert!(is_precise(&[0.0; 32]));
        assert!(is_precise(&[f64::NAN; 32]));
    }
}
