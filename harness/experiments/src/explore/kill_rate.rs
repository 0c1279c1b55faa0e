//! Measures the exploration itself: which mutants it finds, and how many false alarms it raises.
//! Scenes and sequences of messages are played as in an exploration.

use crate::explore::envelope::Envelope;
use crate::explore::exploration::{Exploration, ExplorationBudget, ExploreConfig, explore};
use crate::explore::limits::LawProperties;
use crate::explore::player::ExploreError;
use crate::explore::properties::Property;
use crate::explore::report::format_value;
use crate::explore::sequence::SequenceLimits;
use crate::trust::report::{MutantOutcome, Rate, TrustReport, format_rate};
use crate::trust::{CleanVariant, MutantSpec};
use platebench_document::Block;
use platebench_engine::{RunError, SafeEnds};
use platebench_rig::{BoxedLink, CancelToken, HostedLink, Session};
use platebench_wire::LawId;
use serde::Serialize;
use std::collections::BTreeSet;

/// A mutant plays scenes until one fails. A correct controller plays all scenes.
#[derive(Debug, Clone)]
pub struct KillRateConfig {
    pub envelope: Envelope,
    pub mutants: Vec<MutantSpec>,
    /// Faults that are explored without the reference and with it.
    pub protocol_faults: Vec<MutantSpec>,
    pub variants: Vec<CleanVariant>,
    pub scenes: u64,
    pub seed: u64,
    pub jobs: usize,
}

#[derive(Debug, Clone, Serialize)]
pub struct KillRateReport {
    pub format: u32,
    pub scenes: u64,
    pub seed: u64,
    pub kill_rate: Rate,
    pub mutants: Vec<MutantSearch>,
    pub protocol_faults: ProtocolFaultSearch,
    pub false_alarm_rate: Rate,
    pub alarms: Vec<SceneAlarm>,
}

#[derive(Debug, Clone, Serialize)]
pub struct MutantSearch {
    pub name: &'static str,
    /// The first scene or sequence that fails. `None` if the mutant survived.
    pub found: Option<FoundBy>,
}

#[derive(Debug, Clone, Serialize)]
pub struct ProtocolFaultSearch {
    pub kill_rate: Rate,
    pub faults: Vec<MutantSearch>,
    pub kill_rate_with_reference: Rate,
    pub faults_with_reference: Vec<MutantSearch>,
}

#[derive(Debug, Clone, Copy, Serialize)]
pub struct FoundBy {
    /// Either the scene or the sequence is present.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scene: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sequence: Option<u64>,
    pub property: Property,
}

#[derive(Debug, Clone, Serialize)]
pub struct SceneAlarm {
    /// `reference` or the name of a clean variant.
    pub controller: &'static str,
    pub law: &'static str,
    #[serde(flatten)]
    pub place: AlarmPlace,
    pub property: Property,
    pub value: Option<f64>,
    pub limit: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, strum::Display)]
#[serde(rename_all = "snake_case")]
pub enum AlarmPlace {
    #[strum(to_string = "scene {0}")]
    Scene(u64),
    #[strum(to_string = "sequence {0}")]
    Sequence(u64),
}

/// Explores mutants and clean variants with `dq-pi`, and the firmware with every explored law.
pub fn kill_rate(config: &KillRateConfig, cancel: &CancelToken) -> Result<KillRateReport, ExploreError> {
    let search = |mutants: &[MutantSpec], compares_reference| -> Result<(Rate, Vec<MutantSearch>), ExploreError> {
        let results = mutants.iter().map(|mutant| {
            let result = config.explore(LawId::DqPi, 1, &|| mutant.link(), compares_reference, cancel)?;
            Ok(MutantSearch { name: mutant.name, found: first_failure(&result) })
        });
        let results = results.collect::<Result<Vec<_>, ExploreError>>()?;
        Ok((Rate::new(results.iter().filter(|mutant| mutant.found.is_some()).count(), results.len()), results))
    };
    let (kill_rate, mutants) = search(&config.mutants, false)?;
    let (own_kill_rate, faults) = search(&config.protocol_faults, false)?;
    let (kill_rate_with_reference, faults_with_reference) = search(&config.protocol_faults, true)?;
    let (mut scenes, mut failed, mut alarms) = (0, 0, Vec::new());
    for law in LawProperties::explored_laws() {
        let firmware = (!config.variants.is_empty()).then_some(("reference", None));
        let variants = config.variants.iter().map(|variant| (variant.name, Some(variant)));
        let variants = variants.filter(|_| law == LawId::DqPi);
        for (controller, variant) in firmware.into_iter().chain(variants) {
            let link = || variant.map_or_else(|| -> BoxedLink { Box::new(HostedLink::new()) }, CleanVariant::link);
            let result = config.explore(law, u64::MAX, &link, false, cancel)?;
            scenes += (result.scenes + result.sequences.played) as usize;
            failed += result.failed.len() + result.failed_sequences.len();
            alarms.extend(result.failed.iter().flat_map(|scene| {
                scene.failures.iter().map(move |failure| SceneAlarm {
                    controller,
                    law: law.name(),
                    place: AlarmPlace::Scene(scene.index),
                    property: failure.property,
                    value: failure.value,
                    limit: failure.limit,
                })
            }));
            alarms.extend(result.failed_sequences.iter().flat_map(|sequence| {
                sequence.properties.iter().map(move |property| SceneAlarm {
                    controller,
                    law: law.name(),
                    place: AlarmPlace::Sequence(sequence.index),
                    property: *property,
                    value: None,
                    limit: None,
                })
            }));
        }
    }
    Ok(KillRateReport {
        format: 1,
        scenes: config.scenes,
        seed: config.seed,
        kill_rate,
        mutants,
        protocol_faults: ProtocolFaultSearch {
            kill_rate: own_kill_rate,
            faults,
            kill_rate_with_reference,
            faults_with_reference,
        },
        false_alarm_rate: Rate::new(failed, scenes),
        alarms,
    })
}

fn first_failure(result: &Exploration) -> Option<FoundBy> {
    let scene = result.failed.first().and_then(|failed| {
        let property = failed.failures.first()?.property;
        Some(FoundBy { scene: Some(failed.index), sequence: None, property })
    });
    scene.or_else(|| {
        let failed = result.failed_sequences.first()?;
        Some(FoundBy { scene: None, sequence: Some(failed.index), property: *failed.properties.first()? })
    })
}

impl KillRateReport {
    /// `suite` is the result of the repository's scenarios, without exploration.
    pub fn block(&self, suite: &TrustReport) -> Block {
        let caught =
            |name: &str| suite.faults.iter().any(|fault| fault.name == name && fault.outcome == MutantOutcome::Caught);
        let both = self.mutants.iter().filter(|mutant| mutant.found.is_some() || caught(mutant.name)).count();
        let survivors: Vec<_> =
            self.mutants.iter().filter(|mutant| mutant.found.is_none()).map(|mutant| mutant.name).collect();
        let mut lines = vec![
            format!(
                "mutants that exploration finds in {} scenes and their sequences: {}",
                self.scenes,
                format_rate(self.kill_rate)
            ),
            format!("mutants that scenarios or exploration find: {}", format_rate(Rate::new(both, self.mutants.len()))),
            format!("scenes and sequences with a false alarm: {}", format_rate(self.false_alarm_rate)),
        ];
        lines.extend([
            format!("protocol faults that exploration finds: {}", format_rate(self.protocol_faults.kill_rate)),
            format!("the same with the reference: {}", format_rate(self.protocol_faults.kill_rate_with_reference)),
        ]);
        if !survivors.is_empty() {
            lines.insert(1, format!("mutants that survive exploration: {}", survivors.join(", ")));
        }
        lines.extend(self.alarms.iter().map(|alarm| {
            let SceneAlarm { controller, law, place, property, value, limit } = alarm;
            let [value, limit] = [value, limit].map(|value| format_value(*value, 4));
            format!("false alarm: {controller}, {law}, {place}: {property} {value}, limit {limit}")
        }));
        Block::lines(lines)
    }
}

impl KillRateConfig {
    fn explore(
        &self,
        law: LawId,
        max_failed: u64,
        link: &(dyn Fn() -> BoxedLink + Send + Sync),
        // Clean variants may have other gains, so their commands may differ from the reference.
        compares_reference: bool,
        cancel: &CancelToken,
    ) -> Result<Exploration, ExploreError> {
        // Mutants announce what the hosted controller announces.
        let identity = *Session::open(HostedLink::new()).map_err(RunError::from)?.identity();
        let config = ExploreConfig {
            envelope: self.envelope.clone(),
            seed: self.seed,
            law: law.into(),
            laws: LawProperties::explored_laws().collect(),
            budget: ExplorationBudget::Scenes(self.scenes),
            max_failed,
            jobs: self.jobs,
            own_clock: false,
            compares_reference,
            regressions: Vec::new(),
            sequences: Some(SequenceLimits::new(&identity, false, true, u64::MAX)),
            has_endurance: true,
            is_guided: true,
            branch_outcomes: BTreeSet::new(),
        };
        let mut exploration = explore(&config, &|| Ok(link()), cancel, &SafeEnds::default(), &mut |_, _| {})?;
        match exploration.error.take() {
            Some(error) => Err(error),
            None if exploration.is_interrupted => Err(RunError::Cancelled.into()),
            None => Ok(exploration),
        }
    }
}
