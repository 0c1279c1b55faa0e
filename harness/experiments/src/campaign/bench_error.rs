//! Computes the bench's own error of each value of a trial. The error of a trial alone is computed
//! when it is played, the scatter of its cell when the parts are merged.

use crate::campaign::definition::Campaign;
use crate::campaign::row::{Tally, TrialRow, ValueTally};
use platebench_model::scenario::Scenario;
use platebench_verdict::uncertainty::{ErrorOrigin, QuantityBudget};

/// Origins of the errors that a trial has alone, in the order of [`TrialRow::errors`].
pub(crate) const OWN_ORIGINS: [ErrorOrigin; 3] =
    [ErrorOrigin::Numerical, ErrorOrigin::Quantisation, ErrorOrigin::Sensor];

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

pub(crate) struct BenchErrors {
    /// Budgets of the expectations; `None` if they depend on varied values.
    constant: Option<Vec<QuantityBudget>>,
}

impl BenchErrors {
    pub(crate) fn new(campaign: &Campaign) -> Self {
        let varies = campaign.variables.iter().any(|variable| !CONSTANT_KEYS.contains(&&*variable.key));
        Self { constant: (!varies).then(|| budgets(&campaign.template.scenario)) }
    }

    /// Standard uncertainties of the values of a trial with `scenario`, as in [`TrialRow::errors`].
    pub(crate) fn of(&self, scenario: &Scenario, values: &[f64]) -> Vec<f64> {
        let errors = |budgets: &[QuantityBudget]| {
            let of_value = |(budget, value): (&QuantityBudget, &f64)| {
                OWN_ORIGINS.map(|origin| budget.standard_of(origin, *value, None).unwrap_or(f64::NAN))
            };
            budgets.iter().zip(values).flat_map(of_value).collect()
        };
        self.constant.as_deref().map_or_else(|| errors(&budgets(scenario)), errors)
    }
}

/// One element per expectation. `cell` contains all trials with the same listed values.
pub(crate) fn errors_in_cell(row: &TrialRow, cell: Option<&Tally>) -> Vec<RowErrors> {
    let (own, _) = row.errors.as_chunks();
    let errors = |(index, (value, own)): (usize, (&f64, &[f64; 3]))| {
        let scatter = cell.and_then(|cell| cell.values.get(index)).and_then(ValueTally::scatter);
        let statistics = scatter.filter(|_| value.is_finite()).map(|scatter| scatter.standard);
        let [numerical, quantisation, sensor] = own.map(|error| Some(error).filter(|error| !error.is_nan()));
        [numerical, quantisation, sensor, statistics]
    };
    row.values.iter().zip(own).enumerate().map(errors).collect()
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

    fn campaign(vary: &str) -> (tempfile::TempDir, Campaign) {
        let folder = tempfile::tempdir().unwrap();
        let campaign = Campaign::example(folder.path(), vary, GRID);
        (folder, campaign)
    }

    #[test]
    fn a_varied_noise_changes_the_error_and_a_varied_delay_does_not() {
        let (_folder, campaign) = campaign(
            "\"controller.loop_delay_ms\" = { each = [0.0, 0.1] }\n\
             \"plate.sensor.noise_um_rms\" = { each = [0.0, 0.01, 0.02] }\n",
        );
        let errors_of = |draws: [f64; 2], value: f64| {
            let trial = campaign.trial_with(0, draws.to_vec(), 0).unwrap();
            BenchErrors::new(&campaign).of(&trial.scenario, &[value])
        };
        assert!(errors_of([0.0, 0.0], 1.5)[SENSOR].is_nan());
        let (once, twice) = (errors_of([0.0, 1.0], 1.5)[SENSOR], errors_of([0.0, 2.0], 1.5));
        assert!((twice[SENSOR] / once - 2.0).abs() < 1e-9, "{once} {twice:?}");
        assert_eq!(errors_of([1.0, 2.0], 1.5), twice);
        assert!((errors_of([1.0, 2.0], 3.0)[SENSOR] / once - 4.0).abs() < 1e-9);
        assert!(errors_of([1.0, 2.0], f64::NAN).iter().all(|error| error.is_nan()));
    }

    #[test]
    fn constant_budgets_are_those_of_the_scenario() {
        let (_folder, campaign) = campaign("\"controller.loop_delay_ms\" = { each = [0.0, 0.1] }\n");
        let errors = BenchErrors::new(&campaign);
        assert!(errors.constant.is_some());
        let trial = campaign.trial_with(1, vec![1.0], 0).unwrap();
        let expected = BenchErrors { constant: None }.of(&trial.scenario, &[1.5]);
        assert_eq!(format!("{:?}", errors.of(&trial.scenario, &[1.5])), format!("{expected:?}"));
        assert!(expected[0] > 0.0, "{expected:?}");
    }

    #[test]
    fn statistics_are_the_scatter_of_the_values_in_the_cell() {
        let row = |value: f64| TrialRow {
            values: vec![value],
            errors: vec![0.25, f64::NAN, 0.5],
            ..TrialRow::example(0, Verdict::Pass, 0.5)
        };
        let mut cell = Tally::new(1);
        let mut statistics = |value| {
            cell.add(&row(value));
            let [numerical, quantisation, sensor, statistics] = errors_in_cell(&row(1.0), Some(&cell))[0];
            assert_eq!([numerical, quantisation, sensor], [Some(0.25), None, Some(0.5)]);
            statistics
        };
        assert_eq!(statistics(1.0), None);
        assert_eq!(statistics(f64::NAN), None);
        assert!((statistics(2.0).unwrap() - 0.5_f64.sqrt()).abs() < 1e-12);
        // Standard deviation of 1, 2 and 4.
        assert!((statistics(4.0).unwrap() - (7.0_f64 / 3.0).sqrt()).abs() < 1e-12);
        assert_eq!(errors_in_cell(&row(f64::NAN), Some(&cell))[0][3], None);
        assert_eq!(errors_in_cell(&row(1.0), None)[0][3], None);
    }
}
