//! Plays scenarios in memory on the emulated rig, with one emulated board per worker.

use crate::firmware_analysis::code_map::CodeMap;
use crate::firmware_analysis::error::FirmwareAnalysisError;
use platebench_engine::plan::LinkFactory;
use platebench_engine::{
    Executor, ExecutorSettings, RunError, SafeEnds, ScenarioEnd, TrialResult, law, why_not_applicable,
};
use platebench_model::record::Verdict;
use platebench_model::scenario::Scenario;
use platebench_model::trace::{MAX_IMAGE_BYTES, Row, read_regular_file};
use platebench_rig::{
    BUILT_IN_IMAGE, CancelToken, Capability, ConnectError, EmulatedError, EmulatedLink, FaultInjector, LinkError,
    RigError, RigSpec, SafeEnd, Session, Symbols, TargetError,
};
use platebench_verdict::Judgement;
use platebench_wire::LawId;
use serde::Serialize;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

pub(crate) type BoardExecutor<'a> = Executor<'a, EmulatedLink>;

/// Scenarios that the firmware can play, with their laws.
#[derive(Debug)]
pub struct FirmwareSuite {
    elf: Option<PathBuf>,
    pub scenarios: Vec<(Scenario, LawId)>,
    pub not_applicable: Vec<String>,
}

#[derive(Debug, Clone)]
pub(crate) struct SuiteOutcome {
    pub(crate) verdict: Verdict,
    pub(crate) detection: Option<Detection>,
    pub(crate) closest_margin: Option<ExpectationMargin>,
    /// Hash over all drives and frequencies of the trials.
    pub(crate) commands: u64,
}

#[derive(Debug, Clone)]
pub(crate) struct Detection {
    pub(crate) reason: String,
    /// True if the emulator failed and is in an unknown state.
    pub(crate) emulator_failed: bool,
    /// True if only the confirmation of 0 V is missing.
    pub(crate) is_unconfirmed: bool,
}

/// Distance of a metric from its limit, divided by the scale of the limit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ExpectationMargin {
    pub scenario: String,
    pub expectation: String,
    pub margin: f64,
}

impl FirmwareSuite {
    pub fn new(rig: &RigSpec, scenarios: Vec<Scenario>) -> Result<Self, FirmwareAnalysisError> {
        if !rig.has(Capability::EmulatedChip) {
            return Err(FirmwareAnalysisError::NotEmulated(rig.to_string()));
        }
        let mut suite =
            Self { elf: rig.image().map(Path::to_owned), scenarios: Vec::new(), not_applicable: Vec::new() };
        let mut session = Session::open(FaultInjector::new(suite.connect()?)).map_err(RunError::from)?;
        for scenario in scenarios {
            let law = law(&scenario).map_err(|fault| FirmwareAnalysisError::Scenario(Box::new(fault)))?;
            let missing = why_not_applicable(&scenario, law, true, &mut session);
            match missing.map_err(FirmwareAnalysisError::Scenario)? {
                None => suite.scenarios.push((scenario, law)),
                Some(reason) => suite.not_applicable.push(format!("{}: {reason}", scenario.file)),
            }
        }
        if session.close() != SafeEnd::Confirmed {
            return Err(FirmwareAnalysisError::NotSafe);
        }
        if suite.scenarios.is_empty() {
            Err(FirmwareAnalysisError::NothingApplicable(suite.not_applicable))
        } else {
            Ok(suite)
        }
    }

    pub(crate) fn code(&self) -> Result<(Symbols, CodeMap), FirmwareAnalysisError> {
        let (symbols, map) = read_code(self.elf.as_deref())?;
        if map.functions.is_empty() { Err(FirmwareAnalysisError::NoFunctions) } else { Ok((symbols, map)) }
    }

    pub(crate) fn connect(&self) -> Result<EmulatedLink, ConnectError> {
        Ok(self.elf.as_deref().map_or_else(EmulatedLink::built_in, EmulatedLink::open)?)
    }
}

/// Reads the code of an image; `None` is the built-in one. The map is empty without symbols.
pub fn read_code(elf: Option<&Path>) -> Result<(Symbols, CodeMap), EmulatedError> {
    let elf = match elf {
        Some(path) => read_regular_file(path, MAX_IMAGE_BYTES)
            .map_err(|error| EmulatedError::Read { path: path.to_owned(), error })?,
        None => BUILT_IN_IMAGE.to_vec(),
    };
    let symbols = Symbols::read(&elf);
    let map = CodeMap::read(&elf, &symbols);
    Ok((symbols, map))
}

/// The executor keeps its link, because the analysis changes or observes the firmware behind it.
pub(crate) fn new_executor<'a>(
    connect: &'a LinkFactory<'a, EmulatedLink>,
    cancel: &CancelToken,
    ends: &'a SafeEnds,
) -> BoardExecutor<'a> {
    Executor::new(connect, ExecutorSettings { keeps_link: true, ..ExecutorSettings::lockstep(cancel) }, ends)
}

/// Plays trials until the verdict is decided or the controller is lost. `None` if it was cancelled.
pub(crate) fn play(
    executor: &mut BoardExecutor<'_>,
    scenario: &Scenario,
    law: LawId,
) -> Result<Option<SuiteOutcome>, FirmwareAnalysisError> {
    let mut commands = DefaultHasher::new();
    let end = executor.play_until_decided(scenario, scenario, law, |result| {
        if let Some(detection) = detection(result) {
            return ControlFlow::Break(detection);
        }
        hash_commands(&result.trace_rows, &mut commands);
        ControlFlow::Continue(())
    })?;
    Ok(match end {
        ScenarioEnd::Judged(judgement) => {
            Some(SuiteOutcome { commands: commands.finish(), ..outcome(scenario, &judgement) })
        }
        ScenarioEnd::Stopped(detection) => Some(detection.into()),
        ScenarioEnd::Cancelled => None,
    })
}

pub(crate) fn hash_commands(rows: &[Row], commands: &mut DefaultHasher) {
    for row in rows {
        (row.drive_vpp.to_bits(), row.frequency_hz.to_bits()).hash(commands);
    }
}

impl From<Detection> for SuiteOutcome {
    fn from(detection: Detection) -> Self {
        Self { verdict: Verdict::Fail, detection: Some(detection), closest_margin: None, commands: 0 }
    }
}

/// Detects a lost controller, a violation or a missing confirmation of 0 V, which an expectation
/// does not show.
fn detection(result: &TrialResult) -> Option<Detection> {
    if let Some(error) = &result.link_error {
        let emulator_failed = matches!(
            error,
            RigError::Link(LinkError::Target(target)) if matches!(**target, TargetError::Emulator(_))
        );
        return Some(Detection { reason: error.to_string(), emulator_failed, is_unconfirmed: false });
    }
    let violation = result.telemetry.violations.first().map(ToString::to_string);
    let is_unconfirmed = violation.is_none();
    let unconfirmed = (!result.safe_confirmed).then(|| "the controller did not confirm 0 V".to_owned());
    let reason = violation.or(unconfirmed)?;
    Some(Detection { reason, emulator_failed: false, is_unconfirmed })
}

fn outcome(scenario: &Scenario, judgement: &Judgement) -> SuiteOutcome {
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
    SuiteOutcome {
        verdict: judgement.verdict,
        detection: (judgement.verdict == Verdict::Fail).then_some(Detection {
            reason,
            emulator_failed: false,
            is_unconfirmed: false,
        }),
        closest_margin: closest.map(|(expectation, margin)| ExpectationMargin {
            scenario: scenario.file.clone(),
            expectation,
            margin,
        }),
        commands: 0,
    }
}
