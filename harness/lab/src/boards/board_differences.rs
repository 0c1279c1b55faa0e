//! Compares the means of the metrics of several boards.

use platebench_model::record::{BoardDifference, MergeRecord, ScenarioRecord};
use platebench_verdict::statistics::SampleSummary;
use std::collections::BTreeMap;

const CONFIDENCE: f64 = 0.95;
/// One-sided confidence at each end of the interval, 0.975.
const ONE_SIDED: f64 = f64::midpoint(1.0, CONFIDENCE);

/// Compares each board with the first board that played the scenario.
pub(crate) fn differences(merge: &MergeRecord, scenarios: &[ScenarioRecord]) -> Vec<BoardDifference> {
    let mut boards: BTreeMap<&str, Vec<(&str, &ScenarioRecord)>> = BTreeMap::new();
    for run in &merge.runs {
        for merged in &run.scenarios {
            if let Some(scenario) = scenarios.iter().find(|scenario| scenario.file == merged.file) {
                boards.entry(&merged.original).or_default().push((&run.board, scenario));
            }
        }
    }
    let mut found = Vec::new();
    for (original, played) in boards {
        let [(reference, first), others @ ..] = &played[..] else { continue };
        for (board, scenario) in others.iter().filter(|(board, _)| board != reference) {
            let metrics = first.trials.first().into_iter().flat_map(|trial| trial.metrics.iter());
            for (metric, _) in metrics {
                let (Some(expected), Some(other)) = (summary(first, metric), summary(scenario, metric)) else {
                    continue;
                };
                found.push(BoardDifference {
                    scenario: original.to_owned(),
                    metric: metric.to_owned(),
                    board: (*board).to_owned(),
                    reference: (*reference).to_owned(),
                    difference: other.mean - expected.mean,
                    interval: other.difference_bounds(&expected, ONE_SIDED),
                    confidence: CONFIDENCE,
                });
            }
        }
    }
    found
}

fn summary(scenario: &ScenarioRecord, metric: &str) -> Option<SampleSummary> {
    let counted = scenario.trials.iter().filter(|trial| trial.cause.is_none());
    let values: Vec<f64> = counted.filter_map(|trial| trial.metrics.number(metric)).collect();
    SampleSummary::of(&values)
}
