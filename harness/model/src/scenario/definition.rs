//! Defines a checked scenario, and draws the plate, sensor and temperature of a trial from its seed.
//! `raw.rs` describes the keys.

use crate::metrics::{Metric, TrialRule};
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::expect::Expectation;
use crate::scenario::fault::ChipFault;
use crate::scenario::fault::Fault;
use crate::scenario::matrix::Source;
use crate::scenario::message::ScenarioMessage;
use crate::scenario::own_law::NotApplicableExpectation;
use platebench_plate::{ConditionProfiles, Model, Plant, Plate, Profile, Sensor, Time};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

pub const AUTO_MODEL: &str = "auto";
/// Largest number of trials of a scenario, in its file and on the command line.
pub const MAX_TRIALS: u32 = 100_000;
/// Longest time limit of a scenario, in its file and on the command line: one week.
pub const MAX_TIMEOUT_S: f64 = 604_800.0;
const MAX_SPREAD_PERCENT: f64 = 20.0;

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputFile {
    pub path: PathBuf,
    pub bytes: Vec<u8>,
}

#[derive(Debug, Clone)]
pub struct Scenario {
    /// Path below the scenario folder with `/`, for example `paper/fig13-closed-loop.toml`.
    pub file: String,
    /// Name of the case if the file has a `[matrix]`.
    pub case: Option<String>,
    /// All input files. The first is the scenario file.
    pub inputs: Vec<InputFile>,
    pub title: String,
    pub source: Option<String>,
    pub tags: Vec<String>,
    pub plate: Plate,
    pub model: Model,
    pub duration: Time,
    pub trace_step: Time,
    /// Reason why the scenario is played only if it or its own folder is named.
    pub only_if_named: Option<String>,
    pub expected_exit: Option<u8>,
    /// Wall time after which a run ends the trials of the scenario, s.
    pub timeout_s: Option<f64>,
    pub controller: Controller,
    /// Setpoint of the amplitude, µm.
    pub setpoint: Profile,
    pub conditions: ConditionProfiles,
    pub trials: Trials,
    pub faults: Vec<Fault>,
    pub chip_faults: Vec<ChipFault>,
    pub between: Vec<Self>,
    /// Scene of every trial but the first. Its trials and its number of expectations are those of the
    /// scenario.
    pub other_trials: Option<Box<Self>>,
    /// Messages before every trial, instead of the scripts of the protocol check.
    pub messages: Vec<ScenarioMessage>,
    pub expectations: Vec<Expectation>,
    /// Expectations of the file that are not judged, because the law is the controller's own.
    pub not_applicable: Vec<NotApplicableExpectation>,
    /// Texts from `requirements.toml` by the identifier of the requirement.
    pub requirement_texts: BTreeMap<String, String>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Controller {
    pub law: String,
    /// Control period, a whole number of microseconds.
    pub period: Time,
    pub start_frequency_hz: f64,
    pub loop_delay: Time,
    pub loop_delay_jitter: Time,
    /// Loop delay that the law is designed for, whole microseconds, at most one period.
    pub design_delay: Time,
    /// 5 % response time that the law is designed for. `None` selects the law's default.
    pub response_time_ms: Option<f64>,
    pub frequency_range_hz: f64,
    pub frequency_slew_hz: f64,
    pub gains: Option<ScenarioGains>,
    pub design_plate: Option<Plate>,
    /// Change of the loop that a search for margins inserts. No scenario file contains it.
    pub insertion: Option<LoopInsertion>,
}

/// Gains and a delay between controller and plate from an instant on. A gain multiplies the
/// deviation from the mean of the last [`Self::AVERAGED_PERIODS`] before the instant, so the steady
/// state stays. Without a command before the instant, the reference is 0 V and the start frequency.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopInsertion {
    pub from: Time,
    pub drive_gain: f64,
    pub frequency_gain: f64,
    pub delay: Time,
}

impl LoopInsertion {
    pub const AVERAGED_PERIODS: u64 = 100;

    pub const fn none_from(from: Time) -> Self {
        Self { from, drive_gain: 1.0, frequency_gain: 1.0, delay: Time::ZERO }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ScenarioGains {
    /// Amplitude loop, Vpp per µm.
    pub amplitude_kp: f64,
    /// Amplitude loop, Vpp per µm and second.
    pub amplitude_ki: f64,
    /// Frequency loop, rad/s per unit of Wq/Wd.
    pub frequency_kp: f64,
    /// Frequency loop, rad/s per unit of Wq/Wd and second.
    pub frequency_ki: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trials {
    pub count: u32,
    pub max_count: u32,
    pub seed: u64,
    pub spread: Spread,
}

/// Standard deviations from trial to trial.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Spread {
    /// Spread of the plate's gain K1, percent.
    #[schemars(range(min = 0.0, max = MAX_SPREAD_PERCENT))]
    pub gain_percent: f64,
    /// Spread of the plate's time constant, percent.
    #[schemars(range(min = 0.0, max = MAX_SPREAD_PERCENT))]
    pub time_constant_percent: f64,
    /// Spread of the sensor's gain, percent.
    #[schemars(range(min = 0.0, max = MAX_SPREAD_PERCENT))]
    pub sensor_gain_percent: f64,
    /// Spread of the temperature, kelvin.
    #[schemars(range(min = 0.0, max = MAX_SPREAD_PERCENT))]
    pub temperature_k: f64,
}

impl Scenario {
    /// [`Self::file`] without its extension. The folder of its traces has this name.
    pub fn name(&self) -> &str {
        self.file.strip_suffix(".toml").unwrap_or(&self.file)
    }

    /// True if one controller plays all trials in order, because its history is tested.
    pub fn keeps_controller(&self) -> bool {
        let compares_trials = |expectation: &Expectation| expectation.metric.spec().trials == TrialRule::FromFirst;
        !self.between.is_empty() || self.expectations.iter().any(compares_trials)
    }

    /// True if the messages start before the first configuration of a controller.
    pub fn needs_new_controller(&self) -> bool {
        !matches!(self.messages.first(), None | Some(ScenarioMessage::Configure(_)))
    }

    /// The scene of trial `index`.
    pub fn of_trial(&self, index: u32) -> &Self {
        self.other_trials.as_deref().filter(|_| index > 0).unwrap_or(self)
    }

    pub fn expects(&self, metric: Metric) -> bool {
        self.expectations.iter().any(|expectation| expectation.metric == metric)
    }

    pub fn design_plate(&self) -> &Plate {
        self.controller.design_plate.as_ref().unwrap_or(&self.plate)
    }

    pub(crate) fn models() -> [&'static str; 5] {
        let [linear, envelope, modal, carrier] = Model::ALL.map(Model::name);
        [AUTO_MODEL, linear, envelope, modal, carrier]
    }

    /// Model named `name`. `auto` selects the exact model for `plate`. `None` if the name is unknown.
    pub fn model_for(name: &str, plate: &Plate) -> Option<Model> {
        if name == AUTO_MODEL { Some(Model::exact_for(plate)) } else { Model::from_name(name) }
    }

    pub fn omitted_effect(model: Model, plate: &Plate) -> Option<String> {
        let effect = plate.first_effect().filter(|_| !model.has_both_poles())?;
        let [auto, modal, carrier] = [AUTO_MODEL, Model::Modal.name(), Model::Carrier.name()];
        Some(format!(
            "the model {} omits `{effect}` of the plate file, expected {auto}, {modal} or {carrier}",
            model.name()
        ))
    }

    pub fn is_deterministic(&self) -> bool {
        self.trials.spread == Spread::default()
            && self.plate.noise_um_rms == 0.0
            && self.other_trials.as_ref().is_none_or(|others| others.plate.noise_um_rms == 0.0)
            && !self.chip_faults.iter().any(ChipFault::is_random)
    }

    /// True if a planned fault that ends explains a missing answer at `time`.
    pub fn explains_silence(&self, time: Time) -> bool {
        self.faults.iter().any(|fault| fault.can_explain_silence(time, self.controller.period))
    }

    pub fn diagnostic(&self, key: &str, message: impl Into<String>) -> Diagnostic {
        match self.inputs.first() {
            Some(input) => {
                let text = String::from_utf8_lossy(&input.bytes);
                let source = Source { path: &input.path, text: &text, case: self.case.as_deref() };
                source.diagnostic(key, message)
            }
            None => Diagnostic::for_file(self.file.as_ref(), message),
        }
    }
}

/// Number of the random stream. The sensor's noise has another stream, so that either one can be
/// switched off without a change of the other.
const SPREAD_STREAM: u64 = 1;
/// Largest deviation of a factor from 1: 4.5 standard deviations of the largest spread, 20 %.
const MAX_DEVIATION: f64 = 0.9;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Variation {
    pub seed: u64,
    /// Factor on the plate's gain K1.
    pub gain: f64,
    /// Factor on the plate's time constant τ.
    pub time_constant: f64,
    pub sensor_gain: f64,
    pub temperature_k: f64,
}

impl Variation {
    pub fn of_trial(scenario: &Scenario, index: u32) -> Self {
        Self::draw(&scenario.trials.spread, scenario.trials.seed.wrapping_add(u64::from(index)))
    }

    pub fn draw(spread: &Spread, seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(SPREAD_STREAM);
        let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
        let mut factor = |percent: f64| 1.0 + (normal() * percent / 100.0).clamp(-MAX_DEVIATION, MAX_DEVIATION);
        Self {
            seed,
            gain: factor(spread.gain_percent),
            time_constant: factor(spread.time_constant_percent),
            sensor_gain: factor(spread.sensor_gain_percent),
            temperature_k: normal() * spread.temperature_k,
        }
    }

    pub fn plate(&self, nominal: &Plate) -> Plate {
        Plate { gain: nominal.gain * self.gain, sigma0: nominal.sigma0 / self.time_constant, ..nominal.clone() }
    }

    pub fn plant(&self, scenario: &Scenario) -> Plant {
        let scene = ConditionProfiles {
            temperature_offset_k: shift_profile(&scenario.conditions.temperature_offset_k, self.temperature_k),
            finger_force_n: scenario.conditions.finger_force_n.clone(),
        };
        Plant::new(self.plate(&scenario.plate), scene, scenario.model)
    }

    pub fn sensor(&self, scenario: &Scenario) -> Sensor {
        Sensor::new(self.sensor_gain, scenario.plate.noise_um_rms, self.seed).with_resolution(scenario.plate.resolution)
    }
}

fn shift_profile(profile: &Profile, by: f64) -> Profile {
    let moved = |points: &[_]| points.iter().map(|(time, value)| (*time, value + by)).collect();
    match profile {
        Profile::Hold(points) => Profile::Hold(moved(points)),
        Profile::Linear(points) => Profile::Linear(moved(points)),
        Profile::Sine { mean, amplitude, omega, sweep, phase, bandwidth } => Profile::Sine {
            mean: mean + by,
            amplitude: *amplitude,
            omega: *omega,
            sweep: *sweep,
            phase: *phase,
            bandwidth: *bandwidth,
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_have_their_deviation_and_follow_their_seed() {
        let spread = Spread { sensor_gain_percent: 1.2, temperature_k: 0.5, ..Spread::default() };
        let trials: Vec<_> = (0..10_000).map(|seed| Variation::draw(&spread, seed)).collect();
        let deviation = |of: fn(&Variation) -> f64| {
            (trials.iter().map(|trial| of(trial).powi(2)).sum::<f64>() / trials.len() as f64).sqrt()
        };
        // Three standard errors of a standard deviation over 10 000 draws: 2.1 %.
        assert!((deviation(|trial| trial.sensor_gain - 1.0) / 0.012 - 1.0).abs() < 0.021);
        assert!((deviation(|trial| trial.temperature_k) / 0.5 - 1.0).abs() < 0.021);
        assert!(trials.iter().all(|trial| trial.gain == 1.0 && trial.time_constant == 1.0));
        assert_eq!(trials[7], Variation::draw(&spread, 7));
    }

    #[test]
    fn one_spread_does_not_move_another() {
        let only = Variation::draw(&Spread { sensor_gain_percent: 1.0, ..Spread::default() }, 3);
        let both = Variation::draw(&Spread { sensor_gain_percent: 1.0, gain_percent: 5.0, ..Spread::default() }, 3);
        assert_eq!(only.sensor_gain, both.sensor_gain);
    }
}
