//! Draws the values of a trial. They depend only on the campaign and the number of the trial.

use crate::campaign::correlation::Correlation;
use crate::campaign::definition::{Campaign, Method};
use crate::campaign::distribution::Distribution;
use crate::campaign::error::CampaignError;
use crate::campaign::variable::Variable;
use platebench_model::scenario::load::ScenarioTables;
use platebench_model::scenario::{Diagnostic, Scenario};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution as _, Open01};

const MAX_REDRAWS: u32 = 100;
/// Number of points in a sequence of the crate `sobol_burley`. Each further block of this many
/// trials uses another scrambling.
const SOBOL_BLOCK: u64 = 1 << 16;

#[derive(Debug)]
pub struct Trial {
    pub number: u64,
    pub seed: u64,
    /// One number per variable. For listed values it is the index of the chosen value, from 0.
    pub values: Vec<f64>,
    pub redraws: u32,
    pub tables: ScenarioTables,
    pub scenario: Scenario,
}

impl Campaign {
    pub fn seed_of(&self, trial: u64) -> u64 {
        self.seed + trial
    }

    /// Draws normal values again while the scenario refuses them, up to 100 draws in all.
    pub fn trial(&self, number: u64) -> Result<Trial, CampaignError> {
        let is_redrawn = self.variables.iter().any(|variable| variable.distribution.is_normal());
        let attempts = if is_redrawn { MAX_REDRAWS } else { 1 };
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        // Sensor noise uses stream 0 of the seed, and the spread between trials uses stream 1.
        random.set_stream(u64::MAX - number);
        let mut values = Vec::new();
        let mut refused = CampaignError::Cancelled;
        for redraws in 0..attempts {
            values = self.draw(number, redraws, &values, &mut random);
            match self.trial_with(number, values.clone(), redraws) {
                Err(error @ CampaignError::Trial { .. }) => refused = error,
                result => return result,
            }
        }
        Err(refused)
    }

    pub(crate) fn trial_with(&self, number: u64, values: Vec<f64>, redraws: u32) -> Result<Trial, CampaignError> {
        let seed = self.seed_of(number);
        let refuse = |message: &str| Diagnostic::for_file(&self.path, message);
        let checked = self.tables(seed, &values).map_err(|message| refuse(&message)).and_then(|tables| {
            let scenario = self.template.check(&tables);
            let first = |faults: Vec<Diagnostic>| faults.into_iter().next().unwrap_or_else(|| refuse("refused"));
            scenario.map(|scenario| (tables, scenario)).map_err(first)
        });
        let fault = match checked {
            Ok((tables, scenario)) => return Ok(Trial { number, seed, values, redraws, tables, scenario }),
            Err(fault) => fault,
        };
        let values = self.variables.iter().zip(&values);
        let values =
            values.map(|(variable, value)| format!("{} = {}", variable.key, variable.distribution.text(*value)));
        let values = values.collect::<Vec<_>>().join(", ");
        Err(CampaignError::Trial { trial: number, values, fault: Box::new(fault) })
    }

    pub(crate) fn title_of(&self, trial: &Trial) -> String {
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

    fn sobol(&self, trial: u64, dimension: usize) -> f64 {
        let block = (trial / SOBOL_BLOCK) as u32;
        let seed = (self.seed as u32) ^ ((self.seed >> 32) as u32) ^ block.wrapping_mul(0x9E37_79B9);
        let point = sobol_burley::sample((trial % SOBOL_BLOCK) as u32, dimension as u32, seed);
        // Points are multiples of 2⁻²⁴. Half of this is added to avoid 0, whose quantile may be −∞.
        f64::from(point) + 0.5 / f64::from(1 << 24)
    }
}
