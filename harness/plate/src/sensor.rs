//! Measures W with a gain error, white noise on both components, and rounding by a converter.

use crate::lockin::ConverterResolution;
use num_complex::Complex64;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

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
