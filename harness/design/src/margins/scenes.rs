//! Builds the scenes of a search for margins from a scenario, and decides whether a loop is stable.

use platebench_model::scenario::load::ScenarioTemplate;
use platebench_model::scenario::{Diagnostic, LoopInsertion, Scenario, Spread, Trials};
use platebench_model::trace::Row;
use platebench_plate::{Complex64, ConditionProfiles, Profile, Time};
use schemars::JsonSchema;
use serde::Serialize;
use std::f64::consts::TAU;
use toml::Value;

/// Periods from the start to the insertion, and from the insertion to the end.
const START_PERIODS: u64 = 400;
const INSERTED_PERIODS: u64 = 1_600;
/// Periods after the insertion before the first of the two compared windows.
const TRANSIENT_PERIODS: u64 = 40;
const WINDOW_PERIODS: u64 = 100;
/// Half width of the band around the mean of |W| and of W, as a share of the mean of |W|.
const BAND: f64 = 0.05;
/// Spread of W in the last window over that in an earlier one, from which on the motion grows.
const GROWTH: f64 = 2.0;
/// Spread of W below which nothing grows, as a share of |W|: the resolution of the wire.
const RESOLUTION: f64 = 2e-4;
/// Smallest mean of |W| of a working loop, as a share of the setpoint.
const MIN_AMPLITUDE: f64 = 0.05;
/// Steps that excite the loops at the insertion: of the setpoint, as a share of it, and of τΔω. They
/// are small, because laws that identify the plate must not take them for another plate.
const SETPOINT_STEP: f64 = 3e-3;
const DETUNING_STEP: f64 = 1e-2;
/// Sensor noise of a trial for the noise gain as a share of the setpoint, if the plate has none.
const NOISE: f64 = 4e-3;

/// What the text of a result states about stability.
pub const STABILITY_RULE: &str = "Stable: gain or delay are inserted into the steady state, with steps of 0.3 % of \
    the setpoint and of 0.01 in τΔω. In the last 100 of 1600 periods the amplitude stays within 5 % of its mean, and \
    Wd and Wq deviate from their means by at most 5 % of it (or twice as much as before the insertion) and by at most \
    twice as much as in 100 periods at the start. Detuning and force act from the start.";

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct OperatingPoint {
    pub period_ms: f64,
    /// Highest setpoint.
    pub setpoint_um: f64,
    /// Resonance minus excitation frequency at the start.
    pub detuning_hz: f64,
    pub force_n: f64,
}

impl OperatingPoint {
    pub fn of(scenario: &Scenario) -> Self {
        Self {
            period_ms: scenario.controller.period.ms(),
            setpoint_um: scenario.setpoint.range().1,
            // Start frequencies are on the wire in mHz.
            detuning_hz: ((resonance_hz(scenario) - scenario.controller.start_frequency_hz) * 1e3).round() / 1e3,
            force_n: scenario.conditions.at(Time::ZERO).finger_force_n,
        }
    }

    pub const fn coordinates(&self) -> [f64; 4] {
        [self.period_ms, self.setpoint_um, self.detuning_hz, self.force_n]
    }
}

fn resonance_hz(scenario: &Scenario) -> f64 {
    scenario.plate.mode(&scenario.conditions.at(Time::ZERO)).omega0 / TAU
}

/// `None` keeps the value of the scenario.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PointChoice {
    pub period_ms: Option<f64>,
    pub setpoint_um: Option<f64>,
    pub detuning_hz: Option<f64>,
    pub force_n: Option<f64>,
}

impl PointChoice {
    pub fn scenario(&self, template: &ScenarioTemplate, law: &str) -> Result<Scenario, Vec<Diagnostic>> {
        let first_step = template.scenario.setpoint.next_point_after(Time::ZERO).map_or(1.0, Time::ms);
        let step = |setpoint: f64| {
            let points = [[0.0, 0.0], [first_step, setpoint]].map(|point| Value::from(point.to_vec()));
            Value::Table([("hold".to_owned(), Value::from(points.to_vec()))].into_iter().collect())
        };
        let changes = [
            ("controller.period_ms", self.period_ms.map(Value::Float)),
            ("profile.setpoint_um", self.setpoint_um.map(step)),
            ("profile.finger_force_n", self.force_n.map(Value::Float)),
        ];
        let changes = changes.into_iter().filter_map(|(key, value)| Some((key, value?)));
        let tables = template.tables(changes).map_err(|fault| vec![template.scenario.diagnostic("profile", fault)])?;
        let mut scenario = template.check(&tables)?;
        if let Some(detuning) = self.detuning_hz {
            scenario.controller.start_frequency_hz = resonance_hz(&scenario) - detuning;
        }
        scenario.set_law(law);
        scenario.trials = Trials { count: 1, max_count: 1, ..scenario.trials };
        Ok(scenario)
    }
}

/// What a search changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, JsonSchema, strum::IntoStaticStr)]
#[serde(rename_all = "kebab-case")]
#[strum(const_into_str, serialize_all = "kebab-case")]
pub enum Quantity {
    /// Factor between the drive that the controller commands and the amplitude.
    DriveGain,
    /// Factor on the deviation of the excitation frequency.
    FrequencyGain,
    /// Additional loop delay, control periods.
    Delay,
    /// Resonance minus excitation frequency at the start, upwards, Hz.
    DetuningUp,
    /// The same downwards.
    DetuningDown,
    /// Force of the finger, N.
    Force,
}

impl Quantity {
    pub const ALL: [Self; 6] =
        [Self::DriveGain, Self::FrequencyGain, Self::Delay, Self::DetuningUp, Self::DetuningDown, Self::Force];

    /// Name in options.
    pub const fn key(self) -> &'static str {
        self.into_str()
    }

    /// Name in texts.
    pub const fn name(self) -> &'static str {
        match self {
            Self::DriveGain => "gain margin of the drive",
            Self::FrequencyGain => "gain margin of the frequency",
            Self::Delay => "delay margin, periods",
            Self::DetuningUp => "highest detuning, Hz",
            Self::DetuningDown => "lowest detuning, Hz",
            Self::Force => "largest force, N",
        }
    }

    /// Value that changes nothing.
    pub(super) const fn identity(self) -> f64 {
        match self {
            Self::DriveGain | Self::FrequencyGain => 1.0,
            Self::Delay | Self::DetuningUp | Self::DetuningDown | Self::Force => 0.0,
        }
    }

    /// Ascending values at which a search looks for the first failure.
    pub(super) fn scan(self, scenario: &Scenario) -> Vec<f64> {
        let even = |step: f64, count: u32| (1..=count).map(|n| step * f64::from(n)).collect::<Vec<_>>();
        let growing = |from: f64, count: i32| (1..=count).map(move |n| from * 1.25_f64.powi(n));
        match self {
            Self::DriveGain | Self::FrequencyGain => growing(1.0, 14).collect(),
            Self::Delay => even(0.25, 8).into_iter().chain(growing(2.0, 8)).collect(),
            Self::DetuningUp | Self::DetuningDown => even(scenario.controller.frequency_range_hz / 8.0, 10),
            Self::Force => even(0.5, 8).into_iter().chain(growing(4.0, 6)).collect(),
        }
    }

    /// Width of the interval at which a search ends.
    pub(super) fn resolution(self, scenario: &Scenario, high: f64) -> f64 {
        match self {
            Self::DriveGain | Self::FrequencyGain | Self::Delay => 0.002 * high,
            Self::DetuningUp | Self::DetuningDown => scenario.controller.frequency_range_hz / 500.0,
            Self::Force => 0.01,
        }
    }

    /// Applies `value` from the start or, for gains and delay, from `from` on.
    pub(super) fn apply(self, scenario: &mut Scenario, value: f64, from: Time) {
        let controller = &mut scenario.controller;
        let insertion = controller.insertion.get_or_insert(LoopInsertion::none_from(from));
        match self {
            // From the start, the plate itself answers more strongly, so that its drive limit stays.
            Self::DriveGain if from == Time::ZERO => {
                controller.design_plate.get_or_insert_with(|| scenario.plate.clone());
                scenario.plate.gain *= value;
            }
            Self::DriveGain => insertion.drive_gain = value,
            Self::FrequencyGain => insertion.frequency_gain = value,
            Self::Delay => {
                insertion.delay = Time::from_seconds(value * controller.period.seconds()).unwrap_or_default();
            }
            Self::DetuningUp => controller.start_frequency_hz -= value,
            Self::DetuningDown => controller.start_frequency_hz += value,
            Self::Force => {
                let force_n = scenario.conditions.at(Time::ZERO).finger_force_n + value;
                scenario.conditions.finger_force_n = Profile::constant(force_n);
            }
        }
    }

    /// Value in a result: the absolute detuning or force.
    pub(super) fn absolute(self, point: &OperatingPoint, value: f64) -> f64 {
        match self {
            Self::DriveGain | Self::FrequencyGain | Self::Delay => value,
            Self::DetuningUp => point.detuning_hz + value,
            Self::DetuningDown => point.detuning_hz - value,
            Self::Force => point.force_n + value,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Criterion {
    /// Every expectation of the scenario holds.
    Requirement,
    /// See [`is_stable`].
    Stability,
}

/// A step to the setpoint, then an insertion into the steady state.
pub(super) fn steady_scene(scenario: &Scenario) -> Scenario {
    let (plate, period) = (&scenario.plate, scenario.controller.period);
    let (from, setpoint) = (insertion_time(scenario), scenario.setpoint.range().1);
    let at = scenario.conditions.at(Time::ZERO);
    // A plate whose resonance does not depend on temperature gets no step of it.
    let warmer = DETUNING_STEP * plate.mode(&at).sigma / plate.omega0_per_k.abs();
    let warmer = if warmer.is_finite() { warmer } else { 0.0 };
    let offset = at.temperature_offset_k;
    Scenario {
        setpoint: Profile::Hold(vec![(Time::ZERO, 0.0), (period, setpoint), (from, setpoint * (1.0 + SETPOINT_STEP))]),
        conditions: ConditionProfiles {
            temperature_offset_k: Profile::Hold(vec![(Time::ZERO, offset), (from, offset + warmer)]),
            finger_force_n: Profile::constant(at.finger_force_n),
        },
        duration: from + period.times(INSERTED_PERIODS),
        trace_step: period,
        trials: Trials { spread: Spread::default(), ..scenario.trials },
        faults: Vec::new(),
        chip_faults: Vec::new(),
        between: Vec::new(),
        other_trials: None,
        messages: Vec::new(),
        expectations: Vec::new(),
        ..scenario.clone()
    }
}

pub(super) fn insertion_time(scenario: &Scenario) -> Time {
    scenario.controller.period.times(START_PERIODS)
}

/// The steady state with sensor noise and without a disturbance.
pub(super) fn noise_scene(scenario: &Scenario, seed: u64) -> Scenario {
    let mut scene = steady_scene(scenario);
    let setpoint = scenario.setpoint.range().1;
    scene.setpoint = Profile::Hold(vec![(Time::ZERO, 0.0), (scenario.controller.period, setpoint)]);
    let offset = scenario.conditions.at(Time::ZERO).temperature_offset_k;
    scene.conditions.temperature_offset_k = Profile::constant(offset);
    if scene.plate.noise_um_rms == 0.0 {
        scene.controller.design_plate.get_or_insert_with(|| scenario.plate.clone());
        scene.plate.noise_um_rms = NOISE * setpoint;
    }
    scene.trials.seed = scene.trials.seed.wrapping_add(seed);
    scene
}

/// Vibration W from `from` to before `to`.
pub(super) fn vibration(rows: &[Row], from: Time, to: Time) -> Vec<Complex64> {
    let inside = |row: &&Row| (from.seconds()..to.seconds()).contains(&row.t_s);
    rows.iter().filter(inside).map(|row| Complex64::new(row.wd_um, row.wq_um)).collect()
}

/// Applies [`STABILITY_RULE`] to the rows of a [`steady_scene`].
pub(super) fn is_stable(scene: &Scenario, rows: &[Row]) -> bool {
    let window = scene.controller.period.times(WINDOW_PERIODS);
    let inserted = insertion_time(scene);
    let vibration = |from: Time| vibration(rows, from, from + window);
    let before = spread(&vibration(inserted - window));
    let early = spread(&vibration(inserted + scene.controller.period.times(TRANSIENT_PERIODS)));
    let last = vibration(scene.duration - window);
    let mean = last.iter().map(|w| w.norm()).sum::<f64>() / last.len() as f64;
    let is_in_band = last.iter().all(|w| (w.norm() - mean).abs() <= BAND * mean);
    let hunting = GROWTH * before;
    let late = spread(&last);
    mean >= MIN_AMPLITUDE * scene.setpoint.range().1
        && is_in_band
        && late <= hunting.max(BAND * mean)
        && late <= hunting.max(GROWTH * early).max(RESOLUTION * mean)
}

/// Largest distance from the mean. Infinite without values.
fn spread(vibration: &[Complex64]) -> f64 {
    let mean = vibration.iter().sum::<Complex64>() / vibration.len() as f64;
    vibration.iter().map(|w| (w - mean).norm()).reduce(f64::max).unwrap_or(f64::INFINITY)
}
