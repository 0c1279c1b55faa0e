//! Measures W with latency and drift, with a gain error, white noise on both components, and
//! rounding by a converter.

use crate::effect::{ActiveEffect, Effect, MAX_DELAY_US, PlateError, Step, check, converter, delay, finite};
use crate::motion::Motion;
use crate::time::Time;
use num_complex::Complex64;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Constant 1.5 · 2⁵². Adding and subtracting it rounds to the nearest integer, ties to even.
const ROUNDING_OFFSET: f64 = 6_755_399_441_055_744.0;

/// `[sensor]`
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
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
    /// Range of the converter, µm. It clips below −range and above the range minus one step (two's
    /// complement).
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub converter_range_um: Option<f64>,
    /// Age of the demodulated components when they reach the controller, µs.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = MAX_DELAY_US))]
    pub latency_us: f64,
    /// Change of the sensor's gain since the start of the trial, percent per second.
    #[serde(default)]
    pub gain_drift_percent_per_s: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConverterResolution {
    /// Number of bits from 2 to 32, including the sign bit.
    pub bits: u32,
    /// The codes reach from `-range_um` to one step below `range_um`.
    pub range_um: f64,
}

impl ConverterResolution {
    pub(crate) fn check(table: &RawSensor) -> Result<Option<Self>, PlateError> {
        let keys = ["sensor.converter_bits", "sensor.converter_range_um"];
        let checked = converter(keys, table.converter_bits, table.converter_range_um)?;
        Ok(checked.map(|(bits, range_um)| Self { bits, range_um }))
    }

    pub(crate) fn convert(&self, y: f64) -> f64 {
        let (step, codes) = (self.step_um(), f64::from(1_u32 << (self.bits - 1)));
        let code = (y / step).clamp(-codes, codes - 1.0);
        ((code + ROUNDING_OFFSET) - ROUNDING_OFFSET) * step
    }

    pub fn step_um(&self) -> f64 {
        self.range_um / f64::from(1_u32 << (self.bits - 1))
    }
}

/// Latency and drift of the sensor. Noise and rounding are those of [`Sensor`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SensorElectronics {
    pub latency: Time,
    /// Change of the sensor's gain per second, as a fraction of the gain.
    pub gain_drift_per_s: f64,
}

#[derive(Debug, Clone)]
struct ActiveElectronics {
    electronics: SensorElectronics,
    /// Start time and motion of each step that is needed for the last latency.
    motions: VecDeque<(Time, Motion)>,
}

impl Effect for SensorElectronics {
    type Table = RawSensor;

    fn check(table: &RawSensor) -> Result<Self, PlateError> {
        const LATENCY: &str = "sensor.latency_us";
        let latency = delay(LATENCY, table.latency_us)?;
        check(
            table.latency_us == 0.0 || table.demodulator_periods.is_none(),
            LATENCY,
            &table.latency_us,
            "0 with `demodulator_periods`, because the demodulator has its own latency",
        )?;
        let drift = finite("sensor.gain_drift_percent_per_s", table.gain_drift_percent_per_s)?;
        Ok(Self { latency, gain_drift_per_s: drift / 100.0 })
    }

    fn key(&self) -> Option<&'static str> {
        if self.latency > Time::ZERO {
            Some("sensor.latency_us")
        } else {
            (self.gain_drift_per_s != 0.0).then_some("sensor.gain_drift_percent_per_s")
        }
    }

    fn start(&self) -> Option<Box<dyn ActiveEffect>> {
        let motions = VecDeque::with_capacity(if self.latency > Time::ZERO { 1024 } else { 0 });
        Some(Box::new(ActiveElectronics { electronics: *self, motions }))
    }
}

impl ActiveEffect for ActiveElectronics {
    fn finish(&mut self, step: &Step<'_>) {
        let latency = self.electronics.latency;
        if latency == Time::ZERO {
            return;
        }
        while self.motions.get(1).is_some_and(|(next, _)| *next + latency <= step.start) {
            self.motions.pop_front();
        }
        self.motions.push_back((step.start, *step.motion));
    }

    fn read(&self, w: Complex64, now: Time) -> Complex64 {
        let SensorElectronics { latency, gain_drift_per_s } = self.electronics;
        let w = if latency == Time::ZERO { w } else { self.earlier(now, latency) };
        w * (1.0 + gain_drift_per_s * now.seconds())
    }
}

impl ActiveElectronics {
    /// W at `now` minus the latency; 0 if this is before the start of the trial.
    fn earlier(&self, now: Time, latency: Time) -> Complex64 {
        if now < latency {
            return Complex64::ZERO;
        }
        let then = now - latency;
        let motion = self.motions.iter().rev().find(|(start, _)| *start <= then);
        motion.map_or(Complex64::ZERO, |(start, motion)| motion.after((then - *start).seconds()).sum().w)
    }
}

#[derive(Debug, Clone)]
pub struct Sensor {
    gain: f64,
    noise_um_rms: f64,
    resolution: Option<ConverterResolution>,
    random: ChaCha8Rng,
}

impl Sensor {
    /// Measures `gain · W` plus noise with standard deviation `noise_um_rms` on each component.
    pub fn new(gain: f64, noise_um_rms: f64, seed: u64) -> Self {
        Self { gain, noise_um_rms, resolution: None, random: ChaCha8Rng::seed_from_u64(seed) }
    }

    /// Rounds and clips each component after the noise is added.
    #[must_use]
    pub fn with_resolution(self, resolution: Option<ConverterResolution>) -> Self {
        Self { resolution, ..self }
    }

    pub fn measure(&mut self, w: Complex64) -> Complex64 {
        let w = w * self.gain + self.noise();
        match &self.resolution {
            None => w,
            Some(resolution) => Complex64::new(resolution.convert(w.re), resolution.convert(w.im)),
        }
    }

    fn noise(&mut self) -> Complex64 {
        if self.noise_um_rms == 0.0 {
            // A sum with −0 keeps its bits, unlike a sum with +0.
            return Complex64::new(-0.0, -0.0);
        }
        let mut noise = || -> f64 { StandardNormal.sample(&mut self.random) };
        Complex64::new(noise(), noise()) * self.noise_um_rms
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sensor_without_noise_only_applies_its_gain() {
        let mut sensor = Sensor::new(1.5, 0.0, 1);
        assert_eq!(sensor.measure(Complex64::new(2.0, -1.0)), Complex64::new(3.0, -1.5));
    }

    #[test]
    fn a_converter_rounds_and_clips_each_component() {
        let resolution = Some(ConverterResolution { bits: 4, range_um: 4.0 });
        let mut sensor = Sensor::new(1.0, 0.0, 1).with_resolution(resolution);
        assert_eq!(sensor.measure(Complex64::new(1.26, -0.74)), Complex64::new(1.5, -0.5));
        assert_eq!(sensor.measure(Complex64::new(9.0, -9.0)), Complex64::new(3.5, -4.0));
    }

    #[test]
    fn noise_has_its_deviation_and_follows_its_seed() {
        let draw = |seed| {
            let mut sensor = Sensor::new(1.0, 0.01, seed);
            (0..20_000).map(|_| sensor.measure(Complex64::ZERO)).collect::<Vec<_>>()
        };
        let noise = draw(1);
        for component in [|z: &Complex64| z.re, |z: &Complex64| z.im] {
            let squares: f64 = noise.iter().map(|z| component(z).powi(2)).sum();
            let deviation = (squares / noise.len() as f64).sqrt();
            // Limit: three standard errors of a standard deviation from 20 000 draws, 1.5 %.
            assert!((deviation / 0.01 - 1.0).abs() < 0.015, "{deviation}");
        }
        assert_eq!(noise, draw(1));
        assert_ne!(noise, draw(2));
    }
}
