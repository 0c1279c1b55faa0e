//! Checks a plate file and converts its numbers to the units of the equations.

use crate::demodulator::Lockin;
use crate::effect::{Effect, PlateError, check, finite, positive, resonance};
use crate::effects::{ConverterResolution, Effects, Heating, RawPlate, Uncertainty};
use crate::flow::Model;
use crate::mode::{Conditions, Mode};
use std::f64::consts::TAU;

/// Largest [`Plate::warming_share`], for which the error of self-heating is known
/// (`docs/mathematics.md`, optional effects).
const MAX_WARMING_SHARE: f64 = 1.0 / (TAU * 12_500.0);

#[derive(Debug, Clone, PartialEq)]
pub struct Plate {
    pub name: String,
    pub source: String,
    /// Resonance ω0 at the reference temperature, rad/s.
    pub omega0: f64,
    pub reference_temperature_c: f64,
    /// Change of the resonance per kelvin, rad/s.
    pub omega0_per_k: f64,
    /// Damping σ = d/2m = 1/τ of the untouched plate, 1/s.
    pub sigma0: f64,
    /// Gain K1 of the untouched plate at resonance, µm/Vpp (equation 13).
    pub gain: f64,
    /// At least one point [force in N, σ/σ0]. Forces increase, ratios are positive.
    pub damping_ratio: Vec<[f64; 2]>,
    /// Change of the resonance per newton of finger force, rad/s.
    pub omega0_per_n: f64,
    pub drive_limit_vpp: f64,
    /// Standard deviation of the noise on each of Wd and Wq.
    pub noise_um_rms: f64,
    /// Lock-in of the carrier model; `None` if the sensor measures W directly.
    pub lockin: Option<Lockin>,
    /// Resolution of Wd and Wq if the sensor has a converter but no lock-in.
    pub resolution: Option<ConverterResolution>,
    pub effects: Effects,
    pub uncertainty: Uncertainty,
}

impl RawPlate {
    /// With a slew rate, lock-in samples and self-heating have no closed form, so these are
    /// refused.
    fn check_slew_rate(&self) -> Result<(), PlateError> {
        const KEY: &str = "drive.slew_rate_vpp_per_ms";
        let Some(value) = self.drive.slew_rate_vpp_per_ms else { return Ok(()) };
        let has_lockin = self.sensor.demodulator_periods.is_some();
        check(!has_lockin, KEY, &value, "a plate without `sensor.demodulator_periods`")?;
        check(self.heating.is_none(), KEY, &value, "a plate without `[heating]`")
    }

    pub fn check(self) -> Result<Plate, PlateError> {
        let rise = self.heating.as_ref().map_or(0.0, |heating| heating.rise_k_per_um2);
        let plate = self.check_numbers()?;
        let share = plate.warming_share();
        let expected = "a rise with |mode.resonance_slope_hz_per_k| · rise_k_per_um2 · (largest amplitude)² / \
                        time_constant_s of at most resonance_hz² / 12 500";
        check(share <= MAX_WARMING_SHARE, "heating.rise_k_per_um2", &rise, expected)?;
        Ok(plate)
    }

    fn check_numbers(self) -> Result<Plate, PlateError> {
        let resonance_hz = self.mode.resonance_hz;
        let keys = ["mode.resonance_hz", "mode.time_constant_ms"];
        let (omega0, sigma0) = resonance(keys, resonance_hz, self.mode.time_constant_ms)?;
        let reference = finite("mode.reference_temperature_c", self.mode.reference_temperature_c)?;
        check(reference > -273.15, "mode.reference_temperature_c", &reference, "a temperature above -273.15")?;
        let noise = finite("sensor.noise_um_rms", self.sensor.noise_um_rms)?;
        check(noise >= 0.0, "sensor.noise_um_rms", &noise, "0 or more")?;
        let Uncertainty { gain_percent, time_constant_percent } = self.uncertainty;
        for (key, percent) in
            [("uncertainty.gain_percent", gain_percent), ("uncertainty.time_constant_percent", time_constant_percent)]
        {
            let percent = percent.unwrap_or_default();
            check(percent.is_finite() && percent >= 0.0, key, &percent, "a finite number, 0 or more")?;
        }
        self.check_slew_rate()?;
        let effects = Effects::check(&self)?;
        let lockin = Lockin::check(&self.sensor, resonance_hz)?;
        let resolution = ConverterResolution::check(&self.sensor)?.filter(|_| lockin.is_none());
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
            lockin,
            resolution,
            effects,
            uncertainty: self.uncertainty,
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
    /// `N/m = K1 · 2σ0 · ω0` (equation 8), µm/s² per Vpp. Finger and temperature do not change it.
    pub fn force_constant(&self) -> f64 {
        self.gain * 2.0 * self.sigma0 * self.omega0
    }

    /// Key of the first optional effect in the plate file. The models `linear` and `envelope`
    /// cannot simulate these effects.
    pub fn first_effect(&self) -> Option<&'static str> {
        self.effects.list().find_map(Effect::key)
    }

    pub fn mode(&self, conditions: &Conditions) -> Mode {
        let omega0 = self.omega0
            + self.omega0_per_k * conditions.temperature_offset_k
            + self.omega0_per_n * conditions.finger_force_n;
        Mode {
            sigma: self.sigma0 * self.damping_ratio_at(conditions.finger_force_n),
            omega0,
            force_constant: self.force_constant(),
            envelope_constant: self.gain * self.sigma0,
        }
    }

    pub fn second_mode(&self, conditions: &Conditions) -> Option<Mode> {
        self.effects.second_mode.map(|second| {
            let first = self.mode(conditions);
            second.mode(first.sigma / self.sigma0, first.omega0 / self.omega0)
        })
    }

    /// Largest σ for forces from `low` to `high` N, 1/s.
    pub(crate) fn max_sigma(&self, (low, high): (f64, f64)) -> f64 {
        let bends = self.damping_ratio.iter().map(|point| point[0]).filter(|force| (low..=high).contains(force));
        self.sigma0 * bends.chain([low, high]).map(|force| self.damping_ratio_at(force)).fold(0.0_f64, f64::max)
    }

    /// Upper bound on |W| after `seconds`, if it is `amplitude` µm now.
    pub(crate) fn max_amplitude(&self, amplitude: f64, seconds: f64) -> f64 {
        amplitude + self.max_rise(seconds)
    }

    /// Upper bound on the rise of |W| in `seconds`. Per mode |W| rises by at most b V t = K1 σ0 V t,
    /// and to at most K1 V σ0/σ.
    fn max_rise(&self, seconds: f64) -> f64 {
        let least = self.damping_ratio.iter().map(|point| point[1]).fold(1.0, f64::min);
        let second = self.effects.second_mode.map_or((0.0, 0.0), |second| (second.gain.abs(), second.sigma0));
        let per_vpp = [(self.gain, self.sigma0), second].map(|(gain, sigma)| gain * (sigma * seconds).min(1.0 / least));
        per_vpp.iter().sum::<f64>() * (self.drive_limit_vpp + self.effects.amplifier.offset_vpp.abs())
    }

    /// Largest rate in rad/s² at which the vibration warms ω0, relative to ω0². 0 without `[heating]`.
    pub fn warming_share(&self) -> f64 {
        self.effects.heating.map_or(0.0, |Heating { rise_k_per_um2, rate }| {
            let warming = rate * rise_k_per_um2 * self.max_rise(f64::MAX).powi(2);
            self.omega0_per_k.abs() * warming / self.omega0.powi(2)
        })
    }

    /// Factor by which σ or ω0 of any mode changes at most, relative to the first mode.
    pub(crate) fn max_mode_scale(&self) -> f64 {
        self.effects
            .second_mode
            .map_or(1.0, |second| (second.omega0 / self.omega0).max(second.sigma0 / self.sigma0).max(1.0))
    }

    /// False for a plate without `[finger]`.
    pub fn depends_on_force(&self) -> bool {
        self.omega0_per_n != 0.0 || self.damping_ratio.iter().any(|point| point[1] != self.damping_ratio_at(0.0))
    }

    pub fn max_damping_slope(&self) -> f64 {
        let slopes = self.damping_ratio.array_windows().map(|[from, to]| (to[1] - from[1]) / (to[0] - from[0]));
        slopes.fold(0.0, |steepest, slope| slope.abs().max(steepest))
    }

    pub fn damping_ratio_at(&self, force_n: f64) -> f64 {
        let points = &self.damping_ratio;
        let [first, .., _] = points[..] else {
            return points.first().map_or(1.0, |only| only[1]);
        };
        if force_n <= first[0] {
            return first[1];
        }
        // The segment that contains the force; the last segment is extended to any force.
        let segment = points.array_windows().find(|[_, to]| force_n <= to[0]).or_else(|| points.array_windows().last());
        segment.map_or(first[1], |[from, to]| {
            let slope = (to[1] - from[1]) / (to[0] - from[0]);
            from[1] + slope * (force_n - from[0])
        })
    }
}

impl Model {
    pub const fn exact_for(plate: &Plate) -> Self {
        if plate.lockin.is_some() { Self::Carrier } else { Self::Modal }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::{Amplifier, DriveConverter, SecondMode};
    use crate::time::Time;
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
    // Below a time constant of 9.853 µs, Q = π f τ is less than 1.
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

    #[rstest]
    #[case("bandwidth_hz = 0.0", "drive.bandwidth_hz")]
    #[case("bandwidth_hz = 2e9", "drive.bandwidth_hz")]
    #[case("slew_rate_vpp_per_ms = -1.0", "drive.slew_rate_vpp_per_ms")]
    #[case("dead_time_us = -1.0", "drive.dead_time_us")]
    #[case("dead_time_us = 100001.0", "drive.dead_time_us")]
    #[case("offset_vpp = 901.0", "drive.offset_vpp")]
    #[case("offset_vpp = nan", "drive.offset_vpp")]
    #[case("converter_bits = 10", "drive.converter_range_vpp")]
    #[case("converter_range_vpp = 900.0", "drive.converter_bits")]
    #[case("converter_bits = 1\nconverter_range_vpp = 900.0", "drive.converter_bits")]
    #[case("converter_bits = 10\nconverter_range_vpp = 899.0", "drive.converter_range_vpp")]
    #[case("[sensor]\nlatency_us = -1.0", "sensor.latency_us")]
    #[case("[sensor]\nlatency_us = 100001.0", "sensor.latency_us")]
    #[case("[sensor]\ngain_drift_percent_per_s = inf", "sensor.gain_drift_percent_per_s")]
    #[case("[sensor]\nlatency_us = 10.0\ndemodulator_periods = 8\nconverter_hz = 1e6", "sensor.latency_us")]
    #[case(
        "slew_rate_vpp_per_ms = 1.0\n[sensor]\ndemodulator_periods = 8\nconverter_hz = 1e6",
        "drive.slew_rate_vpp_per_ms"
    )]
    #[case(
        "slew_rate_vpp_per_ms = 1.0\n[heating]\nrise_k_per_um2 = 0.1\ntime_constant_s = 1.0",
        "drive.slew_rate_vpp_per_ms"
    )]
    #[case("[heating]\nrise_k_per_um2 = -0.1\ntime_constant_s = 1.0", "heating.rise_k_per_um2")]
    #[case("[heating]\nrise_k_per_um2 = 0.1\ntime_constant_s = 0.009", "heating.time_constant_s")]
    // 9.638 Hz/K · rise · (6.282 µm)² / 0.03 s is at most (32307.6 Hz)² / 12 500 up to 6.5862 K/µm².
    #[case("[heating]\nrise_k_per_um2 = 6.59\ntime_constant_s = 0.03", "heating.rise_k_per_um2")]
    #[case("[heating]\nrise_k_per_um2 = 1e300\ntime_constant_s = 0.03", "heating.rise_k_per_um2")]
    #[case("offset_vpp = -90.0\n[heating]\nrise_k_per_um2 = 6.58\ntime_constant_s = 0.03", "heating.rise_k_per_um2")]
    #[case(
        "[second_mode]\nresonance_hz = 0.0\ntime_constant_ms = 1.0\ngain_um_per_vpp = 1.0",
        "second_mode.resonance_hz"
    )]
    #[case(
        "[second_mode]\nresonance_hz = 3e4\ntime_constant_ms = 1e-3\ngain_um_per_vpp = 1.0",
        "second_mode.time_constant_ms"
    )]
    #[case(
        "[second_mode]\nresonance_hz = 3e4\ntime_constant_ms = 1.0\ngain_um_per_vpp = 0.0",
        "second_mode.gain_um_per_vpp"
    )]
    fn refuses_invalid_effects(#[case] keys: &str, #[case] key: &str) {
        let text = PAPER.replacen("[sensor]\nnoise_um_rms = 0.0", "", 1);
        let text = text.replacen("limit_vpp = 900.0", &format!("limit_vpp = 900.0\n{keys} #"), 1);
        assert_eq!(read(&text).unwrap_err().key, key);
    }

    #[test]
    fn accepts_the_strongest_self_heating() {
        let heating = "limit_vpp = 900.0\n[heating]\nrise_k_per_um2 = 6.58\ntime_constant_s = 0.03\n#";
        let plate =
            read(&PAPER.replacen("[sensor]\nnoise_um_rms = 0.0", "", 1).replacen("limit_vpp = 900.0", heating, 1));
        assert!((plate.unwrap().warming_share() / MAX_WARMING_SHARE - 1.0).abs() < 2e-3);
    }

    #[test]
    fn reads_effects_in_the_units_of_the_equations() {
        let keys = "converter_bits = 10\nconverter_range_vpp = 1023.0\nbandwidth_hz = 5000.0\n\
                    slew_rate_vpp_per_ms = 2.0\ndead_time_us = 12.5\noffset_vpp = -1.5\n\
                    [second_mode]\nresonance_hz = 32607.6\ntime_constant_ms = 1.0\ngain_um_per_vpp = -0.001";
        let text = PAPER.replacen("limit_vpp = 900.0", &format!("limit_vpp = 900.0\n{keys} #"), 1);
        let plate = read(&text).unwrap();
        let converter = DriveConverter { bits: 10, range_vpp: 1023.0 };
        assert_eq!(converter.step_vpp(), 1.0);
        let expected = Amplifier {
            converter: Some(converter),
            dead_time: Time::from_nanos(12_500),
            pole: Some(5000.0 * TAU),
            slew_rate: Some(2000.0),
            offset_vpp: -1.5,
        };
        assert_eq!(plate.effects.amplifier, expected);
        let second = SecondMode { omega0: 32607.6 * TAU, sigma0: 1000.0, gain: -0.001 };
        assert_eq!(plate.effects.second_mode, Some(second));
        assert_eq!(plate.first_effect(), Some("second_mode"));
        assert_eq!(read(PAPER).unwrap().first_effect(), None);
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
        let components = with_lockin("converter_bits = 12\nconverter_range_um = 4.0").unwrap();
        assert_eq!((components.lockin, components.resolution), (None, resolution));
        let bare = with_lockin("demodulator_periods = 1\nconverter_hz = 1e6").unwrap();
        assert_eq!(bare.lockin, Some(Lockin { converter_hz: 1e6, periods: 1, resolution: None }));
    }

    #[rstest]
    #[case("periods = 8", "periods = 0", "sensor.demodulator_periods")]
    #[case("periods = 8", "periods = -1", "sensor.demodulator_periods")]
    #[case("periods = 8", "periods = 10001", "sensor.demodulator_periods")]
    // 10 000 periods of 32.3076 kHz at 4 MHz are 1.24e6 samples, above the limit of 1e6.
    #[case("periods = 8\nconverter_hz = 1e6", "periods = 10000\nconverter_hz = 4e6", "sensor.demodulator_periods")]
    #[case("demodulator_periods = 8\n", "", "sensor.converter_hz")]
    #[case("demodulator_periods = 8\nconverter_hz = 1e6\nconverter_bits = 12\n", "", "sensor.converter_bits")]
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
