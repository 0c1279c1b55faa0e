//! Plays scenarios in memory on the emulated rig, with one emulated board per worker.

use crate::code_map::CodeMap;
use crate::error::AnalysisError;
use platebench_record::Verdict;
use platebench_rig::{
    BUILT_IN_IMAGE, CancelToken, EmulatedError, EmulatedLink, FaultInjector, LinkError, RigError, RigSpec, Session,
    Symbols, TargetError,
};
use platebench_runner::trial::{self, TrialSpec};
use platebench_runner::{law, missing_capability};
use platebench_scenario::Scenario;
use platebench_trace::{MAX_IMAGE_BYTES, read_regular_file};
use platebench_verdict::{Judgement, SequentialDecision, judge_sequentially, measure};
use platebench_wire::LawId;
use serde::Serialize;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::PathBuf;

pub(crate) type BoardSession = Session<FaultInjector<EmulatedLink>>;

/// Scenarios that the firmware can play, with their laws.
#[derive(Debug)]
pub struct Suite {
    elf: Option<PathBuf>,
    pub scenarios: Vec<(Scenario, LawId)>,
    pub not_applicable: Vec<String>,
}

#[derive(Debug, Clone)]
pub(crate) struct Outcome {
    pub(crate) verdict: Verdict,
    pub(crate) detection: Option<Detection>,
    pub(crate) closest_margin: Option<Margin>,
    /// Hash over all drives and frequencies of the trials.
    pub(crate) commands: u64,
}

#[derive(Debug, Clone)]
pub(crate) struct Detection {
    pub(crate) reason: String,
    /// True if the emulator failed and is in an unknown state.
    pub(crate) emulator_failed: bool,
}

/// Distance of a metric from its limit, divided by the scale of the limit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Margin {
    pub scenario: String,
    pub expectation: String,
    pub margin: f64,
}

impl Suite {
    pub fn new(rig: &RigSpec, scenarios: Vec<Scenario>) -> Result<Self, AnalysisError> {
        let RigSpec::Emulated(elf) = rig else { return Err(AnalysisError::NotEmulated(rig.to_string())) };
        let mut suite = Self { elf: elf.clone(), scenarios: Vec::new(), not_applicable: Vec::new() };
        let session = suite.connect()?;
        for scenario in scenarios {
            let law = law(&scenario).map_err(|fault| AnalysisError::Scenario(Box::new(fault)))?;
            match missing_capability(&scenario, law, session.identity()) {
                None => suite.scenarios.push((scenario, law)),
                Some(reason) => suite.not_applicable.push(format!("{}: {reason}", scenario.file)),
            }
        }
        session.close();
        if suite.scenarios.is_empty() { Err(AnalysisError::NothingApplicable(suite.not_applicable)) } else { Ok(suite) }
    }

    fn elf(&self) -> Result<Vec<u8>, AnalysisError> {
        let Some(path) = &self.elf else { return Ok(BUILT_IN_IMAGE.to_vec()) };
        read_regular_file(path, MAX_IMAGE_BYTES)
            .map_err(|error| EmulatedError::Read { path: path.clone(), error }.into())
    }

    pub(crate) fn code(&self) -> Result<(Symbols, CodeMap), AnalysisError> {
        let elf = self.elf()?;
        let symbols = Symbols::read(&elf);
        let map = CodeMap::read(&elf, &symbols);
        if map.functions.is_empty() { Err(AnalysisError::NoFunctions) } else { Ok((symbols, map)) }
    }

    pub(crate) fn open<'a>(
        &self,
        session: &'a mut Option<BoardSession>,
    ) -> Result<&'a mut BoardSession, AnalysisError> {
        match session {
            Some(open) => Ok(open),
            None => Ok(session.insert(self.connect()?)),
        }
    }

    fn connect(&self) -> Result<BoardSession, AnalysisError> {
        let link = self.elf.as_deref().map_or_else(EmulatedLink::built_in, EmulatedLink::open)?;
        Ok(Session::open(FaultInjector::new(link))?)
    }
}

/// Plays trials until the verdict is decided or the controller is lost. `None` if `cancel` was
/// cancelled.
pub(crate) fn play(
    session: &mut BoardSession,
    scenario: &Scenario,
    law: LawId,
    cancel: &CancelToken,
) -> Option<Result<Outcome, AnalysisError>> {
    let mut trials = Vec::new();
    let mut commands = DefaultHasher::new();
    loop {
        let goal = match judge_sequentially(scenario, &trials) {
            SequentialDecision::Stop(judgement) => {
                return Some(Ok(Outcome { commands: commands.finish(), ..outcome(scenario, &judgement) }));
            }
            SequentialDecision::Continue { trials } => trials,
        };
        for index in trials.len() as u32..goal {
            for scene in scenario.between.iter().filter(|_| index > 0) {
                let law = match self::law(scene) {
                    Ok(law) => law,
                    Err(fault) => return Some(Err(AnalysisError::Scenario(Box::new(fault)))),
                };
                let spec = TrialSpec { continues: true, ..TrialSpec::new(scene, law, index) };
                if let Some(detection) = detection(&trial::play(session, &spec, cancel, None)?) {
                    return Some(Ok(detection.into()));
                }
            }
            let continues = index > 0 && scenario.keeps_controller();
            let spec = TrialSpec { continues, ..TrialSpec::new(scenario, law, index) };
            let result = trial::play(session, &spec, cancel, None)?;
            if let Some(detection) = detection(&result) {
                return Some(Ok(detection.into()));
            }
            for row in &result.trace_rows {
                (row.drive_vpp.to_bits(), row.frequency_hz.to_bits()).hash(&mut commands);
            }
            trials.push(measure(scenario, index, &result.trace_rows, &result.telemetry));
        }
    }
}

impl From<Detection> for Outcome {
    fn from(detection: Detection) -> Self {
        Self { verdict: Verdict::Fail, detection: Some(detection), closest_margin: None, commands: 0 }
    }
}

/// Detects a lost controller or a violation, which fail a trial independently of its metrics.
fn detection(result: &trial::TrialResult) -> Option<Detection> {
    if let Some(error) = &result.link_error {
        let emulator_failed = matches!(
            error,
            RigError::Link(LinkError::Target(target)) if matches!(**target, TargetError::Emulator(_))
        );
        return Some(Detection { reason: error.to_string(), emulator_failed });
    }
    let violation = result.telemetry.violations.first()?;
    Some(Detection { reason: violation.to_string(), emulator_failed: false })
}

fn outcome(scenario: &Scenario, judgement: &Judgement) -> Outcome {
    let failed = judgement.expectations.iter().find(|record| record.verdict == Verdict::Fail);
    let reason = failed.map_or_else(
        || "a trial failed".to_owned(),
        |record| {
            let value = record.value.map_or_else(|| "no value".to_owned(), |value| value.to_string());
            format!("{}: {value}", record.name)
        },
    );
    let margins = judgement.expectations.iter().filter_map(|record| Some((record.name.clone(), record.margin?)));
    let closest = margins.min_by(|(_, one), (_, other)| one.total_cmp(other));
    Outcome {
        verdict: judgement.verdict,
        detection: (judgement.verdict == Verdict::Fail).then_some(Detection { reason, emulator_failed: false }),
        closest_margin: closest.map(|(expectation, margin)| Margin {
            scenario: scenario.file.clone(),
            expectation,
            margin,
        }),
        commands: 0,
    }
}
