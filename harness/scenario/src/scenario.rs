//! Defines a checked scenario.

use crate::bounds::MAX_SPREAD_PERCENT;
use crate::diagnostic::Diagnostic;
use crate::expect::Expectation;
use crate::fault::Fault;
use platebench_plate::{ConditionProfiles, Plate, Profile, Tier, Time};
use schemars::JsonSchema;
use serde::Deserialize;
use std::path::PathBuf;

/// The name of the model that is exact for the plate file.
pub const AUTO_MODEL: &str = "auto";

/// An input file of a scenario.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputFile {
    /// Its path.
    pub path: PathBuf,
    /// Its content.
    pub bytes: Vec<u8>,
}

/// A checked scenario.
#[derive(Debug, Clone)]
pub struct Scenario {
    /// The file's name below the scenario folder, with `/`: `paper/fig13-closed-loop.toml`.
    pub file: String,
    /// Every input file; the scenario file is the first.
    pub inputs: Vec<InputFile>,
    /// One line of text.
    pub title: String,
    /// Its source, such as a figure of the paper.
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
    /// The exit code of a scenario of a known limit.
    pub expected_exit: Option<u8>,
    /// The controller and its timing.
    pub controller: Controller,
    /// Setpoint of the amplitude, µm.
    pub setpoint: Profile,
    /// Temperature and finger force.
    pub conditions: ConditionProfiles,
    /// Number and spread of the trials.
    pub trials: Trials,
    /// Planned faults of line and sensor.
    pub faults: Vec<Fault>,
    /// At least one.
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
    /// Loop delay that the law is designed for, whole microseconds, at most one period.
    pub design_delay: Time,
    /// Design value of the 5 % response time, ms; `None` for the law's own.
    pub response_time_ms: Option<f64>,
    /// Bound on the excitation frequency around its start, Hz.
    pub frequency_range_hz: f64,
    /// Bound on its change per period, Hz.
    pub frequency_slew_hz: f64,
    /// Gains instead of the law's own design.
    pub gains: Option<Gains>,
}

/// `[controller.gains]`: gains of both loops.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Gains {
    /// Amplitude loop, Vpp per µm.
    pub amplitude_kp: f64,
    /// Amplitude loop, Vpp per µm and second.
    pub amplitude_ki: f64,
    /// Frequency loop, rad/s per unit of Wq/Wd.
    pub frequency_kp: f64,
    /// Frequency loop, rad/s per unit of Wq/Wd and second.
    pub frequency_ki: f64,
}

/// Number and spread of the trials.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trials {
    /// Planned number.
    pub count: u32,
    /// Largest number, if a verdict needs more.
    pub max_count: u32,
    /// Seed of the first trial.
    pub seed: u64,
    /// Differences between trials.
    pub spread: Spread,
}

/// `[trials.spread]`: standard deviations from trial to trial.
#[derive(Debug, Clone, Copy, PartialEq, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Spread {
    /// Of the plate's gain K1, percent.
    #[schemars(range(min = 0.0, max = MAX_SPREAD_PERCENT))]
    pub gain_percent: f64,
    /// Of the plate's time constant, percent.
    #[schemars(range(min = 0.0, max = MAX_SPREAD_PERCENT))]
    pub time_constant_percent: f64,
    /// Of the sensor's gain, percent.
    #[schemars(range(min = 0.0, max = MAX_SPREAD_PERCENT))]
    pub sensor_gain_percent: f64,
    /// Of the temperature, kelvin.
    #[schemars(range(min = 0.0, max = MAX_SPREAD_PERCENT))]
    pub temperature_k: f64,
}

impl Scenario {
    /// The file's name without its extension, as in the run folder.
    pub fn name(&self) -> &str {
        self.file.strip_suffix(".toml").unwrap_or(&self.file)
    }

    /// The tier that `model` names on a plate: `auto` is the exact one. `None` if the name is
    /// unknown.
    pub fn tier_for(model: &str, plate: &Plate) -> Option<Tier> {
        if model == AUTO_MODEL { Some(Tier::exact_for(plate)) } else { Tier::from_name(model) }
    }

    /// True if all trials are equal: no spread and no sensor noise.
    pub fn is_deterministic(&self) -> bool {
        self.trials.spread == Spread::default() && self.plate.noise_um_rms == 0.0
    }

    /// True if a planned fault that ends explains a missing answer at `time`.
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
