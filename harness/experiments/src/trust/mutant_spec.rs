//! Defines an entry of the catalogue, and the names that entries share.

use crate::trust::mutant_controller::{Mutant, MutantController};
use crate::trust::mutants::loops::{HandwrittenLoops, Omission};
use platebench_model::record::ViolationKind;
use platebench_model::scenario::Metric;
use platebench_rig::{BoxedLink, HostedLink};

/// Correct controller for comparison. An expectation that it fails catches no mutant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReferenceController {
    Firmware,
    /// The firmware, with `dq-pi` replaced by an independent implementation of the PI loops.
    Handwritten,
}

impl ReferenceController {
    pub const ALL: [Self; 2] = [Self::Firmware, Self::Handwritten];

    pub fn link(self) -> BoxedLink {
        match self {
            Self::Firmware => Box::new(HostedLink::new()),
            Self::Handwritten => Box::new(MutantController::new(HostedLink::new(), || {
                Box::new(HandwrittenLoops::without(Omission::Nothing))
            })),
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub struct MutantSpec {
    pub name: &'static str,
    pub description: &'static str,
    /// Metrics that should detect the mutant, besides `REFERENCE`. Others are a wrong reason.
    pub detecting_metrics: &'static [Metric],
    pub detecting_violations: &'static [ViolationKind],
    /// Scenario in which one of these metrics or violations must detect the mutant.
    pub witness_scenario: &'static str,
    pub reference: ReferenceController,
    pub build: fn() -> Box<dyn Mutant>,
}

impl MutantSpec {
    pub fn link(&self) -> BoxedLink {
        Box::new(MutantController::new(HostedLink::new(), self.build))
    }
}

pub(crate) const AMPLITUDE: &[Metric] = &[Metric::StaticError];
pub(crate) const DYNAMICS: &[Metric] =
    &[Metric::SettlingTime, Metric::Overshoot, Metric::RecoveryTime, Metric::PeakDeviation, Metric::DrivePeak];
pub(crate) const DISTURBANCE: &[Metric] = &[Metric::PeakDeviation, Metric::RecoveryTime];
pub(crate) const RESONANCE: &[Metric] = &[Metric::FrequencyError, Metric::QuadratureRatio];
pub(crate) const REFERENCE: &[Metric] = &[Metric::ReferenceDifference, Metric::ProtocolDifferences];
pub(crate) const SHUTDOWN: &[Metric] = &[Metric::ShutdownTime];
pub(crate) const RESPONSE: &[Metric] =
    &[Metric::Overshoot, Metric::SettlingTime, Metric::StaticError, Metric::MissedReplies];

pub(crate) const FIG13: &str = "paper/fig13-closed-loop.toml";
pub(crate) const FIG14: &str = "paper/fig14-closed-loop.toml";
pub(crate) const FIG15: &str = "paper/fig15-frequency.toml";
pub(crate) const FIG16: &str = "paper/fig16-closed-loop.toml";
pub(crate) const TEMPERATURE_RAMP: &str = "paper/temperature-ramp.toml";
pub(crate) const DRUMMING_FINGER: &str = "guards/drumming-finger.toml";
pub(crate) const SILENCE: &str = "faults/five-periods-of-silence.toml";
pub(crate) const NOISE_STORM: &str = "faults/noise-storm.toml";

pub(crate) const fn mutant(
    name: &'static str,
    description: &'static str,
    detecting_metrics: &'static [Metric],
    witness_scenario: &'static str,
    build: fn() -> Box<dyn Mutant>,
) -> MutantSpec {
    let reference = ReferenceController::Firmware;
    MutantSpec { name, description, detecting_metrics, detecting_violations: &[], witness_scenario, reference, build }
}

pub(crate) const fn handwritten_mutant(
    name: &'static str,
    description: &'static str,
    detecting_metrics: &'static [Metric],
    witness_scenario: &'static str,
    build: fn() -> Box<dyn Mutant>,
) -> MutantSpec {
    let reference = ReferenceController::Handwritten;
    MutantSpec { reference, ..mutant(name, description, detecting_metrics, witness_scenario, build) }
}
