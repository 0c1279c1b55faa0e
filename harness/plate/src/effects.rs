//! Lists the optional effects of a plate. Each has a file in this folder: its table of the plate
//! file, its numbers, and its functions during a trial ([`crate::effect`]).

mod amplifier;
mod heating;
mod second_mode;
mod sensor;

pub use amplifier::{Amplifier, DriveConverter, RawDrive};
pub use heating::{Heating, RawHeating};
pub use second_mode::{RawSecondMode, SecondMode};
pub use sensor::{ConverterResolution, RawSensor, Sensor, SensorElectronics};

use crate::effect::{ActiveEffect, Effect, HIGHEST_RESONANCE_HZ, PlateError};
use crate::flow::{ExponentialSum, Forcing, State};
use crate::mode::Drive;
use crate::motion::{FrozenMotion, PerMode};
use crate::time::Time;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

macro_rules! effects {
    ($($(#[$attribute:meta])* $name:ident: $effect:ty = $key:ident: $table:ty,)*) => {
        /// The optional effects of a plate.
        #[derive(Debug, Clone, Copy, PartialEq, Default)]
        pub struct Effects {
            $(pub $name: $effect,)*
        }

        impl Effects {
            pub(crate) fn check(raw: &RawPlate) -> Result<Self, PlateError> {
                Ok(Self { $($name: Effect::check(&raw.$key)?,)* })
            }

            pub(crate) fn list(&self) -> impl Iterator<Item = &dyn Effect> {
                [$(&self.$name as &dyn Effect,)*].into_iter()
            }
        }

        /// The plate file, unchecked.
        #[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
        #[serde(deny_unknown_fields)]
        pub struct RawPlate {
            /// Name of the plate.
            pub name: String,
            /// Origin of the numbers, such as a publication or a measurement.
            pub source: String,
            /// The bending mode.
            pub mode: RawMode,
            /// Effect of a finger; none by default.
            #[serde(default, skip_serializing_if = "is_default")]
            pub finger: RawFinger,
            $($(#[$attribute])* pub $key: $table,)*
            /// Uncertainty of the numbers; unknown by default.
            #[serde(default, skip_serializing_if = "is_default")]
            pub uncertainty: Uncertainty,
        }
    };
}

// `field of Effects: type = table of the plate file: type`, with the documentation of the table. Drives
// and readings pass the effects in this order.
effects! {
    /// Another bending mode that the drive excites and the sensor measures; none by default.
    second_mode: Option<SecondMode> = second_mode: Option<RawSecondMode>,
    /// Warming by the plate's own vibration; none by default.
    heating: Option<Heating> = heating: Option<RawHeating>,
    /// The amplifier.
    amplifier: Amplifier = drive: RawDrive,
    /// The sensor; without noise by default.
    #[serde(default, skip_serializing_if = "is_default")]
    sensor: SensorElectronics = sensor: RawSensor,
}

/// `[mode]`
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawMode {
    /// Resonance at the reference temperature, Hz.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = HIGHEST_RESONANCE_HZ))]
    pub resonance_hz: f64,
    /// Temperature at an offset of 0 K, °C.
    #[schemars(extend("exclusiveMinimum" = -273.15))]
    pub reference_temperature_c: f64,
    /// Change of the resonance per kelvin, Hz.
    pub resonance_slope_hz_per_k: f64,
    /// Time constant τ = 1/σ of the untouched plate, ms.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub time_constant_ms: f64,
    /// Gain K1 of the untouched plate at resonance, µm/Vpp.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub gain_um_per_vpp: f64,
}

/// `[finger]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawFinger {
    /// Points [force in N, σ/σ0], linear in between; the last segment is extended to any force.
    #[serde(default = "unit_damping")]
    #[schemars(length(min = 1))]
    pub damping_ratio: Vec<[f64; 2]>,
    /// Change of the resonance per newton, Hz.
    #[serde(default)]
    pub resonance_shift_hz_per_n: f64,
}

/// Used as `skip_serializing_if` of keys that are absent if they have their default.
pub fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

impl Default for RawFinger {
    fn default() -> Self {
        Self { damping_ratio: unit_damping(), resonance_shift_hz_per_n: 0.0 }
    }
}

fn unit_damping() -> Vec<[f64; 2]> {
    vec![[0.0, 1.0]]
}

/// `[uncertainty]`
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Uncertainty {
    /// Half width of the 95 % interval of K1, percent.
    #[schemars(range(min = 0.0))]
    pub gain_percent: Option<f64>,
    /// Half width of the 95 % interval of τ, percent.
    #[schemars(range(min = 0.0))]
    pub time_constant_percent: Option<f64>,
}

/// The effects during a trial, with the state of each mode.
#[derive(Debug, Clone)]
pub(crate) struct ActiveEffects {
    pub(crate) list: Vec<Box<dyn ActiveEffect>>,
    pub(crate) states: PerMode<State>,
    /// Last command of the controller, which may not act yet.
    pub(crate) command: Drive,
}

impl ActiveEffects {
    pub(crate) fn start(effects: &Effects) -> Self {
        Self {
            list: effects.list().filter(|effect| effect.key().is_some()).filter_map(Effect::start).collect(),
            states: PerMode { first: State::default(), second: effects.second_mode.map(|_| State::default()) },
            command: Drive::default(),
        }
    }

    /// Drive from `now` on, and its end if it has one.
    pub(crate) fn shape(&self, vpp: f64, now: Time) -> (Forcing, Option<Time>) {
        let input = (Forcing { constant: vpp, ..Forcing::default() }, None::<Time>);
        self.list.iter().fold(input, |(forcing, end), effect| {
            let (forcing, until) = effect.shape(forcing, now);
            (forcing, end.into_iter().chain(until).min())
        })
    }

    /// Computes the temperature rise at the middle and at the end of a step. `motion` has the modes
    /// of the middle.
    pub(crate) fn predict(&mut self, motion: &FrozenMotion, omega: f64, middle: Time, seconds: f64) {
        let (_, terms) = motion.terms();
        self.list.iter_mut().for_each(|effect| effect.predict(&terms, omega, middle.seconds(), seconds));
    }

    /// Temperature rise in K after a part of the present step of length `whole`: the parabola
    /// through start, middle and end.
    pub(crate) fn rise_k_after(&self, part: Time, whole: Time) -> f64 {
        let [start, middle, end] = self.temperature_rise_k();
        let half = (whole.as_nanos() / 2) as f64 / whole.as_nanos() as f64;
        if start == middle && middle == end {
            return start;
        }
        let x = part.seconds() / whole.seconds();
        // A step of 1 ns has no middle.
        let bend = if half > 0.0 { ((end - start) - (middle - start) / half) / (1.0 - half) } else { 0.0 };
        start + x * ((end - start) + bend * (x - 1.0))
    }

    /// At start, middle and end of the present step.
    pub(crate) fn temperature_rise_k(&self) -> [f64; 3] {
        self.list.iter().fold([0.0; 3], |sum, effect| {
            let rise = effect.temperature_rise_k();
            [sum[0] + rise[0], sum[1] + rise[1], sum[2] + rise[2]]
        })
    }
}
