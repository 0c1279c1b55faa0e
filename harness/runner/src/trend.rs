//! What a control step costs, beside what it cost in the runs whose folders lie beside this one's, and in the reference for the image that comes with the bench.
//!
//! How many instructions a step takes depends on what the plate does, by a percent or two. So only trials that are the same in both runs are compared: law, inputs byte
//! for byte, seed. Runs of another kind of rig and of a firmware with another name are left out, and so are folders that hold no readable record.

use crate::folder::sha256;
use platebench_verdict::record::{Cost, CostTrend, EarlierCost, RecordError, RigRecord};
use platebench_verdict::{RunRecord, ScenarioRecord};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;
use tracing::{info, warn};

/// What the image that comes with the bench takes; `ci/cost --update` writes it.
const REFERENCE: &str = include_str!("../../../firmware-under-test/images/cost.toml");
const EMULATED: &str = "emulated";

/// What makes two trials the same: law, digest of the inputs, seed.
type Key = (String, String, u64);
type Costs = BTreeMap<Key, Cost>;

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

/// One digest for all inputs of a scenario, in their order.
pub fn inputs_digest(scenario: &ScenarioRecord) -> String {
    let digests: Vec<&str> = scenario.inputs.iter().map(|input| input.sha256.as_str()).collect();
    sha256(digests.join("\n").as_bytes())
}

/// The run's cost by law, in the order of the laws' first scenarios, beside that of earlier runs; `folder` is the run's own.
pub(crate) fn cost(record: &RunRecord, folder: &Path) -> Vec<CostTrend> {
    let here = costs(record);
    if here.is_empty() {
        return Vec::new();
    }
    let left_out =
        |path: &Path, error: &RecordError| info!(run = %path.display(), %error, "earlier run left out of the trend");
    let mut earlier = record.earlier(folder, left_out);
    earlier.retain(|(_, earlier)| comparable(&record.rig, &earlier.rig));
    beside(record, &here, earlier.into_iter().map(known).collect(), reference())
}

fn beside(
    record: &RunRecord,
    here: &Costs,
    mut earlier: Vec<(EarlierRun, Costs)>,
    reference: Option<Reference>,
) -> Vec<CostTrend> {
    let for_this =
        |reference: &Reference| record.rig.kind() == EMULATED && name(&record.rig) == Some(&reference.firmware);
    earlier.extend(reference.filter(for_this).map(of_reference));
    let mut laws: Vec<&str> = Vec::new();
    for scenario in &record.scenarios {
        if !laws.contains(&scenario.law.as_str()) {
            laws.push(&scenario.law);
        }
    }
    laws.into_iter().filter_map(|law| trend(law, record, here, &earlier)).collect()
}

/// Who an earlier run was of.
struct EarlierRun {
    run: Option<String>,
    started: Option<String>,
    build: String,
}

fn trend(law: &str, record: &RunRecord, here: &Costs, earlier: &[(EarlierRun, Costs)]) -> Option<CostTrend> {
    let of_law: Vec<(&Key, Cost)> =
        here.iter().filter(|((of, ..), _)| of == law).map(|(key, &cost)| (key, cost)).collect();
    let cost = over(of_law.iter().map(|&(_, cost)| cost))?;
    let earlier = earlier.iter().filter_map(|(run, costs)| {
        let both: Vec<(Cost, Cost)> = of_law.iter().filter_map(|&(key, now)| Some((*costs.get(key)?, now))).collect();
        Some(EarlierCost {
            run: run.run.clone(),
            started: run.started.clone(),
            build: run.build.clone(),
            trials: both.len(),
            then: over(both.iter().map(|&(then, _)| then))?,
            now: over(both.iter().map(|&(_, now)| now))?,
        })
    });
    Some(CostTrend { law: law.to_owned(), build: build(&record.rig), cost, earlier: earlier.collect() })
}

/// One figure for several trials; none for none.
fn over(costs: impl ExactSizeIterator<Item = Cost>) -> Option<Cost> {
    let count = costs.len() as f64;
    let sum = costs.reduce(|a, b| Cost { mean: a.mean + b.mean, worst: a.worst.max(b.worst) })?;
    Some(Cost { mean: sum.mean / count, ..sum })
}

/// What every trial of a run took, where the rig counted it.
fn costs(record: &RunRecord) -> Costs {
    let of_scenario = |scenario: &ScenarioRecord| {
        let digest = inputs_digest(scenario);
        let counted = scenario.trials.iter().filter_map(|trial| {
            let cost = Cost { mean: trial.telemetry.instructions_mean?, worst: trial.telemetry.instructions_worst? };
            Some(((scenario.law.clone(), digest.clone(), trial.seed), cost))
        });
        counted.collect::<Vec<_>>()
    };
    record.scenarios.iter().flat_map(of_scenario).collect()
}

fn name(rig: &RigRecord) -> Option<&String> {
    rig.firmware.as_ref().map(|firmware| &firmware.name)
}

fn build(rig: &RigRecord) -> String {
    rig.firmware.as_ref().map(|firmware| firmware.build.clone()).unwrap_or_default()
}

fn comparable(one: &RigRecord, other: &RigRecord) -> bool {
    one.kind() == other.kind() && name(one) == name(other)
}

fn known((run, record): (String, RunRecord)) -> (EarlierRun, Costs) {
    let costs = costs(&record);
    (EarlierRun { run: Some(run), build: build(&record.rig), started: Some(record.started) }, costs)
}

fn reference() -> Option<Reference> {
    toml::from_str(REFERENCE)
        .inspect_err(|error| warn!(%error, "the reference of instructions per step is damaged and left out"))
        .ok()
}

fn of_reference(reference: Reference) -> (EarlierRun, Costs) {
    let costs = reference
        .trial
        .into_iter()
        .map(|trial| ((trial.law, trial.inputs, trial.seed), Cost { mean: trial.mean, worst: trial.worst }));
    (EarlierRun { run: None, started: None, build: reference.build }, costs.collect())
}

#[cfg(test)]
mod tests;
