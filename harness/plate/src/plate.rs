//! Checks a plate file and holds its numbers in the units of the equations.

use crate::lockin::Lockin;
use crate::plate_error::{PlateError, check, finite, positive};
use crate::raw_plate::{HIGHEST_RESONANCE_HZ, RawPlate, RawUncertainty};
use std::f64::consts::TAU;

#[derive(Debug, Clone, PartialEq)]
pub struct Plate {
    pub name: String,
    pub source: String,
    /// At the reference temperature, rad/s.
    pub omega0: f64,
    pub reference_temperature_c: f64,
    /// rad/s per kelvin.
    pub omega0_per_k: f64,
    /// Damping σ = d/2m = 1/τ untouched, 1/s.
    pub sigma0: f64,
    /// Gain K1 at resonance, untouched, µm/Vpp (equation 13).
    pub gain: f64,
    /// Points [force N, σ/σ0], at least one, forces rising, ratios positive.
    pub damping_ratio: Vec<[f64; 2]>,
    /// rad/s per newton.
    pub omega0_per_n: f64,
    pub drive_limit_vpp: f64,
    /// Of the noise on each sensed component.
    pub noise_um_rms: f64,
    /// `None` if W is sensed without delay. Only for the carrier tier.
    pub lockin: Option<Lockin>,
    pub uncertainty: Uncertainty,
}

/// Half widths of the intervals of 95 %, percent; `None` if unknown.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Uncertainty {
    pub gain_percent: Option<f64>,
    pub time_constant_percent: Option<f64>,
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

impl RawPlate {
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
            "a time constant with Q = π · resonance_hz · τ above 1",
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
    let text = || format!("{points:?}");
    check(points.iter().flatten().all(|value| value.is_finite()), KEY, &text(), "finite numbers")?;
    check(points.first().is_some_and(|first| first[0] == 0.0), KEY, &text(), "a first point at 0 N")?;
    check(points.is_sorted_by(|a, b| a[0] < b[0]), KEY, &text(), "points with rising forces")?;
    check(points.iter().all(|point| point[1] > 0.0), KEY, &text(), "ratios above 0")?;
    let falls_at_the_end = matches!(points[..], [.., a, b] if b[1] < a[1]);
    check(!falls_at_the_end, KEY, &text(), "a last segment that does not fall, because it is extended to any force")?;
    Ok(points)
}

impl Plate {
    /// N/m, µm/s² per Vpp: `K1 · 2σ0 · ω0` (equation 8); independent of finger and temperature.
    pub fn force_constant(&self) -> f64 {
        self.gain * 2.0 * self.sigma0 * self.omega0
    }

    pub fn max_damping_slope(&self) -> f64 {
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
        // The segment that contains the force; the last one is extended.
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
    use crate::lockin::ConverterResolution;
    use rstest::rstest;

    const PAPER: &str = include_str!("../../../scenarios/plates/aluminium-198x138.toml");

    fn read(text: &str) -> Result<Plate, PlateError> {
        toml::from_str::<RawPlate>(text).unwrap().check()
    }

    #[test]
    fn the_plate_file_has_the_values_of_the_paper() {
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
    fn refuses_invalid_values(#[case] good: &str, #[case] bad: &str, #[case] key: &str) {
        assert!(PAPER.contains(good), "{good}");
        assert_eq!(read(&PAPER.replacen(good, bad, 1)).unwrap_err().key, key);
    }

    const LOCKIN: &str = "demodulator_periods = 8\nconverter_hz = 1e6\nconverter_bits = 12\nconverter_range_um = 4.0\n";

    fn with_lockin(keys: &str) -> Result<Plate, PlateError> {
        read(&PAPER.replacen("[sensor]", &format!("[sensor]\n{keys}"), 1))
    }

    #[test]
    fn reads_converter_and_demodulator() {
        assert_eq!(read(PAPER).unwrap().lockin, None);
        let resolution = Some(ConverterResolution { bits: 12, range_um: 4.0 });
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
    fn refuses_an_invalid_converter_or_demodulator(#[case] good: &str, #[case] bad: &str, #[case] key: &str) {
        assert!(LOCKIN.contains(good), "{good}");
        assert_eq!(with_lockin(&LOCKIN.replacen(good, bad, 1)).unwrap_err().key, key);
    }

    #[rstest]
    #[case("periods = 8\nconverter_hz = 1e6", "periods = 10000\nconverter_hz = 3e6")]
    #[case("converter_hz = 1e6", "converter_hz = 129230.5")]
    #[case("bits = 12", "bits = 2")]
    #[case("bits = 12", "bits = 32")]
    fn accepts_converters_at_the_limits(#[case] good: &str, #[case] still_good: &str) {
        assert!(LOCKIN.contains(good), "{good}");
        assert!(with_lockin(&LOCKIN.replacen(good, still_good, 1)).is_ok());
    }

    #[test]
    fn accepts_the_shortest_time_constant() {
        assert!(read(&PAPER.replacen("time_constant_ms = 1.88", "time_constant_ms = 0.00986", 1)).is_ok());
    }

    #[test]
    fn the_damping_curve_is_linear_and_extended() {
        let plate = read(PAPER).unwrap();
        for (force, ratio) in [(0.0, 1.0), (0.75, 1.5), (1.5, 2.0), (3.0, 3.0)] {
            assert!((plate.damping_ratio_at(force) - ratio).abs() < 1e-15, "{force} N");
        }
        let bent = Plate { damping_ratio: vec![[0.0, 1.0], [1.0, 3.0], [2.0, 4.0]], ..plate };
        assert_eq!(bent.max_damping_slope(), 2.0);
        for (force, ratio) in [(0.5, 2.0), (1.0, 3.0), (1.5, 3.5), (4.0, 6.0)] {
            assert!((bent.damping_ratio_at(force) - ratio).abs() < 1e-15, "{force} N");
        }
    }
}
