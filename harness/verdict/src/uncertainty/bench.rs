//! States the bench's own uncertainty of a metric in a simulated trial, as an uncertainty budget.
//!
//! Errors of the amplitude, in µm, become errors of the metric by a sensitivity. Sources are
//! `docs/mathematics.md` (propagation, peaks between rows) and `docs/wire-protocol.md` (resolution of
//! the messages). Noise and converters are no part of the budget: a campaign measures their effect by
//! pairs of trials. The error of the model itself, such as that of the envelope, is no part either.

use super::{Component, ComponentKind, Distribution, QuantityBudget, TypeA};
use jiff::civil::Date;
use platebench_model::scenario::{Expectation, Metric, Scenario};
use platebench_plate::{Profile, Time};
use std::f64::consts::{E, PI};

/// Bounds of the propagation error: of constant modes relative to the setpoint, and of moving modes
/// relative to the largest amplitude.
const CONSTANT_PROPAGATION: f64 = 1e-10;
const MOVING_PROPAGATION: f64 = 3e-7;
/// Error relative to the largest amplitude if the pole of the amplifier has the relative distance 1
/// from the damping, and the smallest distance.
const POLE_DIFFERENCE: f64 = 3e-16;
const MIN_POLE_DISTANCE: f64 = 1e-8;
/// Rounding of the end of a ramp of the amplifier, s.
const RAMP_END_S: f64 = 1e-9;
/// Resolution of the search for the crossing of a band, ms.
const CROSSING_MS: f64 = 1e-6;
/// Largest relative rounding error of an `f32`.
const F32_ROUNDING: f64 = 1.0 / 16_777_216.0;
/// Half of the resolution of a frequency in a command.
const FREQUENCY_ROUNDING_HZ: f64 = 5e-4;

/// Origin of an error. Each is a column of the results of a campaign.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ErrorOrigin {
    /// Arithmetic, propagation and rows of the trace.
    Numerical,
    /// Converters, messages, and samples that are known at control instants only.
    Quantisation,
    Sensor,
    /// Scatter of repeated trials.
    Statistics,
}

impl ErrorOrigin {
    pub const ALL: [Self; 4] = [Self::Numerical, Self::Quantisation, Self::Sensor, Self::Statistics];
    /// Origins of the errors that a trial has alone.
    pub const OF_TRIAL: [Self; 3] = [Self::Numerical, Self::Quantisation, Self::Sensor];

    pub const fn name(self) -> &'static str {
        match self {
            Self::Numerical => "numerical",
            Self::Quantisation => "quantisation",
            Self::Sensor => "sensor",
            Self::Statistics => "statistics",
        }
    }
}

impl ComponentKind {
    pub const fn origin(self) -> ErrorOrigin {
        match self {
            Self::Bench => ErrorOrigin::Numerical,
            Self::Converter | Self::Timing => ErrorOrigin::Quantisation,
            Self::SensorGain | Self::SensorOffset | Self::Demodulator | Self::Temperature => ErrorOrigin::Sensor,
            Self::Repeatability => ErrorOrigin::Statistics,
        }
    }
}

/// Change of a metric per µm of the amplitude: in its unit, and in percent of its value.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Sensitivity {
    per_um: f64,
    percent_per_um: f64,
}

impl QuantityBudget {
    /// The budget of one trial. `combine` needs the scatter of the trials.
    pub fn of_bench(scenario: &Scenario, expectation: &Expectation) -> Self {
        let mut budget = Self { quantity: expectation.metric.name().to_owned(), components: Vec::new() };
        let setpoint = smallest_setpoint(scenario, expectation);
        if let (Some(setpoint), Some(step)) = (setpoint, smallest_step(scenario, expectation))
            && let Some(sensitivity) = sensitivity(scenario, expectation, setpoint, step)
        {
            budget.add_amplitude_errors(scenario, setpoint, sensitivity);
        }
        budget.add_own_errors(scenario, expectation);
        budget.add(ComponentKind::Repeatability, Distribution::Normal, None, false, "scatter of the trials");
        budget
    }

    /// Standard uncertainty of all components with this origin; `None` if the budget has none or
    /// if `value` is not finite.
    pub fn standard_of(&self, origin: ErrorOrigin, value: f64, observed: Option<TypeA>) -> Option<f64> {
        let of_origin = self.components.iter().filter(|component| component.kind.origin() == origin);
        let squares = of_origin.filter_map(|component| Some(component.evaluate(value, observed)?.0.powi(2)));
        squares.reduce(|sum, square| sum + square).map(f64::sqrt).filter(|_| value.is_finite())
    }

    /// Standard uncertainty of all components that one trial has alone, as in [`Self::standard_of`].
    pub fn own_standard(&self, value: f64) -> Option<f64> {
        let parts = ErrorOrigin::OF_TRIAL.into_iter().filter_map(|origin| self.standard_of(origin, value, None));
        parts.reduce(f64::hypot)
    }

    fn add_amplitude_errors(&mut self, scenario: &Scenario, setpoint: f64, sensitivity: Sensitivity) {
        use Distribution::Rectangular;
        let plate = &scenario.plate;
        let mut add = |kind, distribution, um: f64, source| {
            for (factor, is_percent) in [(sensitivity.per_um, false), (sensitivity.percent_per_um, true)] {
                if factor > 0.0 {
                    self.add(kind, distribution, Some(um * factor), is_percent, source);
                }
            }
        };
        let propagation = propagation_um(scenario, setpoint);
        add(ComponentKind::Bench, Rectangular, propagation, "docs/mathematics.md, propagation");
        add(ComponentKind::Converter, Rectangular, F32_ROUNDING * setpoint, "docs/wire-protocol.md, f32 of a sample");
        if let Some(lockin) = &plate.lockin {
            let (periods, hz) = (f64::from(lockin.periods), plate.omega0 / (2.0 * PI));
            let samples = periods * lockin.converter_hz / hz;
            let um = PI * periods / (2.0 * samples.powi(2)) * setpoint;
            add(ComponentKind::Demodulator, Rectangular, um, "samples of the lock-in, docs/mathematics.md");
        }
        let drift = plate.effects.sensor.gain_drift_per_s.abs();
        if drift > 0.0 {
            let um = drift * scenario.duration.seconds() * setpoint;
            add(ComponentKind::SensorGain, Rectangular, um, "drift of the sensor's gain over the trial");
        }
    }

    /// Errors that are not errors of the amplitude.
    fn add_own_errors(&mut self, scenario: &Scenario, expectation: &Expectation) {
        let mut add = |kind, half_width: f64, is_percent, source| {
            self.add(kind, Distribution::Rectangular, Some(half_width), is_percent, source);
        };
        match expectation.metric {
            Metric::SettlingTime | Metric::RecoveryTime => {
                add(ComponentKind::Bench, CROSSING_MS, false, "docs/mathematics.md, crossing a band");
                if expectation.signal.starts_with("sensed_") {
                    // The value is the end of a period that contains the entry.
                    add(ComponentKind::Timing, scenario.controller.period.ms(), false, "samples at control instants");
                }
            }
            Metric::FrequencyError => {
                add(ComponentKind::Converter, FREQUENCY_ROUNDING_HZ, false, "docs/wire-protocol.md, mHz of a command");
            }
            Metric::DrivePeak | Metric::RestDrive => {
                add(ComponentKind::Converter, F32_ROUNDING * 100.0, true, "docs/wire-protocol.md, f32 of a command");
            }
            _ => {}
        }
    }

    /// `magnitude` is the half width of a rectangular and the standard deviation of a normal
    /// distribution, in the unit of the metric or in percent of its value.
    fn add(
        &mut self,
        kind: ComponentKind,
        distribution: Distribution,
        magnitude: Option<f64>,
        is_percent_of_value: bool,
        source: &str,
    ) {
        let factor = distribution.standard_of_half_width().unwrap_or(1.0);
        self.components.push(Component {
            kind,
            distribution,
            standard: magnitude.map(|magnitude| magnitude * factor),
            is_percent_of_value,
            degrees_of_freedom: f64::INFINITY,
            source: source.to_owned(),
            date: Date::constant(2026, 11, 27),
            instrument: None,
        });
    }
}

/// Bound on the error of the propagation, µm (`docs/mathematics.md`, bounds of each effect).
fn propagation_um(scenario: &Scenario, setpoint: f64) -> f64 {
    let plate = &scenario.plate;
    let largest = plate.gain * plate.drive_limit_vpp;
    let modes = if has_moving_modes(scenario) {
        (MOVING_PROPAGATION + plate.warming_share() / (4.0 * E)) * largest
    } else {
        CONSTANT_PROPAGATION * setpoint
    };
    let amplifier = &plate.effects.amplifier;
    let force = scenario.conditions.finger_force_n.at(Time::ZERO);
    let sigma = plate.sigma0 * plate.damping_ratio_at(force);
    let of_pole =
        amplifier.pole.map_or(0.0, |pole| POLE_DIFFERENCE / (pole / sigma - 1.0).abs().max(MIN_POLE_DISTANCE));
    let of_slew_rate = amplifier.slew_rate.map_or(0.0, |rate| {
        let unsettled = plate.sigma0 * (rate / plate.drive_limit_vpp * RAMP_END_S).min(1.0) * RAMP_END_S;
        unsettled / -(-sigma * scenario.controller.period.seconds()).exp_m1()
    });
    modes + (of_pole + of_slew_rate) * largest
}

/// True if the temperature or the force moves the modes between two points of its profile.
pub(crate) fn has_moving_modes(scenario: &Scenario) -> bool {
    let moves = |profile: &Profile| {
        let mut time = Time::ZERO;
        loop {
            if profile.max_slope_after(time) > 0.0 {
                return true;
            }
            match profile.next_point_after(time).filter(|next| *next < scenario.duration) {
                Some(next) => time = next,
                None => return false,
            }
        }
    };
    scenario.plate.effects.heating.is_some()
        || moves(&scenario.conditions.temperature_offset_k)
        || moves(&scenario.conditions.finger_force_n)
}

/// `None` if an error of the amplitude does not become an error of the metric.
fn sensitivity(scenario: &Scenario, expectation: &Expectation, setpoint: f64, step: f64) -> Option<Sensitivity> {
    let absolute = |per_um: f64| Some(Sensitivity { per_um, percent_per_um: 0.0 });
    let of_value = |percent_per_um: f64| Some(Sensitivity { per_um: 0.0, percent_per_um });
    let band = expectation.band_percent / 100.0;
    match expectation.metric {
        Metric::StaticError | Metric::Repeatability | Metric::PeakDeviation => absolute(100.0 / setpoint),
        Metric::Overshoot => absolute(100.0 / step),
        // A difference of two values.
        Metric::RipplePercent => absolute(100.0 / setpoint * 2.0_f64.sqrt()),
        Metric::Ripple => absolute(2.0_f64.sqrt()),
        Metric::FinalAmplitude => absolute(1.0),
        // An exponential approach e^(−t/T) to the band b at t = T ln(1/b) has the slope b·s/T.
        Metric::SettlingTime if band < 1.0 => of_value(100.0 / (band * setpoint * (1.0 / band).ln())),
        // The first deviation is not known; the slope is that of t = T.
        Metric::RecoveryTime => of_value(100.0 / (band * setpoint)),
        // √(1 + r²) for r = |Wq/Wd|.
        Metric::QuadratureRatio => Some(Sensitivity { per_um: 1.0 / setpoint, percent_per_um: 100.0 / setpoint }),
        // Wq/Wd = −τ Δω (equation 19).
        Metric::FrequencyError => absolute(scenario.plate.sigma0 / (2.0 * PI * setpoint)),
        // A command follows the samples: with the setpoint as error, the first one is the peak.
        Metric::DrivePeak => of_value(100.0 / setpoint),
        _ => None,
    }
}

/// The smallest setpoint above 0 at the end of a window, µm.
fn smallest_setpoint(scenario: &Scenario, expectation: &Expectation) -> Option<f64> {
    let at_end = expectation.windows.iter().map(|window| scenario.setpoint.at(just_before(window.to)).abs());
    at_end.filter(|setpoint| *setpoint > 0.0).reduce(f64::min)
}

/// The smallest change of the setpoint before the end of a window, µm. The setpoint is 0 before the
/// trial.
fn smallest_step(scenario: &Scenario, expectation: &Expectation) -> Option<f64> {
    let profile = &scenario.setpoint;
    let end = expectation.windows.iter().map(|window| window.to).max()?;
    let (mut level, mut smallest) = (profile.at(Time::ZERO), None::<f64>);
    let mut add = |step: f64| {
        if step > 0.0 {
            smallest = Some(smallest.map_or(step, |smallest| smallest.min(step)));
        }
    };
    add(level.abs());
    let mut time = Time::ZERO;
    while let Some(next) = profile.next_point_after(time).filter(|next| *next < end) {
        let value = profile.at(next);
        add((value - level).abs());
        (level, time) = (value, next);
    }
    smallest
}

const fn just_before(time: Time) -> Time {
    Time::from_nanos(time.as_nanos().saturating_sub(1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_test_kit::{PLATE, parse_scenario};
    use rstest::rstest;

    /// A step to 2 µm, or what `setpoint` says. `sensor` are keys of the plate file.
    fn scenario(setpoint: &str, sensor: &str, expect: &str) -> Scenario {
        let silent = "noise_um_rms = 0.0";
        assert!(PLATE.contains(silent));
        let text = format!(
            "title = \"a\"\nplate = \"plate.toml\"\nduration_ms = 60.0\nexpect = [{{ {expect} }}]\n\
             [profile]\nsetpoint_um = {setpoint}\n"
        );
        parse_scenario(&text, &PLATE.replace(silent, sensor))
    }

    fn budget(setpoint: &str, sensor: &str, expect: &str) -> QuantityBudget {
        let scenario = scenario(setpoint, sensor, expect);
        QuantityBudget::of_bench(&scenario, &scenario.expectations[0])
    }

    const SILENT: &str = "noise_um_rms = 0.0";
    const NOISE: &str = "noise_um_rms = 0.01";
    const DRIFT: &str = "noise_um_rms = 0.0\ngain_drift_percent_per_s = 1.0";
    const STATIC: &str = "metric = \"static_error_percent\", at_most = 1.0";
    const SETTLING: &str = "metric = \"settling_time_ms\", at_most = 5.0";
    const FREQUENCY: &str = "metric = \"frequency_error_hz\", at_most = 5.0";
    const OVERSHOOT: &str = "metric = \"overshoot_percent\", at_most = 5.0";
    const RATIO: &str = "metric = \"quadrature_ratio\", at_most = 5.0";
    const SENSED: &str = "metric = \"settling_time_ms\", at_most = 5.0, signal = \"sensed_wd_um\"";
    const OVERRUNS: &str = "metric = \"overruns\", at_most = 5.0";

    // A rectangular half width a is a/√3: 0.577350. The window of the static error has 20 samples.
    // A settling time of 2 ms changes by 2/(0.05 · 2 µm · ln 20) = 6.67617 ms per µm.
    #[rstest]
    #[case::propagation(STATIC, SILENT, ErrorOrigin::Numerical, Some(1e-8 * 0.577_350))]
    #[case::f32(STATIC, SILENT, ErrorOrigin::Quantisation, Some(5.960_464e-6 * 0.577_350))]
    #[case::no_noise(STATIC, SILENT, ErrorOrigin::Sensor, None)]
    #[case::noise_is_measured_by_pairs(STATIC, NOISE, ErrorOrigin::Sensor, None)]
    // 1 %/s over 60 ms of 2 µm.
    #[case::drift(STATIC, DRIFT, ErrorOrigin::Sensor, Some(0.0012 * 50.0 * 0.577_350))]
    #[case::slope(SETTLING, DRIFT, ErrorOrigin::Sensor, Some(0.0012 * 6.676_17 * 0.577_350))]
    #[case::crossing(
        SETTLING,
        SILENT,
        ErrorOrigin::Numerical,
        Some(0.577_350 * (13.352_34e-10_f64.powi(2) + 1e-12).sqrt())
    )]
    #[case::period(SENSED, SILENT, ErrorOrigin::Quantisation, Some(0.577_350))]
    #[case::millihertz(FREQUENCY, SILENT, ErrorOrigin::Quantisation, Some(0.000_5 * 0.577_350))]
    #[case::peak(OVERSHOOT, SILENT, ErrorOrigin::Numerical, Some(1e-8 * 0.577_350))]
    // √(1 + 2²) of the relative error.
    #[case::ratio(RATIO, SILENT, ErrorOrigin::Numerical, Some(1e-10 * 5.0_f64.sqrt() * 0.577_350))]
    #[case::count(OVERRUNS, NOISE, ErrorOrigin::Numerical, None)]
    #[case::count(OVERRUNS, NOISE, ErrorOrigin::Sensor, None)]
    fn a_value_of_2_has_the_error_of_its_origin(
        #[case] expect: &str,
        #[case] sensor: &str,
        #[case] origin: ErrorOrigin,
        #[case] expected: Option<f64>,
    ) {
        let budget = budget("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", sensor, expect);
        let error = budget.standard_of(origin, 2.0, None);
        let is_equal = match (error, expected) {
            (Some(error), Some(expected)) => (error / expected - 1.0).abs() < 2e-3,
            (error, expected) => error == expected,
        };
        assert!(is_equal, "{error:?}, expected {expected:?}");
        assert_eq!(budget.standard_of(origin, f64::NAN, None), None);
        assert_eq!(budget.standard_of(origin, f64::INFINITY, None), None);
    }

    #[test]
    fn statistics_are_the_scatter_of_the_trials() {
        let budget = budget("2.0", DRIFT, STATIC);
        let observed = TypeA { standard: 0.25, degrees_of_freedom: 3.0 };
        assert_eq!(budget.standard_of(ErrorOrigin::Statistics, 1.0, None), None);
        assert_eq!(budget.standard_of(ErrorOrigin::Statistics, 1.0, Some(observed)), Some(0.25));
        let combined = budget.combine(1.0, Some(observed), 0.95).unwrap();
        let parts = ErrorOrigin::ALL.map(|origin| budget.standard_of(origin, 1.0, Some(observed)).unwrap());
        let squares: f64 = parts.iter().map(|part| part.powi(2)).sum();
        assert!((combined.standard - squares.sqrt()).abs() < 1e-12, "{combined:?} {parts:?}");
    }

    // Relative to 6.282 µm; 0.577350 in percent of 2 µm is 28.8675 per µm.
    #[rstest]
    #[case::no_effect("", 1e-10 * 2.0)]
    #[case::other_bandwidth("bandwidth_hz = 5e3", 1e-10 * 2.0)]
    // 1/(2π · 1.88 ms).
    #[case::bandwidth_of_the_plate("bandwidth_hz = 84.656884623349", 2e-10 + 3e-8 * 6.282)]
    // σ0 · 9e10/900 Vpp/s · (1 ns)² of 6.282 µm, for periods of 1 ms: 1 − e^(−1/1.88) = 0.41248.
    #[case::slew_rate("slew_rate_vpp_per_ms = 9e7", 2e-10 + 531.915 * 1e8 * 1e-18 / 0.412_48 * 6.282)]
    #[case::slew_rate_above_the_resolution("slew_rate_vpp_per_ms = 9e20", 2e-10 + 531.915 * 1e-9 / 0.412_48 * 6.282)]
    // 9.638 Hz/K · 2π · 4 K/µm² · (6.282 µm)² / 0.03 s / (202 995/s)².
    #[case::heating("\n[heating]\nrise_k_per_um2 = 4.0\ntime_constant_s = 0.03\n", (3e-7 + 7.7328e-6 / 10.873_13) * 6.282)]
    fn the_propagation_has_the_bound_of_its_effects(#[case] keys: &str, #[case] um: f64) {
        let plate = PLATE.replace("limit_vpp = 900.0", &format!("limit_vpp = 900.0\n{keys} #"));
        let text = format!(
            "title = \"a\"\nplate = \"plate.toml\"\nduration_ms = 60.0\nexpect = [{{ {STATIC} }}]\n\
             [profile]\nsetpoint_um = {{ hold = [[0.0, 0.0], [1.0, 2.0]] }}\n"
        );
        let scenario = parse_scenario(&text, &plate);
        let budget = QuantityBudget::of_bench(&scenario, &scenario.expectations[0]);
        let error = budget.standard_of(ErrorOrigin::Numerical, 1.0, None).unwrap();
        assert!((error / (um * 28.8675) - 1.0).abs() < 2e-3, "{} µm, expected {um}", error / 28.8675);
    }

    #[test]
    fn moving_modes_have_the_larger_bound() {
        let moving = "2.0\nfinger_force_n = { linear = [[0.0, 0.0], [60.0, 0.5]] }";
        let errors = ["2.0", moving]
            .map(|profile| budget(profile, SILENT, STATIC).standard_of(ErrorOrigin::Numerical, 1.0, None).unwrap());
        // 3e-7 of 6.282 µm in percent of 2 µm.
        assert!((errors[1] / (3e-7 * 6.282 * 50.0 * 0.577_350) - 1.0).abs() < 2e-3, "{errors:?}");
        assert!(errors[0] < 1e-3 * errors[1]);
    }
}
