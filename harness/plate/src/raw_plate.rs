//! Reads the keys of a plate file; [`crate::Plate`] checks their values.

use schemars::JsonSchema;
use serde::Deserialize;

/// Largest resonance. The protocol encodes the frequency in mHz with 32 bits, at most 4.3 MHz. The
/// rest is for a frequency range above the resonance.
pub(crate) const HIGHEST_RESONANCE_HZ: f64 = 2.5e6;

/// The plate file, unchecked.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawPlate {
    /// Name of the plate.
    pub name: String,
    /// Origin of the numbers, such as a publication or a measurement.
    pub source: String,
    /// The bending mode.
    pub mode: RawMode,
    /// Another bending mode that the drive excites and the sensor measures; none by default.
    pub second_mode: Option<RawSecondMode>,
    /// Effect of a finger; none by default.
    #[serde(default)]
    pub finger: RawFinger,
    /// The amplifier.
    pub drive: RawDrive,
    /// The sensor; without noise by default.
    #[serde(default)]
    pub sensor: RawSensor,
    /// Warming by the plate's own vibration; none by default.
    pub heating: Option<RawHeating>,
    /// Uncertainty of the numbers; unknown by default.
    #[serde(default)]
    pub uncertainty: RawUncertainty,
}

/// `[mode]`
#[derive(Debug, Clone, Deserialize, JsonSchema)]
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

/// `[second_mode]`. A temperature offset and a finger force change its resonance and its damping in
/// the same proportion as those of `[mode]`.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawSecondMode {
    /// Resonance at the reference temperature, Hz.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = HIGHEST_RESONANCE_HZ))]
    pub resonance_hz: f64,
    /// Time constant τ = 1/σ of the untouched plate, ms.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub time_constant_ms: f64,
    /// Gain of the untouched plate at this mode's resonance, µm/Vpp; not 0. Negative if the sensor
    /// measures this mode with the opposite sign.
    pub gain_um_per_vpp: f64,
}

/// `[heating]`: the vibration warms the plate by T,
/// `time_constant_s · T' = rise_k_per_um2 · |W|² − T`. T adds to the temperature offset.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawHeating {
    /// Temperature rise in the steady state per square of the amplitude, K/µm².
    #[schemars(range(min = 0.0))]
    pub rise_k_per_um2: f64,
    /// Time constant of the temperature rise, s.
    #[schemars(range(min = 0.01))]
    pub time_constant_s: f64,
}

/// `[finger]`
#[derive(Debug, Clone, Deserialize, JsonSchema)]
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

impl Default for RawFinger {
    fn default() -> Self {
        Self { damping_ratio: unit_damping(), resonance_shift_hz_per_n: 0.0 }
    }
}

fn unit_damping() -> Vec<[f64; 2]> {
    vec![[0.0, 1.0]]
}

/// `[drive]`
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(extend("dependentRequired" = {
    "converter_bits": ["converter_range_vpp"],
    "converter_range_vpp": ["converter_bits"],
}))]
pub struct RawDrive {
    /// Highest drive of the amplifier, Vpp.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub limit_vpp: f64,
    /// Bits of the converter that sets the drive's amplitude. Drives are not rounded without this
    /// key.
    #[schemars(range(min = 2, max = 32))]
    pub converter_bits: Option<i64>,
    /// Amplitude of the converter's highest code, at least `limit_vpp`, Vpp.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub converter_range_vpp: Option<f64>,
    /// First-order bandwidth (−3 dB) of the drive's amplitude, Hz; unlimited by default.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1e9))]
    pub bandwidth_hz: Option<f64>,
    /// Largest change of the drive's amplitude, Vpp/ms; unlimited by default.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub slew_rate_vpp_per_ms: Option<f64>,
    /// Delay of a command (amplitude and frequency) on its way to the amplifier, µs.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 1e5))]
    pub dead_time_us: f64,
    /// Constant amplitude that the amplifier adds to every drive, also to 0 Vpp, Vpp.
    #[serde(default)]
    pub offset_vpp: f64,
}

/// `[sensor]`
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(extend("dependentRequired" = {
    "demodulator_periods": ["converter_hz"],
    "converter_hz": ["demodulator_periods"],
    "converter_bits": ["converter_range_um"],
    "converter_range_um": ["converter_bits"],
}))]
pub struct RawSensor {
    /// Standard deviation of white noise on each demodulated component, µm.
    #[serde(default)]
    #[schemars(range(min = 0.0))]
    pub noise_um_rms: f64,
    /// Number of carrier periods over which the lock-in demodulator averages. Without this key the
    /// sensor measures W directly. This key and `converter_hz` require the model `carrier`.
    #[schemars(range(min = 1, max = 10_000))]
    pub demodulator_periods: Option<i64>,
    /// Sampling rate of the converter, Hz.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1e9))]
    pub converter_hz: Option<f64>,
    /// Bits of the converter, including the sign. Nothing is rounded without this key. The
    /// converter converts the waveform if `demodulator_periods` is given, otherwise each
    /// demodulated component.
    #[schemars(range(min = 2, max = 32))]
    pub converter_bits: Option<i64>,
    /// The largest amplitude that the converter does not clip, µm.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub converter_range_um: Option<f64>,
    /// Age of the demodulated components when they reach the controller, µs.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 1e5))]
    pub latency_us: f64,
    /// Change of the sensor's gain since the start of the trial, percent per second.
    #[serde(default)]
    pub gain_drift_percent_per_s: f64,
}

/// `[uncertainty]`
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawUncertainty {
    /// Half width of the 95 % interval of K1, percent.
    #[schemars(range(min = 0.0))]
    pub gain_percent: Option<f64>,
    /// Half width of the 95 % interval of τ, percent.
    #[schemars(range(min = 0.0))]
    pub time_constant_percent: Option<f64>,
}
