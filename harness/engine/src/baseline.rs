//! Builds a baseline (the accepted reference response) from the trials of a stored run.

use crate::stored_trials::{CompareError, ScenarioTrials, StoredTrial};
use platebench_model::record::{RunRecord, ScenarioRecord};
use platebench_verdict::golden::{
    Baseline, BaselineBuild, GoldenTubes, LearnError, LearningParameters, ResponseFeatures,
};

#[derive(Debug, thiserror::Error)]
pub enum BaselineAcceptError {
    #[error(transparent)]
    Compare(#[from] CompareError),
    #[error(transparent)]
    Learn(#[from] LearnError),
    #[error("the run contains no trial of this scenario; accept another run")]
    NoTrial,
    #[error("the run was cut off; accept a complete run")]
    Incomplete,
    #[error("the controller did not confirm 0 V at the end of the run; accept a run that ended safely")]
    NotSafe,
    #[error("{0}")]
    ExcludedTrial(String),
}

pub fn check_acceptable(record: &RunRecord, trials: &ScenarioTrials) -> Result<(), BaselineAcceptError> {
    if !record.complete {
        return Err(BaselineAcceptError::Incomplete);
    }
    if record.safe_confirmed != Some(true) {
        return Err(BaselineAcceptError::NotSafe);
    }
    match trials.excluded.first() {
        Some(reason) => Err(BaselineAcceptError::ExcludedTrial(reason.clone())),
        None => Ok(()),
    }
}

pub fn build_baseline(
    record: &RunRecord,
    scenario: &ScenarioRecord,
    stored: &ScenarioTrials,
    old: Option<&Baseline>,
    rate: f64,
) -> Result<Baseline, BaselineAcceptError> {
    let trials = stored.trials.iter().map(StoredTrial::rows).collect::<Result<Vec<_>, _>>()?;
    let Some(first) = trials.first() else { return Err(BaselineAcceptError::NoTrial) };
    // Events add rows, so the longest time between two rows is the trace step, in whole ns.
    let gaps = first.iter().zip(first.iter().skip(1)).map(|(left, right)| right.t_s - left.t_s);
    let step_ms = (gaps.fold(0.0, f64::max) * 1e9).round() / 1e6;
    let differ = trials.iter().any(|rows| rows != first);
    let (mut golden, learned) = if differ {
        let learned = LearningParameters { trials: trials.len() as u32, false_alarm_rate: rate };
        (GoldenTubes::learn(&trials, step_ms, rate)?, Some(learned))
    } else {
        (GoldenTubes::from_trial(first, step_ms).ok_or(BaselineAcceptError::NoTrial)?, None)
    };
    // A person may have edited the tolerances of the old baseline, so they are kept.
    for tube in &mut golden.tubes {
        if let Some(kept) = old.and_then(|old| old.golden.tubes.iter().find(|old| old.signal == tube.signal)) {
            tube.tolerance = kept.tolerance;
        }
    }
    let firmware = record.rig.firmware.as_ref();
    Ok(Baseline {
        scenario: scenario.file.clone(),
        law: scenario.law.clone(),
        build: BaselineBuild {
            rig: record.rig.name.clone(),
            firmware: firmware.map_or_else(String::new, |firmware| format!("{} {}", firmware.name, firmware.version)),
            id: firmware.map_or_else(String::new, |firmware| firmware.build.clone()),
        },
        features: ResponseFeatures::of(first),
        learned,
        golden,
    })
}
