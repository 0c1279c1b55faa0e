//! Computes the bench's own error of each value of a trial from its value, its scenario and its
//! cell, when the parts are merged.

use crate::campaign::definition::Campaign;
use crate::campaign::error::CampaignError;
use crate::campaign::row::{Tally, TrialRow, ValueTally};
use platebench_model::scenario::Scenario;
use platebench_verdict::uncertainty::{ErrorOrigin, QuantityBudget};

/// Standard uncertainties in the order of [`ErrorOrigin::ALL`]; `None` if one does not apply.
pub(crate) type RowErrors = [Option<f64>; 4];

/// Keys on which no budget depends. Other varied keys need the scenario of the trial.
const CONSTANT_KEYS: [&str; 6] = [
    "controller.law",
    "controller.loop_delay_ms",
    "controller.loop_delay_jitter_ms",
    "controller.design_delay_ms",
    "controller.response_time_ms",
    "profile.temperature_offset_k",
];

pub(crate) struct BenchErrors<'a> {
    campaign: &'a Campaign,
    /// Indices of the varied values on which the budgets depend.
    relevant: Vec<usize>,
    /// Those values of the last trial, and the budget of each expectation.
    last: Option<(Vec<f64>, Vec<QuantityBudget>)>,
}

impl<'a> BenchErrors<'a> {
    pub(crate) fn new(campaign: &'a Campaign) -> Self {
        let keys = campaign.variables.iter().map(|variable| &*variable.key);
        let relevant = keys.enumerate().filter(|(_, key)| !CONSTANT_KEYS.contains(key)).map(|(index, _)| index);
        Self { campaign, relevant: relevant.collect(), last: None }
    }

    /// One element per expectation. `cell` contains all trials with the same listed values.
    pub(crate) fn of(&mut self, row: &TrialRow, cell: Option<&Tally>) -> Result<Vec<RowErrors>, CampaignError> {
        let budgets = self.budgets(row)?;
        let error = |(index, (budget, value)): (usize, (&QuantityBudget, &f64))| {
            let observed = cell.and_then(|cell| cell.values.get(index)).and_then(ValueTally::scatter);
            ErrorOrigin::ALL.map(|origin| budget.standard_of(origin, *value, observed))
        };
        Ok(budgets.iter().zip(&row.values).enumerate().map(error).collect())
    }

    fn budgets(&mut self, row: &TrialRow) -> Result<&[QuantityBudget], CampaignError> {
        let values: Vec<f64> = self.relevant.iter().filter_map(|index| row.draws.get(*index)).copied().collect();
        let known = self.last.take().filter(|(known, _)| *known == values);
        let (_, budgets) = match known {
            Some(known) => self.last.insert(known),
            None => {
                let budgets = if values.is_empty() {
                    budgets(&self.campaign.template.scenario)
                } else {
                    budgets(&row.trial_in(self.campaign)?.scenario)
                };
                self.last.insert((values, budgets))
            }
        };
        Ok(budgets)
    }
}

fn budgets(scenario: &Scenario) -> Vec<QuantityBudget> {
    scenario.expectations.iter().map(|expectation| QuantityBudget::of_bench(scenario, expectation)).collect()
}
