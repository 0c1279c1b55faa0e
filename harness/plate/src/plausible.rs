//! Ranges of the parameters that an ultrasonic tactile plate can have.
//!
//! The ranges are wide: they find a wrong unit, not a poor measurement.

use crate::plate::Plate;
use std::f64::consts::TAU;
use std::fmt;

/// Range of one parameter. The limits are plausible.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlausibleRange {
    /// Key of the plate file.
    pub key: &'static str,
    pub quantity: &'static str,
    pub unit: &'static str,
    pub low: f64,
    pub high: f64,
    /// Probable cause of a value outside.
    pub cause: &'static str,
}

/// Below 10 kHz the vibration is audible, which such a plate avoids; the paper's plate has
/// 32.3 kHz. 150 kHz is below 203 000 rad/s, the paper's resonance in the wrong unit.
pub const RESONANCE: PlausibleRange = PlausibleRange {
    key: "mode.resonance_hz",
    quantity: "resonance",
    unit: "Hz",
    low: 10e3,
    high: 150e3,
    cause: "check the unit of the frequency (Hz, kHz, rad/s)",
};

/// 1.62 to 2.07 ms in Tables I and II of the paper. A unit of time is wrong by a factor of 1000.
pub const TIME_CONSTANT: PlausibleRange = PlausibleRange {
    key: "mode.time_constant_ms",
    quantity: "time constant",
    unit: "ms",
    low: 0.1,
    high: 50.0,
    cause: "check the unit of the time (s, ms, us)",
};

/// 6547 to 7108 pm/V in Table I of the paper. A unit of amplitude is wrong by a factor of 1000. A
/// factor of 2, peak for peak to peak, is inside the range.
pub const GAIN: PlausibleRange = PlausibleRange {
    key: "mode.gain_um_per_vpp",
    quantity: "gain K1",
    unit: "µm/Vpp",
    low: 5e-4,
    high: 0.1,
    cause: "check the units of amplitude (um, nm, m) and drive (V, Vpp), and peak against peak to peak",
};

/// 191 for the paper's plate, from a strongly damped to a nearly undamped plate.
pub const QUALITY_FACTOR: PlausibleRange = PlausibleRange {
    key: "mode.time_constant_ms",
    quantity: "quality factor",
    unit: "",
    low: 5.0,
    high: 20_000.0,
    cause: "check the units of time and frequency",
};

/// Share of the largest amplitude, in percent. Section V of the paper controls 2 µm to 1.3 %.
pub const NOISE: PlausibleRange = PlausibleRange {
    key: "sensor.noise_um_rms",
    quantity: "noise",
    unit: "% of the largest amplitude",
    low: 0.0,
    high: 20.0,
    cause: "check the unit of the amplitude, and whether the signals belong to this plate",
};

/// Largest distance of the resonance from the excitation, Hz. It is the shift by 52 K with the
/// slope of the paper, -9.638 Hz/K, and half the sampling rate of its telemetry: at 1 kHz a larger
/// detuning has the same samples as a smaller one.
pub const MAX_DETUNING_HZ: f64 = 500.0;

#[derive(Debug, Clone, PartialEq)]
pub struct ImplausibleValue {
    pub range: PlausibleRange,
    pub value: f64,
}

impl fmt::Display for ImplausibleValue {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let PlausibleRange { quantity, unit, low, high, cause, .. } = self.range;
        let space = if unit.is_empty() { "" } else { " " };
        let value = format_digits(self.value);
        write!(formatter, "{quantity} of {value}{space}{unit}, expected {low} to {high}{space}{unit}: {cause}")
    }
}

/// Four significant digits.
fn format_digits(value: f64) -> String {
    let digits = format!("{value:.3e}").parse::<f64>().unwrap_or(value);
    if digits == 0.0 || (1e-4..1e7).contains(&digits.abs()) { digits.to_string() } else { format!("{digits:e}") }
}

impl PlausibleRange {
    /// `None` if the value is plausible.
    pub fn check(self, value: f64) -> Option<ImplausibleValue> {
        (!(self.low..=self.high).contains(&value)).then_some(ImplausibleValue { range: self, value })
    }
}

impl Plate {
    /// Parameters that no ultrasonic tactile plate has.
    pub fn implausible_values(&self) -> Vec<ImplausibleValue> {
        let largest = self.gain * self.drive_limit_vpp;
        let second = self.effects.second_mode.iter().flat_map(|second| {
            [
                PlausibleRange { key: "second_mode.resonance_hz", quantity: "second resonance", ..RESONANCE }
                    .check(second.omega0 / TAU),
                PlausibleRange {
                    key: "second_mode.time_constant_ms",
                    quantity: "second time constant",
                    ..TIME_CONSTANT
                }
                .check(1e3 / second.sigma0),
            ]
        });
        let first = [
            RESONANCE.check(self.omega0 / TAU),
            TIME_CONSTANT.check(1e3 / self.sigma0),
            GAIN.check(self.gain),
            QUALITY_FACTOR.check(self.omega0 / (2.0 * self.sigma0)),
            NOISE.check(self.noise_um_rms / largest * 100.0),
        ];
        first.into_iter().chain(second).flatten().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::RawPlate;
    use rstest::rstest;

    const PAPER: &str = include_str!("../../../scenarios/plates/aluminium-198x138.toml");

    fn keys(good: &str, other: &str) -> Vec<&'static str> {
        assert!(PAPER.contains(good), "{good}");
        let plate = toml::from_str::<RawPlate>(&PAPER.replacen(good, other, 1)).unwrap().check().unwrap();
        plate.implausible_values().iter().map(|found| found.range.key).collect()
    }

    #[rstest]
    #[case::as_the_paper("gain_um_per_vpp = 0.00698", "gain_um_per_vpp = 0.00698", &[])]
    #[case::nm_as_um("gain_um_per_vpp = 0.00698", "gain_um_per_vpp = 6.98", &["mode.gain_um_per_vpp"])]
    #[case::m_as_um("gain_um_per_vpp = 0.00698", "gain_um_per_vpp = 6.98e-9", &["mode.gain_um_per_vpp"])]
    #[case::peak("gain_um_per_vpp = 0.00698", "gain_um_per_vpp = 0.00349", &[])]
    #[case::rad_per_s("resonance_hz = 32307.6", "resonance_hz = 202995.0", &["mode.resonance_hz"])]
    #[case::us_as_ms("time_constant_ms = 1.88", "time_constant_ms = 1880.0",
        &["mode.time_constant_ms", "mode.time_constant_ms"])]
    #[case::noise("noise_um_rms = 0.0", "noise_um_rms = 8.0", &["sensor.noise_um_rms"])]
    fn finds_values_in_a_wrong_unit(#[case] good: &str, #[case] other: &str, #[case] expected: &[&str]) {
        assert_eq!(keys(good, other), expected);
    }

    #[test]
    fn a_message_states_value_range_and_cause() {
        assert_eq!(
            GAIN.check(6.464_939).unwrap().to_string(),
            "gain K1 of 6.465 µm/Vpp, expected 0.0005 to 0.1 µm/Vpp: check the units of amplitude (um, nm, m) and \
             drive (V, Vpp), and peak against peak to peak"
        );
    }
}
