//! Draws the plate, sensor and temperature of a trial from its seed.

use crate::scenario::definition::{Scenario, Spread};
use platebench_plate::{ConditionProfiles, Plant, Plate, Profile, Sensor};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

/// Number of the random stream. The sensor's noise has another stream, so that either one can be
/// switched off without a change of the other.
const SPREAD_STREAM: u64 = 1;
/// Largest deviation of a factor from 1: 4.5 standard deviations of the largest spread, 20 %.
const MAX_DEVIATION: f64 = 0.9;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Variation {
    pub seed: u64,
    /// Factor on the plate's gain K1.
    pub gain: f64,
    /// Factor on the plate's time constant τ.
    pub time_constant: f64,
    pub sensor_gain: f64,
    pub temperature_k: f64,
}

impl Variation {
    pub fn of_trial(scenario: &Scenario, index: u32) -> Self {
        Self::draw(&scenario.trials.spread, scenario.trials.seed.wrapping_add(u64::from(index)))
    }

    pub fn draw(spread: &Spread, seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(SPREAD_STREAM);
        let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
        let mut factor = |percent: f64| 1.0 + (normal() * percent / 100.0).clamp(-MAX_DEVIATION, MAX_DEVIATION);
        Self {
            seed,
            gain: factor(spread.gain_percent),
            time_constant: factor(spread.time_constant_percent),
            sensor_gain: factor(spread.sensor_gain_percent),
            temperature_k: normal() * spread.temperature_k,
        }
    }

    pub fn plate(&self, nominal: &Plate) -> Plate {
        Plate { gain: nominal.gain * self.gain, sigma0: nominal.sigma0 / self.time_constant, ..nominal.clone() }
    }

    pub fn plant(&self, scenario: &Scenario) -> Plant {
        let scene = ConditionProfiles {
            temperature_offset_k: shift_profile(&scenario.conditions.temperature_offset_k, self.temperature_k),
            finger_force_n: scenario.conditions.finger_force_n.clone(),
        };
        Plant::new(self.plate(&scenario.plate), scene, scenario.tier)
    }

    pub fn sensor(&self, scenario: &Scenario) -> Sensor {
        Sensor::new(self.sensor_gain, scenario.plate.noise_um_rms, self.seed).with_resolution(scenario.plate.resolution)
    }
}

fn shift_profile(profile: &Profile, by: f64) -> Profile {
    let moved = |points: &[_]| points.iter().map(|(time, value)| (*time, value + by)).collect();
    match profile {
        Profile::Hold(points) => Profile::Hold(moved(points)),
        Profile::Linear(points) => Profile::Linear(moved(points)),
        Profile::Sine { mean, amplitude, omega, phase } => {
            Profile::Sine { mean: mean + by, amplitude: *amplitude, omega: *omega, phase: *phase }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_have_their_deviation_and_follow_their_seed() {
        let spread = Spread { sensor_gain_percent: 1.2, temperature_k: 0.5, ..Spread::default() };
        let trials: Vec<_> = (0..10_000).map(|seed| Variation::draw(&spread, seed)).collect();
        let deviation = |of: fn(&Variation) -> f64| {
            (trials.iter().map(|trial| of(trial).powi(2)).sum::<f64>() / trials.len() as f64).sqrt()
        };
        // Three standard errors of a standard deviation over 10 000 draws: 2.1 %.
        assert!((deviation(|trial| trial.sensor_gain - 1.0) / 0.012 - 1.0).abs() < 0.021);
        assert!((deviation(|trial| trial.temperature_k) / 0.5 - 1.0).abs() < 0.021);
        assert!(trials.iter().all(|trial| trial.gain == 1.0 && trial.time_constant == 1.0));
        assert_eq!(trials[7], Variation::draw(&spread, 7));
    }

    #[test]
    fn one_spread_does_not_move_another() {
        let only = Variation::draw(&Spread { sensor_gain_percent: 1.0, ..Spread::default() }, 3);
        let both = Variation::draw(&Spread { sensor_gain_percent: 1.0, gain_percent: 5.0, ..Spread::default() }, 3);
        assert_eq!(only.sensor_gain, both.sensor_gain);
    }
}
