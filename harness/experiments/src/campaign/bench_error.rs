//! Computes the bench's own error of each value of a trial. The error of a trial alone is computed
//! when it is played, the scatter of its cell when the parts are merged.

use crate::campaign::definition::Campaign;
use crate::campaign::paired_trials::PairedErrors;
use crate::campaign::row::{Tally, TrialRow, ValueTally};
use platebench_engine::TrialResult;
use platebench_model::scenario::Scenario;
use platebench_verdict::missed_between_rows;
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
    pub(crate) fn of(
        &self,
        scenario: &Scenario,
        values: &[f64],
        played: &TrialResult,
        paired: &PairedErrors,
    ) -> Vec<f64> {
        let own;
        let budgets = if let Some(constant) = &self.constant {
            constant
        } else {
            own = budgets(scenario);
            &own
        };
        let errors = |(index, (budget, value)): (usize, (&QuantityBudget, &f64))| {
            let [numerical, quantisation, sensor] =
                ErrorOrigin::OF_TRIAL.map(|origin| budget.standard_of(origin, *value, None));
            // Errors of the amplitude do not change a count.
            let of_pairs = |errors: Option<&Vec<f64>>| numerical.and(errors?.get(index).copied());
            let peak = scenario.expectations.get(index).and_then(|expectation| {
                missed_between_rows(scenario, 0, expectation, &played.trace_rows, &played.telemetry, *value)
            });
            let noise = of_pairs(paired.noise.as_ref());
            let sensor = match noise {
                // The law ignores the sensor.
                Some(0.0) => noise,
                _ => root_sum_square(sensor, noise),
            };
            let errors = [
                root_sum_square(numerical, peak),
                root_sum_square(quantisation, of_pairs(paired.quantisation.as_ref())),
                sensor,
            ];
            errors.map(|error| error.filter(|_| value.is_finite()).unwrap_or(f64::NAN))
        };
        budgets.iter().zip(values).enumerate().flat_map(errors).collect()
    }
}

fn root_sum_square(a: Option<f64>, b: Option<f64>) -> Option<f64> {
    match (a, b) {
        (Some(a), Some(b)) => Some(a.hypot(b)),
        (one, other) => one.or(other),
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
    use crate::campaign::draw::DrawnTrial;
    use platebench_model::record::{Telemetry, Verdict};

    const GRID: &str = "[plan]\nmethod = \"grid\"\ntrials = 3\n";
    const SENSOR: usize = 2;

    fn campaign(vary: &str) -> (tempfile::TempDir, Campaign) {
        let folder = tempfile::tempdir().unwrap();
        let campaign = Campaign::example(folder.path(), vary, GRID);
        (folder, campaign)
    }

    fn errors_of(errors: &BenchErrors, trial: &DrawnTrial, value: f64, paired: &PairedErrors) -> Vec<f64> {
        let played = TrialResult {
            trace_rows: Vec::new(),
            telemetry: Telemetry::default(),
            link_error: None,
            safe_confirmed: true,
        };
        errors.of(&trial.scenario, &[value], &played, paired)
    }

    #[test]
    fn the_errors_of_pairs_are_part_of_their_column() {
        let (_folder, campaign) = campaign("\"controller.loop_delay_ms\" = { each = [0.0, 0.1] }\n");
        let trial = campaign.trial_with(0, vec![0.0], 0).unwrap();
        let errors = BenchErrors::new(&campaign);
        let paired = PairedErrors { quantisation: Some(vec![0.5]), noise: Some(vec![0.25]) };
        let [numerical, quantisation, sensor] = errors_of(&errors, &trial, 1.5, &paired)[..] else { panic!() };
        assert!(numerical > 0.0 && numerical < 1e-5, "{numerical}");
        assert!((quantisation - 0.5).abs() < 1e-6, "{quantisation}");
        assert_eq!(sensor, 0.25);
        let alone = errors_of(&errors, &trial, 1.5, &PairedErrors::default());
        assert!(alone[SENSOR].is_nan() && alone[1] < 1e-5, "{alone:?}");
        let ignored = PairedErrors { quantisation: None, noise: Some(vec![0.0]) };
        assert_eq!(errors_of(&errors, &trial, 1.5, &ignored)[SENSOR], 0.0);
        assert!(errors_of(&errors, &trial, f64::NAN, &paired).iter().all(|error| error.is_nan()));
    }

    #[test]
    fn constant_budgets_are_those_of_the_scenario() {
        let (_folder, campaign) = campaign("\"controller.loop_delay_ms\" = { each = [0.0, 0.1] }\n");
        let errors = BenchErrors::new(&campaign);
        assert!(errors.constant.is_some());
        let trial = campaign.trial_with(1, vec![1.0], 0).unwrap();
        let [found, expected] = [errors, BenchErrors { constant: None }]
            .map(|errors| errors_of(&errors, &trial, 1.5, &PairedErrors::default()));
        assert_eq!(format!("{found:?}"), format!("{expected:?}"));
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
