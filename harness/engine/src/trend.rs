//! Compares the instructions per control step with earlier runs and with the shipped image.
//!
//! The plate's motion changes the count by 1 to 2 %, so only equal trials on the same kind of rig
//! are compared. A trial that ended early has other control steps, so only complete trials of
//! complete runs are compared.

use platebench_model::record::{
    CostTrend, EarlierCost, RecordError, RigRecord, RunRecord, ScenarioRecord, StepCost, TightestStep, TrialRecord,
    sha256,
};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;
use tracing::{info, warn};

/// Counts of the shipped firmware image. `ci/cost --update` writes this file.
const REFERENCE: &str = include_str!("../../../firmware-under-test/images/cost.toml");
const EMULATED: &str = "emulated";

/// Trial as law, digest of the input files, seed, and whether the controller stopped.
type TrialKey = (String, String, u64, bool);
type Costs = BTreeMap<TrialKey, StepCost>;

#[derive(Deserialize)]
struct Reference {
    firmware: String,
    build: String,
    #[serde(default)]
    trial: Vec<ReferenceTrial>,
}

#[derive(Deserialize)]
struct ReferenceTrial {
    law: String,
    inputs: String,
    seed: u64,
    mean: f64,
    worst: f64,
}

pub fn inputs_digest(scenario: &ScenarioRecord) -> String {
    let digests: Vec<&str> = scenario.inputs.iter().map(|input| input.sha256.as_str()).collect();
    sha256(digests.join("\n").as_bytes())
}

pub(crate) fn cost_trends(record: &RunRecord, folder: &Path) -> Vec<CostTrend> {
    if trial_costs(record, |_| true).is_empty() {
        return Vec::new();
    }
    let log_unreadable =
        |path: &Path, error: &RecordError| info!(run = %path.display(), %error, "earlier run ignored by the trend");
    let mut earlier = record.earlier_runs(folder, log_unreadable);
    earlier.retain(|(_, earlier): &(String, RunRecord)| earlier.complete && is_comparable(&record.rig, &earlier.rig));
    compare_costs(record, earlier.into_iter().map(earlier_run).collect(), load_reference())
}

fn compare_costs(
    record: &RunRecord,
    mut earlier: Vec<(EarlierRun, Costs)>,
    reference: Option<Reference>,
) -> Vec<CostTrend> {
    let for_this = |reference: &Reference| {
        record.rig.kind() == EMULATED && firmware_name(&record.rig) == Some(&reference.firmware)
    };
    earlier.extend(reference.filter(for_this).map(reference_run));
    let mut laws: Vec<&str> = Vec::new();
    for scenario in &record.scenarios {
        if !laws.contains(&scenario.law.as_str()) {
            laws.push(&scenario.law);
        }
    }
    laws.into_iter().filter_map(|law| law_trend(law, record, &earlier)).collect()
}

struct EarlierRun {
    run: Option<String>,
    started: Option<String>,
    build: String,
}

fn law_trend(law: &str, record: &RunRecord, earlier: &[(EarlierRun, Costs)]) -> Option<CostTrend> {
    let of_law = |mut costs: Costs| {
        costs.retain(|(of, ..), _| of == law);
        costs
    };
    let all = of_law(trial_costs(record, |_| true));
    let cost = average_cost(all.values().copied())?;
    let complete = of_law(trial_costs(record, is_complete));
    let earlier = earlier.iter().filter_map(|(run, costs)| {
        let both: Vec<(StepCost, StepCost)> =
            complete.iter().filter_map(|(key, &now)| Some((*costs.get(key)?, now))).collect();
        Some(EarlierCost {
            run: run.run.clone(),
            started: run.started.clone(),
            build: run.build.clone(),
            trials: both.len(),
            then: average_cost(both.iter().map(|&(then, _)| then))?,
            now: average_cost(both.iter().map(|&(_, now)| now))?,
        })
    });
    let (law, build) = (law.to_owned(), firmware_build(&record.rig));
    Some(CostTrend { tightest: tightest_step(&law, record), law, build, cost, earlier: earlier.collect() })
}

/// Control step with the largest share of its period. Control periods differ between scenarios.
fn tightest_step(law: &str, record: &RunRecord) -> Option<TightestStep> {
    let of_law = record.scenarios.iter().filter(|scenario| scenario.law == law);
    let steps = of_law.flat_map(|scenario| {
        let counts = scenario.trials.iter().filter_map(|trial| trial.telemetry.instructions_worst);
        counts.filter_map(|instructions| Some(TightestStep { instructions, period_ms: scenario.period_ms? }))
    });
    steps.max_by(|a, b| a.share().total_cmp(&b.share()))
}

fn average_cost(costs: impl ExactSizeIterator<Item = StepCost>) -> Option<StepCost> {
    let count = costs.len() as f64;
    let sum = costs.reduce(|a, b| StepCost { mean: a.mean + b.mean, worst: a.worst.max(b.worst) })?;
    Some(StepCost { mean: sum.mean / count, ..sum })
}

/// Costs of the trials that `counts` selects.
fn trial_costs(record: &RunRecord, counts: impl Fn(&TrialRecord) -> bool) -> Costs {
    let of_scenario = |scenario: &ScenarioRecord| {
        let digest = inputs_digest(scenario);
        let counted = scenario.trials.iter().filter(|trial| counts(trial)).filter_map(|trial| {
            let cost =
                StepCost { mean: trial.telemetry.instructions_mean?, worst: trial.telemetry.instructions_worst? };
            let stopped = trial.telemetry.stopped.is_some();
            Some(((scenario.law.clone(), digest.clone(), trial.seed, stopped), cost))
        });
        counted.collect::<Vec<_>>()
    };
    record.scenarios.iter().flat_map(of_scenario).collect()
}

/// True if the controller was not lost and the trial counts.
fn is_complete(trial: &TrialRecord) -> bool {
    trial.telemetry.ended.is_none() && trial.cause.is_none()
}

fn firmware_name(rig: &RigRecord) -> Option<&String> {
    rig.firmware.as_ref().map(|firmware| &firmware.name)
}

fn firmware_build(rig: &RigRecord) -> String {
    rig.firmware.as_ref().map(|firmware| firmware.build.clone()).unwrap_or_default()
}

fn is_comparable(one: &RigRecord, other: &RigRecord) -> bool {
    one.kind() == other.kind() && firmware_name(one) == firmware_name(other)
}

fn earlier_run((run, record): (String, RunRecord)) -> (EarlierRun, Costs) {
    let costs = trial_costs(&record, is_complete);
    (EarlierRun { run: Some(run), build: firmware_build(&record.rig), started: Some(record.started) }, costs)
}

fn load_reference() -> Option<Reference> {
    toml::from_str(REFERENCE)
        .inspect_err(|error| warn!(%error, "the reference of instructions per step is damaged and ignored"))
        .ok()
}

fn reference_run(reference: Reference) -> (EarlierRun, Costs) {
    let costs = reference
        .trial
        .into_iter()
        .map(|trial| ((trial.law, trial.inputs, trial.seed, false), StepCost { mean: trial.mean, worst: trial.worst }));
    (EarlierRun { run: None, started: None, build: reference.build }, costs.collect())
}

#[cfg(test)]
mod tests;
