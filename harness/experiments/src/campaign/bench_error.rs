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
        if let Some(known) = self.last.take().filter(|(known, _)| *known == values) {
            return Ok(&self.last.insert(known).1);
        }
        let budgets = if values.is_empty() {
            budgets(&self.campaign.template.scenario)
        } else {
            budgets(&row.trial_in(self.campaign)?.scenario)
        };
        Ok(&self.last.insert((values, budgets)).1)
    }
}

fn budgets(scenario: &Scenario) -> Vec<QuantityBudget> {
    scenario.expectations.iter().map(|expectation| QuantityBudget::of_bench(scenario, expectation)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_model::record::Verdict;

    const GRID: &str = "[plan]\nmethod = \"grid\"\ntrials = 3\n";
    const SENSOR: usize = 2;
    const STATISTICS: usize = 3;

    fn row(draws: &[f64], value: f64) -> TrialRow {
        TrialRow { draws: draws.to_vec(), values: vec![value], ..TrialRow::example(0, Verdict::Pass, 0.5) }
    }

    #[test]
    fn a_varied_noise_changes_the_error_and_a_varied_delay_does_not() {
        let folder = tempfile::tempdir().unwrap();
        let vary = "\"controller.loop_delay_ms\" = { each = [0.0, 0.1] }\n\
            \"plate.sensor.noise_um_rms\" = { each = [0.0, 0.01, 0.02] }\n";
        let campaign = Campaign::example(folder.path(), vary, GRID);
        let mut errors = BenchErrors::new(&campaign);
        let mut errors_of = |draws: [f64; 2], value| errors.of(&row(&draws, value), None).unwrap()[0];
        assert_eq!(errors_of([0.0, 0.0], 1.5)[SENSOR], None);
        let once = errors_of([0.0, 1.0], 1.5)[SENSOR].unwrap();
        let twice = errors_of([0.0, 2.0], 1.5);
        assert!((twice[SENSOR].unwrap() / once - 2.0).abs() < 1e-9, "{once} {twice:?}");
        assert_eq!(errors_of([1.0, 2.0], 1.5), twice);
        assert!((errors_of([1.0, 2.0], 3.0)[SENSOR].unwrap() / once - 4.0).abs() < 1e-9);
        assert_eq!(errors_of([1.0, 2.0], f64::NAN), [None; 4]);
    }

    #[test]
    fn statistics_are_the_scatter_of_the_values_in_the_cell() {
        let folder = tempfile::tempdir().unwrap();
        let campaign = Campaign::example(folder.path(), "\"controller.law\" = { each = [\"dq-pi\"] }\n", GRID);
        let mut errors = BenchErrors::new(&campaign);
        let mut cell = Tally::new(1);
        let mut statistics = |value| {
            cell.add(&row(&[0.0], value));
            errors.of(&row(&[0.0], 1.0), Some(&cell)).unwrap()[0][STATISTICS]
        };
        assert_eq!(statistics(1.0), None);
        assert_eq!(statistics(f64::NAN), None);
        assert!((statistics(2.0).unwrap() - 0.5_f64.sqrt()).abs() < 1e-12);
        // Standard deviation of 1, 2 and 4.
        assert!((statistics(4.0).unwrap() - (7.0_f64 / 3.0).sqrt()).abs() < 1e-12);
    }
}
