//! The plate file: raw as it is written, [`Plate`] as it may be used.

use crate::demodulator::Lockin;
use schemars::JsonSchema;
use serde::Deserialize;
use std::f64::consts::TAU;

/// The plate file as serde reads it; every key that it may have, none of them checked yet.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawPlate {
    /// What the plate is.
    pub name: String,
    /// Where the numbers come from.
    pub source: String,
    /// The bending mode.
    pub mode: RawMode,
    /// What a finger does; nothing if left out.
    #[serde(default)]
    pub finger: RawFinger,
    /// The amplifier.
    pub drive: RawDrive,
    /// The sensor; without noise if left out.
    #[serde(default)]
    pub sensor: RawSensor,
    /// How well the numbers are known; nothing is said if left out.
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
    /// Temperature from which offsets are counted, °C.
    #[schemars(extend("exclusiveMinimum" = -273.15))]
    pub reference_temperature_c: f64,
    /// Change of the resonance per kelvin, Hz.
    pub resonance_slope_hz_per_k: f64,
    /// τ = 1/σ untouched, ms.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub time_constant_ms: f64,
    /// K1 at resonance, untouched, µm/Vpp.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub gain_um_per_vpp: f64,
}

/// `[finger]`
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawFinger {
    /// Points [force N, σ/σ0]; linear between, the last segment extended.
    #[serde(default = "undamped")]
    #[schemars(length(min = 1))]
    pub damping_ratio: Vec<[f64; 2]>,
    /// Change of the resonance per newton, Hz.
    #[serde(default)]
    pub resonance_shift_hz_per_n: f64,
}

impl Default for RawFinger {
    fn default() -> Self {
        Self { damping_ratio: undamped(), resonance_shift_hz_per_n: 0.0 }
    }
}

fn undamped() -> Vec<[f64; 2]> {
    vec![[0.0, 1.0]]
}

/// `[drive]`
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawDrive {
    /// Highest drive the amplifier gives, Vpp.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub limit_vpp: f64,
}

/// `[sensor]`
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(extend("dependentRequired" = {
    "demodulator_periods": ["converter_hz"],
    "converter_hz": ["demodulator_periods"],
    "converter_bits": ["demodulator_periods", "converter_range_um"],
    "converter_range_um": ["demodulator_periods", "converter_bits"],
}))]
pub struct RawSensor {
    /// Standard deviation of white noise on each demodulated component, µm.
    #[serde(default)]
    #[schemars(range(min = 0.0))]
    pub noise_um_rms: f64,
    /// Carrier periods over which the lock-in demodulator takes its mean; without it W is sensed at once. Carrier tier only, as
    /// are the three below.
    #[schemars(range(min = 1, max = 10_000))]
    pub demodulator_periods: Option<i64>,
    /// Samples per second of the converter before the demodulator.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1e9))]
    pub converter_hz: Option<f64>,
    /// Resolution of the converter, sign included; without it nothing is rounded.
    #[schemars(range(min = 2, max = 32))]
    pub converter_bits: Option<i64>,
    /// The largest amplitude that the converter does not clip, µm.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub converter_range_um: Option<f64>,
}

/// `[uncertainty]`
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawUncertainty {
    /// How far K1 may be from the file's at 95 %, percent to either side.
    #[schemars(range(min = 0.0))]
    pub gain_percent: Option<f64>,
    /// How far τ may be from the file's at 95 %, percent to either side.
    #[schemars(range(min = 0.0))]
    pub time_constant_percent: Option<f64>,
}

/// An excitation half as high again still fits into 32 bits of millihertz.
const HIGHEST_RESONANCE_HZ: f64 = 2.5e6;

/// A value in a plate file that cannot be meant.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("`{key}` is {value}, expected {expected}")]
pub struct PlateError {
    /// Dotted path of the key.
    pub key: &'static str,
    /// What stands there.
    pub value: String,
    /// What may stand there.
    pub expected: &'static str,
}

/// A plate whose every number can be worked with.
#[derive(Debug, Clone, PartialEq)]
pub struct Plate {
    /// What the plate is.
    pub name: String,
    /// Where the numbers come from.
    pub source: String,
    /// Resonance at the reference temperature, rad/s.
    pub omega0: f64,
    /// Temperature from which offsets are counted, °C.
    pub reference_temperature_c: f64,
    /// Change of the resonance per kelvin, rad/s.
    pub omega0_per_k: f64,
    /// Damping σ = d/2m = 1/τ untouched, 1/s.
    pub sigma0: f64,
    /// Gain K1 at resonance, untouched, µm/Vpp (equation 13).
    pub gain: f64,
    /// Points [force N, σ/σ0], at least one, forces rising, ratios positive.
    pub damping_ratio: Vec<[f64; 2]>,
    /// Change of the resonance per newton, rad/s.
    pub omega0_per_n: f64,
    /// Highest drive, Vpp.
    pub drive_limit_vpp: f64,
    /// Standard deviation of the noise on each sensed component, µm.
    pub noise_um_rms: f64,
    /// The sensor's converter and demodulator, for the carrier tier; `None` where W is sensed at once.
    pub lockin: Option<Lockin>,
    /// How well the numbers are known.
    pub uncertainty: Uncertainty,
}

/// How far a plate may be from its file at 95 %, percent to either side; `None` where nothing is said.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Uncertainty {
    /// Of the gain K1.
    pub gain_percent: Option<f64>,
    /// Of the time constant τ.
    pub time_constant_percent: Option<f64>,
}

pub(crate) fn check(
    holds: bool,
    key: &'static str,
    value: &impl ToString,
    expected: &'static str,
) -> Result<(), PlateError> {
    if holds { Ok(()) } else { Err(PlateError { key, value: value.to_string(), expected }) }
}

pub(crate) fn positive(key: &'static str, value: f64) -> Result<f64, PlateError> {
    check(value.is_finite() && value > 0.0, key, &value, "a finite number above 0").map(|()| value)
}

fn uncertainty(raw: &RawUncertainty) -> Result<Uncertainty, PlateError> {
    let checked = |key, value: Option<f64>| {
        let holds = value.is_none_or(|value| value.is_finite() && value >= 0.0);
        check(holds, key, &value.unwrap_or_default(), "a finite number, 0 or more").map(|()| value)
    };
    Ok(Uncertainty {
        gain_percent: checked("uncertainty.gain_percent", raw.gain_percent)?,
        time_constant_percent: checked("uncertainty.time_constant_percent", raw.time_constant_percent)?,
    })
}

fn finite(key: &'static str, value: f64) -> Result<f64, PlateError> {
    check(value.is_finite(), key, &value, "a finite number").map(|()| value)
}

impl RawPlate {
    /// Checks every number.
    ///
    /// # Errors
    /// [`PlateError`] naming the first key whose value cannot be meant.
    pub fn check(self) -> Result<Plate, PlateError> {
        let resonance_hz = positive("mode.resonance_hz", self.mode.resonance_hz)?;
        check(
            resonance_hz <= HIGHEST_RESONANCE_HZ,
            "mode.resonance_hz",
            &resonance_hz,
            "at most 2.5e6: the wire carries the excitation frequency in millihertz",
        )?;
        let omega0 = resonance_hz * TAU;
        let sigma0 = 1e3 / positive("mode.time_constant_ms", self.mode.time_constant_ms)?;
        check(
            omega0 / (2.0 * sigma0) > 1.0,
            "mode.time_constant_ms",
            &self.mode.time_constant_ms,
            "a time constant that leaves a resonance: Q = π · resonance_hz · τ above 1",
        )?;
        let reference = finite("mode.reference_temperature_c", self.mode.reference_temperature_c)?;
        check(reference > -273.15, "mode.reference_temperature_c", &reference, "a temperature above -273.15")?;
        let noise = finite("sensor.noise_um_rms", self.sensor.noise_um_rms)?;
        check(noise >= 0.0, "sensor.noise_um_rms", &noise, "0 or more")?;
        Ok(Plate {
            name: self.name,
            source: self.source,
            omega0,
            reference_temperature_c: reference,
            omega0_per_k: finite("mode.resonance_slope_hz_per_k", self.mode.resonance_slope_hz_per_k)? * TAU,
            sigma0,
            gain: positive("mode.gain_um_per_vpp", self.mode.gain_um_per_vpp)?,
            damping_ratio: damping_curve(self.finger.damping_ratio)?,
            omega0_per_n: finite("finger.resonance_shift_hz_per_n", self.finger.resonance_shift_hz_per_n)? * TAU,
            drive_limit_vpp: positive("drive.limit_vpp", self.drive.limit_vpp)?,
            noise_um_rms: noise,
            lockin: Lockin::check(&self.sensor, resonance_hz)?,
            uncertainty: uncertainty(&self.uncertainty)?,
        })
    }
}

fn damping_curve(points: Vec<[f64; 2]>) -> Result<Vec<[f64; 2]>, PlateError> {
    const KEY: &str = "finger.damping_ratio";
    let shown = || format!("{points:?}");
    check(points.iter().flatten().all(|value| value.is_finite()), KEY, &shown(), "finite numbers")?;
    check(points.first().is_some_and(|first| first[0] == 0.0), KEY, &shown(), "a first point at 0 N")?;
    check(points.is_sorted_by(|a, b| a[0] < b[0]), KEY, &shown(), "points with rising forces")?;
    check(
        points.iter().all(|point| point[1] > 0.0),
        KEY,
        &shown(),
        "ratios above 0: no finger makes a plate swing up by itself",
    )?;
    let falls_at_the_end = matches!(points[..], [.., a, b] if b[1] < a[1]);
    check(!falls_at_the_end, KEY, &shown(), "a last segment that does not fall: it is extended to any force")?;
    Ok(points)
}

impl Plate {
    /// The plant's constant N/m, µm/s² per Vpp: `K1 · 2σ0 · ω0` (from equation 8 at the reference temperature).
    ///
    /// A finger changes σ and a temperature changes ω0, but not this.
    pub fn force_constant(&self) -> f64 {
        self.gain * 2.0 * self.sigma0 * self.omega0
    }

    /// Largest change of σ/σ0 per newton.
    pub fn steepest_damping(&self) -> f64 {
        let slopes = self.damping_ratio.windows(2).map(|pair| (pair[1][1] - pair[0][1]) / (pair[1][0] - pair[0][0]));
        slopes.fold(0.0, |steepest, slope| slope.abs().max(steepest))
    }

    /// σ/σ0 under a finger force in N.
    pub fn damping_ratio_at(&self, force_n: f64) -> f64 {
        let points = &self.damping_ratio;
        let [first, .., _] = points[..] else {
            return points.first().map_or(1.0, |only| only[1]);
        };
        if force_n <= first[0] {
            return first[1];
        }
        // The segment that holds the force, or the last one for whatever lies beyond.
        let segment = points.windows(2).find(|pair| force_n <= pair[1][0]).or_else(|| points.windows(2).last());
        segment.map_or(first[1], |pair| {
            let slope = (pair[1][1] - pair[0][1]) / (pair[1][0] - pair[0][0]);
            pair[0][1] + slope * (force_n - pair[0][0])
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demodulator::Resolution;
    use rstest::rstest;

    const PAPER: &str = include_str!("../../../scenarios/plates/aluminium-198x138.toml");

    fn read(text: &str) -> Result<Plate, PlateError> {
        toml::from_str::<RawPlate>(text).unwrap().check()
    }

    #[test]
    fn the_paper_s_plate_has_the_paper_s_numbers() {
        let plate = read(PAPER).unwrap();
        assert!((plate.omega0 - 202_995.0).abs() < 1.0, "{}", plate.omega0);
        assert!((plate.omega0 + 9.0 * plate.omega0_per_k - 202_450.0).abs() < 1.0);
        assert!((plate.omega0 / (2.0 * plate.sigma0) - 191.0).abs() < 0.5, "quality factor");
    }

    #[rstest]
    #[case("resonance_hz = 32307.6", "resonance_hz = 0.0", "mode.resonance_hz")]
    #[case("resonance_hz = 32307.6", "resonance_hz = nan", "mode.resonance_hz")]
    #[case("resonance_hz = 32307.6", "resonance_hz = 2500001.0", "mode.resonance_hz")]
    #[case("time_constant_ms = 1.88", "time_constant_ms = -1.88", "mode.time_constant_ms")]
    #[case("time_constant_ms = 1.88", "time_constant_ms = 0.0", "mode.time_constant_ms")]
    // No damping at all.
    #[case("time_constant_ms = 1.88", "time_constant_ms = inf", "mode.time_constant_ms")]
    // Q = π f τ: 1 at 9.853 µs.
    #[case("time_constant_ms = 1.88", "time_constant_ms = 0.00985", "mode.time_constant_ms")]
    #[case("gain_um_per_vpp = 0.00698", "gain_um_per_vpp = inf", "mode.gain_um_per_vpp")]
    #[case("reference_temperature_c = 24.0", "reference_temperature_c = -274.0", "mode.reference_temperature_c")]
    #[case("limit_vpp = 900.0", "limit_vpp = 0.0", "drive.limit_vpp")]
    #[case("noise_um_rms = 0.0", "noise_um_rms = -0.1", "sensor.noise_um_rms")]
    #[case("[sensor]", "[uncertainty]\ngain_percent = -0.1\n[sensor]", "uncertainty.gain_percent")]
    #[case("[sensor]", "[uncertainty]\ntime_constant_percent = inf\n[sensor]", "uncertainty.time_constant_percent")]
    #[case("[1.5, 2.0]", "[1.5, -2.0]", "finger.damping_ratio")]
    #[case("[1.5, 2.0]", "[1.5, 0.5]", "finger.damping_ratio")]
    #[case("[1.5, 2.0]", "[0.0, 2.0]", "finger.damping_ratio")]
    #[case("[0.0, 1.0], ", "", "finger.damping_ratio")]
    fn what_cannot_be_meant_is_refused(#[case] good: &str, #[case] bad: &str, #[case] key: &str) {
        assert!(PAPER.contains(good), "{good}");
        assert_eq!(read(&PAPER.replacen(good, bad, 1)).unwrap_err().key, key);
    }

    const LOCKIN: &str = "demodulator_periods = 8\nconverter_hz = 1e6\nconverter_bits = 12\nconverter_range_um = 4.0\n";

    fn with_lockin(keys: &str) -> Result<Plate, PlateError> {
        read(&PAPER.replacen("[sensor]", &format!("[sensor]\n{keys}"), 1))
    }

    #[test]
    fn a_sensor_without_electronics_has_none_and_one_with_them_all() {
        assert_eq!(read(PAPER).unwrap().lockin, None);
        let resolution = Some(Resolution { bits: 12, range_um: 4.0 });
        assert_eq!(with_lockin(LOCKIN).unwrap().lockin, Some(Lockin { converter_hz: 1e6, periods: 8, resolution }));
        let bare = with_lockin("demodulator_periods = 1\nconverter_hz = 1e6").unwrap();
        assert_eq!(bare.lockin, Some(Lockin { converter_hz: 1e6, periods: 1, resolution: None }));
    }

    #[rstest]
    #[case("periods = 8", "periods = 0", "sensor.demodulator_periods")]
    #[case("periods = 8", "periods = -1", "sensor.demodulator_periods")]
    #[case("periods = 8", "periods = 10001", "sensor.demodulator_periods")]
    // 10 000 periods of 32.3076 kHz at 4 MHz are 1.24e6 samples.
    #[case("periods = 8\nconverter_hz = 1e6", "periods = 10000\nconverter_hz = 4e6", "sensor.demodulator_periods")]
    #[case("demodulator_periods = 8\n", "", "sensor.converter_hz")]
    #[case("demodulator_periods = 8\nconverter_hz = 1e6\n", "", "sensor.converter_bits")]
    #[case("demodulator_periods = 8\nconverter_hz = 1e6\nconverter_bits = 12\n", "", "sensor.converter_range_um")]
    #[case("converter_hz = 1e6\n", "", "sensor.converter_hz")]
    #[case("converter_hz = 1e6", "converter_hz = nan", "sensor.converter_hz")]
    #[case("converter_hz = 1e6", "converter_hz = inf", "sensor.converter_hz")]
    #[case("converter_hz = 1e6", "converter_hz = 0.0", "sensor.converter_hz")]
    #[case("converter_hz = 1e6", "converter_hz = 129230.4", "sensor.converter_hz")]
    #[case("converter_hz = 1e6", "converter_hz = 1.1e9", "sensor.converter_hz")]
    #[case("bits = 12", "bits = 1", "sensor.converter_bits")]
    #[case("bits = 12", "bits = 33", "sensor.converter_bits")]
    #[case("converter_bits = 12\n", "", "sensor.converter_bits")]
    #[case("range_um = 4.0", "range_um = 0.0", "sensor.converter_range_um")]
    #[case("range_um = 4.0", "range_um = nan", "sensor.converter_range_um")]
    #[case("converter_range_um = 4.0\n", "", "sensor.converter_range_um")]
    fn electronics_that_cannot_be_meant_are_refused(#[case] good: &str, #[case] bad: &str, #[case] key: &str) {
        assert!(LOCKIN.contains(good), "{good}");
        assert_eq!(with_lockin(&LOCKIN.replacen(good, bad, 1)).unwrap_err().key, key);
    }

    #[rstest]
    #[case("periods = 8\nconverter_hz = 1e6", "periods = 10000\nconverter_hz = 3e6")]
    #[case("converter_hz = 1e6", "converter_hz = 129230.5")]
    #[case("bits = 12", "bits = 2")]
    #[case("bits = 12", "bits = 32")]
    fn the_last_good_electronics_are_taken(#[case] good: &str, #[case] still_good: &str) {
        assert!(LOCKIN.contains(good), "{good}");
        assert!(with_lockin(&LOCKIN.replacen(good, still_good, 1)).is_ok());
    }

    #[test]
    fn the_last_good_time_constant_is_taken() {
        assert!(read(&PAPER.replacen("time_constant_ms = 1.88", "time_constant_ms = 0.00986", 1)).is_ok());
    }

    #[test]
    fn the_damping_curve_is_linear_and_its_last_segment_goes_on() {
        let plate = read(PAPER).unwrap();
        for (force, ratio) in [(0.0, 1.0), (0.75, 1.5), (1.5, 2.0), (3.0, 3.0)] {
            assert!((plate.damping_ratio_at(force) - ratio).abs() < 1e-15, "{force} N");
        }
        let bent = Plate { damping_ratio: vec![[0.0, 1.0], [1.0, 3.0], [2.0, 4.0]], ..plate };
        assert_eq!(bent.steepest_damping(), 2.0);
        for (force, ratio) in [(0.5, 2.0), (1.0, 3.0), (1.5, 3.5), (4.0, 6.0)] {
            assert!((bent.damping_ratio_at(force) - ratio).abs() < 1e-15, "{force} N");
        }
    }
}
