//! Defines a scene: one or several plays of a judged trial, with other trials in between, on one
//! controller.
//!
//! Times and values are multiples of a small unit, so scenario files contain short numbers.

use crate::explore::line_fault::LineFault;
use crate::explore::tuning::Tuning;
use platebench_plate::{Mode, Plate};
use platebench_wire::LawId;
use std::f64::consts::TAU;

#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Trials between two plays of the judged trial.
    pub earlier: Vec<SceneTrial>,
    pub judged: SceneTrial,
    /// Number of plays of the judged trial. Each starts at another time stamp.
    pub count: u32,
    /// Seed of the scripts of messages before the judged trial. `None`: no scripts.
    pub script_seed: Option<u64>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct SceneTrial {
    pub law: LawId,
    /// Differences from the plate of the envelope.
    pub plate: PlateChoice,
    pub period_us: u32,
    /// Loop delay, µs. The law is configured with it.
    pub delay_us: u32,
    /// Excitation frequency at the start, 0.1 Hz.
    pub start_frequency_tenths: u32,
    pub duration_us: u32,
    /// Instants, µs, and setpoints, nm; each holds until the next one. The first instant is 0.
    pub setpoint: Vec<(u32, u32)>,
    /// Finger force, 0.01 N.
    pub force: Course,
    /// Temperature offset, 0.01 K.
    pub temperature: Course,
    pub tuning: Tuning,
    /// Empty in trials that are not judged.
    pub faults: Vec<LineFault>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PlateChoice {
    pub limit_vpp: u32,
    pub noise_pm: u32,
    /// Change of the gain from the envelope's plate, 0.1 %. The controller is configured with it.
    pub nominal_gain_permille: i32,
    /// Change of the time constant from the envelope's plate, 0.1 %; also configured in the
    /// controller.
    pub nominal_time_constant_permille: i32,
    /// Deviation of the gain from the configured gain, 0.1 %.
    pub gain_permille: i32,
    /// Deviation of the time constant from the configured one, 0.1 %.
    pub time_constant_permille: i32,
}

impl PlateChoice {
    /// The plate that the controller is configured for.
    #[must_use]
    pub const fn design(self) -> Self {
        Self { gain_permille: 0, time_constant_permille: 0, ..self }
    }

    pub fn apply(self, base: &Plate) -> Plate {
        let factor = |permille: i32| 1.0 + f64::from(permille) * 1e-3;
        Plate {
            gain: base.gain * factor(self.nominal_gain_permille) * factor(self.gain_permille),
            sigma0: base.sigma0 / (factor(self.nominal_time_constant_permille) * factor(self.time_constant_permille)),
            drive_limit_vpp: self.limit_vpp.into(),
            noise_um_rms: f64::from(self.noise_pm) * 1e-6,
            ..base.clone()
        }
    }
}

/// A force or temperature over time. The unit of all values is 0.01 N or 0.01 K.
#[derive(Debug, Clone, PartialEq)]
pub enum Course {
    /// Instants, µs, and values that hold until the next one. The first instant is 0.
    Hold(Vec<(u32, i32)>),
    /// Instants, µs, and values, linear in between. The first instant is 0.
    Linear(Vec<(u32, i32)>),
    /// `mean + amplitude · sin(2π f t)` with f in 0.1 Hz.
    Sine { mean: i32, amplitude: i32, frequency_tenths: u32 },
}

impl Course {
    /// Value in N or K. At the instant of a step it is the value after the step.
    pub fn at(&self, time_us: u32) -> f64 {
        match self {
            Self::Hold(points) => {
                let index = points.partition_point(|(at, _)| *at <= time_us).saturating_sub(1);
                points.get(index).map_or(0.0, |(_, value)| f64::from(*value) / 100.0)
            }
            Self::Linear(points) => {
                let next = points.partition_point(|(at, _)| *at <= time_us);
                let value = |index: usize| points.get(index).map(|(at, value)| (f64::from(*at), f64::from(*value)));
                match (value(next.saturating_sub(1)), value(next)) {
                    (Some((from, low)), Some((to, high))) => {
                        (low + (high - low) * (f64::from(time_us) - from) / (to - from)) / 100.0
                    }
                    (Some((_, last)), None) => last / 100.0,
                    (None, _) => 0.0,
                }
            }
            Self::Sine { mean, amplitude, frequency_tenths } => {
                let phase = TAU * f64::from(*frequency_tenths) * 0.1 * f64::from(time_us) * 1e-6;
                (f64::from(*mean) + f64::from(*amplitude) * phase.sin()) / 100.0
            }
        }
    }

    pub fn range(&self) -> [f64; 2] {
        match self {
            Self::Hold(points) | Self::Linear(points) => {
                let values = points.iter().map(|(_, value)| f64::from(*value) / 100.0);
                [values.clone().fold(f64::INFINITY, f64::min), values.fold(f64::NEG_INFINITY, f64::max)]
            }
            Self::Sine { mean, amplitude, .. } => {
                [mean - amplitude.abs(), mean + amplitude.abs()].map(|value| f64::from(value) / 100.0)
            }
        }
    }

    /// Intervals, µs, in which the value changes. Start and end of a step are equal.
    pub fn moves(&self) -> Vec<[u32; 2]> {
        match self {
            Self::Hold(points) => {
                points.array_windows().filter(|[a, b]| a.1 != b.1).map(|[_, (at, _)]| [*at; 2]).collect()
            }
            Self::Linear(points) => {
                points.array_windows().filter(|[a, b]| a.1 != b.1).map(|[from, to]| [from.0, to.0]).collect()
            }
            Self::Sine { amplitude: 0, .. } => Vec::new(),
            Self::Sine { .. } => vec![[0, u32::MAX]],
        }
    }
}

impl SceneTrial {
    /// In µm.
    pub fn setpoint_at(&self, time_us: u32) -> f64 {
        let index = self.setpoint.partition_point(|(at, _)| *at <= time_us).saturating_sub(1);
        self.setpoint.get(index).map_or(0.0, |(_, level)| f64::from(*level) / 1e3)
    }

    pub fn mode_at(&self, base: &Plate, time_us: u32) -> Mode {
        let conditions = platebench_plate::Conditions {
            temperature_offset_k: self.temperature.at(time_us),
            finger_force_n: self.force.at(time_us),
        };
        self.plate.apply(base).mode(&conditions)
    }

    /// Largest setpoint, nm, that needs at most `share` of the drive limit under the largest force.
    pub fn largest_setpoint_nm(&self, base: &Plate, share: f64) -> u32 {
        let plate = self.plate.apply(base);
        let ratio = plate.damping_ratio_at(self.force.range()[1]);
        (share * plate.drive_limit_vpp * plate.gain / ratio * 1e3) as u32
    }
}
