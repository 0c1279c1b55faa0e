//! A scenario that can be run: no value in it is wrong.

use crate::diagnostic::Diagnostic;
use crate::expect::Expectation;
use crate::fault::Fault;
use crate::variation::{Spread, Variation};
use platebench_plate::{ConditionProfiles, Plate, Profile, Tier, Time};
use std::path::PathBuf;

/// The name of the model that is exact for the plate file.
pub const AUTO_MODEL: &str = "auto";

/// A file that went into a scenario.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputFile {
    /// Where it was read.
    pub path: PathBuf,
    /// What stood in it.
    pub bytes: Vec<u8>,
}

/// A checked scenario.
#[derive(Debug, Clone)]
pub struct Scenario {
    /// The file's name below the scenario folder, with `/`: `paper/fig13-closed-loop.toml`.
    pub file: String,
    /// Every file that went into it; the scenario file is the first.
    pub inputs: Vec<InputFile>,
    /// One line that says what is played.
    pub title: String,
    /// Where it comes from.
    pub source: Option<String>,
    /// Words to select scenarios by.
    pub tags: Vec<String>,
    /// The nominal plate.
    pub plate: Plate,
    /// Model of the plate.
    pub tier: Tier,
    /// Length of a trial.
    pub duration: Time,
    /// Largest spacing of trace rows.
    pub trace_step: Time,
    /// The exit code that a scenario which shows a limit must end with.
    pub expected_exit: Option<u8>,
    /// The controller and its timing.
    pub controller: Controller,
    /// Wished amplitude, µm.
    pub setpoint: Profile,
    /// What surrounds the plate.
    pub conditions: ConditionProfiles,
    /// How often, and what differs.
    pub trials: Trials,
    /// What goes wrong on the line to the controller, on purpose.
    pub faults: Vec<Fault>,
    /// What is expected; at least one.
    pub expectations: Vec<Expectation>,
}

/// The controller as a scenario asks for it.
#[derive(Debug, Clone, PartialEq)]
pub struct Controller {
    /// Control law by name.
    pub law: String,
    /// Control period, whole microseconds.
    pub period: Time,
    /// Excitation frequency at the start, Hz.
    pub start_frequency_hz: f64,
    /// Sampling to actuation.
    pub loop_delay: Time,
    /// What the law is told of it, whole microseconds, at most one period; zero for nothing.
    pub design_delay: Time,
    /// Design value of the 5 % response time, ms; the law's own where not given.
    pub response_time_ms: Option<f64>,
    /// Bound on the excitation frequency around its start, Hz.
    pub frequency_range_hz: f64,
    /// Bound on its change per period, Hz.
    pub frequency_slew_hz: f64,
    /// Gains instead of the law's own design.
    pub gains: Option<Gains>,
}

/// Gains of both loops; units as in the wire protocol.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gains {
    /// Vpp per µm.
    pub amplitude_kp: f64,
    /// Vpp per µm and second.
    pub amplitude_ki: f64,
    /// rad/s per unit of Wq/Wd.
    pub frequency_kp: f64,
    /// rad/s per unit of Wq/Wd and second.
    pub frequency_ki: f64,
}

/// How often a scenario is played.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trials {
    /// How often.
    pub count: u32,
    /// Up to how often, where a verdict needs more.
    pub max_count: u32,
    /// Seed of the first trial.
    pub seed: u64,
    /// What differs from trial to trial.
    pub spread: Spread,
}

impl Scenario {
    /// The file's name without its ending: what its traces are filed under.
    pub fn name(&self) -> &str {
        self.file.strip_suffix(".toml").unwrap_or(&self.file)
    }

    /// The tier that `model` names on a plate: `auto` is the exact one. `None` if the name is unknown.
    pub fn tier_for(model: &str, plate: &Plate) -> Option<Tier> {
        if model == AUTO_MODEL { Some(Tier::exact_for(plate)) } else { Tier::from_name(model) }
    }

    /// What differs from the nominal in the trial with number `index`, counted from 0.
    pub fn variation(&self, index: u32) -> Variation {
        Variation::draw(&self.trials.spread, self.trials.seed.wrapping_add(u64::from(index)))
    }

    /// True where no trial differs from another: nothing spreads and the sensor is silent.
    pub fn is_deterministic(&self) -> bool {
        self.trials.spread == Spread::default() && self.plate.noise_um_rms == 0.0
    }

    /// True where a fault that was planned, and that ends, explains that the controller did not answer at `time`.
    pub fn explains_silence(&self, time: Time) -> bool {
        self.faults.iter().any(|fault| fault.can_explain_silence(time, self.controller.period))
    }

    /// A diagnostic that points at `key` of the scenario file.
    pub fn diagnostic(&self, key: &str, message: impl Into<String>) -> Diagnostic {
        match self.inputs.first() {
            Some(input) => Diagnostic::at_key(&input.path, &String::from_utf8_lossy(&input.bytes), key, message),
            None => Diagnostic::for_file(self.file.as_ref(), message),
        }
    }
}
