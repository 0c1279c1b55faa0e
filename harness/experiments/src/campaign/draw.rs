//! Draws the values of a trial. They depend only on the campaign and the number of the trial, or,
//! in a chain, also on the scores of earlier trials. Therefore a merge can repeat a chain from
//! stored scores.

use crate::campaign::definition::{Campaign, Method, RARE_DEVIATIONS};
use crate::campaign::distribution::{Correlation, Distribution, Variable};
use crate::campaign::error::CampaignError;
use crate::campaign::rare::{self, ChainEstimate};
use crate::campaign::search::search;
use platebench_engine::RunError;
use platebench_model::scenario::{Diagnostic, Scenario};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution as _, Open01};
use serde_json::{Value, json};
use std::ops::Range;

const MAX_REDRAWS: u32 = 100;
/// Number of points in a sequence of the crate `sobol_burley`. Each further block of this many
/// trials uses another scrambling.
const SOBOL_BLOCK: u64 = 1 << 16;

#[derive(Debug)]
pub struct DrawnTrial {
    pub number: u64,
    pub seed: u64,
    /// One number per variable. For listed values it is the index of the chosen value, from 0.
    pub values: Vec<f64>,
    pub redraws: u32,
    pub scenario: Scenario,
}

impl Campaign {
    pub fn seed_of(&self, trial: u64) -> u64 {
        self.seed + trial
    }

    /// Draws normal values again while the scenario refuses them, up to 100 draws in all.
    pub fn trial(&self, number: u64) -> Result<DrawnTrial, CampaignError> {
        let is_redrawn = self.variables.iter().any(|variable| variable.distribution.is_normal());
        let attempts = if is_redrawn { MAX_REDRAWS } else { 1 };
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        // Sensor noise uses stream 0 of the seed, and the spread between trials uses stream 1.
        random.set_stream(u64::MAX - number);
        let mut values = Vec::new();
        let mut refused = CampaignError::from(RunError::Cancelled);
        for redraws in 0..attempts {
            values = self.draw(number, redraws, &values, &mut random);
            match self.trial_with(number, values.clone(), redraws) {
                Err(error @ CampaignError::Trial { .. }) => refused = error,
                result => return result,
            }
        }
        Err(refused)
    }

    pub(crate) fn trial_with(&self, number: u64, values: Vec<f64>, redraws: u32) -> Result<DrawnTrial, CampaignError> {
        let seed = self.seed_of(number);
        let refused = || Diagnostic::for_file(&self.path, "refused");
        let first = |problems: Vec<Diagnostic>| problems.into_iter().next().unwrap_or_else(refused);
        let checked = self.tables(seed, &values).and_then(|tables| self.template.check(&tables).map_err(first));
        let problem = match checked {
            Ok(scenario) => return Ok(DrawnTrial { number, seed, values, redraws, scenario }),
            Err(problem) => problem,
        };
        let values = self.variables.iter().zip(&values);
        let values =
            values.map(|(variable, value)| format!("{} = {}", variable.key, variable.distribution.text(*value)));
        let values = values.collect::<Vec<_>>().join(", ");
        Err(CampaignError::Trial { trial: number, values, problem: Box::new(problem) })
    }

    pub(crate) fn title_of(&self, trial: &DrawnTrial) -> String {
        let values = self.variables.iter().zip(&trial.values);
        let values = values.map(|(variable, value)| format!("{} {}", variable.short_name(), variable.text(*value)));
        format!("Trial {}: {}", trial.number, values.collect::<Vec<_>>().join(", "))
    }

    /// If `attempt` is above 0, draws only normal values and takes the others from `before`.
    fn draw(&self, trial: u64, attempt: u32, before: &[f64], random: &mut ChaCha8Rng) -> Vec<f64> {
        let mut place = self.cell_of(trial);
        let mut choices = vec![0; self.variables.len()];
        for (choice, variable) in choices.iter_mut().zip(&self.variables).rev() {
            if let Some(list) = variable.distribution.choices() {
                (*choice, place) = (place % list.len() as u64, place / list.len() as u64);
            }
        }
        let draw = |(index, variable): (usize, &Variable)| {
            let distribution = &variable.distribution;
            let random: f64 = Open01.sample(random);
            match (self.method, distribution) {
                (Method::Grid, Distribution::Choices(_)) => choices.get(index).map_or(0.0, |choice| *choice as f64),
                (_, Distribution::Choices(_) | Distribution::Uniform(_)) if attempt > 0 => {
                    before.get(index).copied().unwrap_or_default()
                }
                (Method::Sobol, _) if attempt == 0 => distribution.at(self.sobol(trial, index)),
                _ => distribution.at(random),
            }
        };
        let values: Vec<f64> = self.variables.iter().enumerate().map(draw).collect();
        self.correlation.as_ref().map_or_else(|| values.clone(), |correlation| self.correlate(correlation, &values))
    }

    fn correlate(&self, correlation: &Correlation, values: &[f64]) -> Vec<f64> {
        let variables = || self.variables.iter().zip(values);
        let scores: Vec<f64> = variables().map(|(variable, value)| variable.distribution.score(*value)).collect();
        let correlated = correlation.apply(&scores);
        let value = |((variable, value), score): ((&Variable, &f64), f64)| {
            if variable.distribution.is_normal() { variable.distribution.at_score(score) } else { *value }
        };
        variables().zip(correlated).map(value).collect()
    }

    /// Trial with the listed values of `trial`, and with other drawn values and another seed for each
    /// `place`.
    pub(crate) fn reference_trial(&self, trial: &DrawnTrial, place: u64) -> Result<DrawnTrial, CampaignError> {
        let (first, count) = match self.method {
            Method::Grid => (self.cell_of(trial.number) * self.trials_per_cell, self.trials_per_cell),
            _ => (0, self.trials),
        };
        let number = first + place % count.max(1);
        let mut values = self.trial(number)?.values;
        for ((value, listed), variable) in values.iter_mut().zip(&trial.values).zip(&self.variables) {
            if variable.distribution.choices().is_some() {
                *value = *listed;
            }
        }
        let mut reference = self.trial_with(number, values, 0)?;
        let seed = &mut reference.scenario.trials.seed;
        *seed = seed.wrapping_add((place + 1) << 40);
        Ok(reference)
    }

    fn cell_of(&self, trial: u64) -> u64 {
        if self.method == Method::Grid { trial / self.trials_per_cell } else { 0 }
    }

    /// Number of the cell (combination of listed values). The first variable varies slowest.
    pub fn cell(&self, values: &[f64]) -> usize {
        self.variables.iter().zip(values).fold(0, |cell, (variable, value)| match variable.distribution.choices() {
            Some(list) => cell * list.len() + *value as usize,
            None => cell,
        })
    }

    /// Returns each variable with listed values, and the index of its value in the cell.
    pub fn cell_choices(&self, cell: usize) -> Vec<(&Variable, usize)> {
        let mut place = cell;
        let mut choices = Vec::new();
        for variable in self.variables.iter().rev() {
            if let Some(list) = variable.distribution.choices() {
                choices.push((variable, place % list.len()));
                place /= list.len();
            }
        }
        choices.reverse();
        choices
    }

    /// The selected listed values of the cell, for people.
    pub(crate) fn cell_text(&self, cell: usize, is_selected: impl Fn(&Variable) -> bool) -> String {
        let choices = self.cell_choices(cell).into_iter().filter(|(variable, _)| is_selected(variable));
        let texts =
            choices.map(|(variable, choice)| format!("{} {}", variable.short_name(), variable.text(choice as f64)));
        texts.collect::<Vec<_>>().join(", ")
    }

    /// Listed values of the cell by their keys.
    pub(crate) fn cell_values(&self, cell: usize) -> Value {
        let choices = self.cell_choices(cell).into_iter();
        let values =
            choices.map(|(variable, choice)| (variable.key.clone(), json!(variable.distribution.value(choice as f64))));
        Value::Object(values.collect())
    }

    fn sobol(&self, trial: u64, dimension: usize) -> f64 {
        let block = (trial / SOBOL_BLOCK) as u32;
        let seed = (self.seed as u32) ^ ((self.seed >> 32) as u32) ^ block.wrapping_mul(0x9E37_79B9);
        let point = sobol_burley::sample((trial % SOBOL_BLOCK) as u32, dimension as u32, seed);
        // Points are multiples of 2⁻²⁴. Half of this is added to avoid 0, whose quantile may be −∞.
        f64::from(point) + 0.5 / f64::from(1 << 24)
    }
}

/// Largest number of moves towards the middle of the range if the scenario refuses a point.
const MAX_STEPS: u32 = 12;

impl Campaign {
    /// Calls `play` with points until it returns `None`. Only `rare` returns an estimate. `play`
    /// returns [`TrialRow::scores`](crate::campaign::row::TrialRow::scores).
    pub(crate) fn run_chain(&self, trials: &Range<u64>, play: &mut rare::Play<'_>) -> Option<ChainEstimate> {
        let chain = trials.start / self.chain_trials();
        let seed = self.seed.wrapping_add((chain + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let dimensions = self.variables.len();
        if self.method == Method::Rare {
            return rare::estimate(dimensions, seed, trials.end - trials.start, play);
        }
        search(dimensions, seed, &mut |point| play(point)?.first().copied());
        None
    }

    /// Values of a trial of `rare` at `point`, which contains standard normal scores.
    pub(crate) fn rare_values(&self, point: &[f64]) -> Vec<f64> {
        let scores = self.correlation.as_ref().map(|correlation| correlation.apply(point));
        let values = self.variables.iter().zip(scores.as_deref().unwrap_or(point));
        let at = |score: f64| score.clamp(-RARE_DEVIATIONS, RARE_DEVIATIONS);
        values.map(|(variable, score)| variable.distribution.at_score(at(*score))).collect()
    }

    /// For `rare`, `point` contains standard normal scores. For `search`, it contains positions
    /// from 0 to 1 in the ranges of the values.
    pub(crate) fn chain_trial(&self, number: u64, point: &[f64]) -> Result<DrawnTrial, CampaignError> {
        if self.method == Method::Rare {
            return self.trial_with(number, self.rare_values(point), 0);
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
                    *share = if step + 1 < MAX_STEPS { 0.5 + (*share - 0.5) * 0.7 } else { 0.5 };
                }
            }
        }
        Err(RunError::Cancelled.into())
    }
}
