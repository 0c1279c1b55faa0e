//! Judges the residuals of a fit: colour, power after changes, and information criterion.

use crate::identify::estimate::Estimate;
use crate::identify::fit::DirectFit;
use platebench_model::recording::{RecordedInput, Recording};
use platebench_plate::plausible::{MAX_DETUNING_HZ, NOISE};
use platebench_plate::{Complex64, Conditions};
use statrs::distribution::{Binomial, ContinuousCDF, DiscreteCDF, FisherSnedecor};
use std::f64::consts::TAU;

const LEVEL: f64 = 0.01;
/// Smallest residuals, as a fraction of the largest |W|, that are tested. Smaller ones are rounding
/// errors, because the protocol uses f32.
const ROUNDING: f64 = 1e-5;
/// Number of samples from a change on that belong to its transient.
pub(crate) const TRANSIENT_SAMPLES: usize = 5;
/// Smallest change of the steady W, as a fraction of the largest one, that has a transient.
const SMALLEST_CHANGE: f64 = 0.05;
const FEWEST_SAMPLES: usize = 4;
/// Level of the test of transients. It is low, because the test is made for every recording.
const TRANSIENT_LEVEL: f64 = 1e-4;

pub(crate) fn is_coloured(recording: &Recording, fit: &DirectFit) -> bool {
    fit.whiteness.is_some_and(|white| white.is_rejected()) && is_above_rounding(recording, fit)
}

fn is_above_rounding(recording: &Recording, fit: &DirectFit) -> bool {
    fit.noise_um > ROUNDING * largest_amplitude(recording)
}

pub(crate) fn largest_amplitude(recording: &Recording) -> f64 {
    recording.outputs.iter().map(|output| output.w.norm()).fold(0.0, f64::max)
}

/// Noise in percent of the largest amplitude.
pub(crate) fn noise_percent(recording: &Recording, fit: &DirectFit) -> f64 {
    fit.noise_um / largest_amplitude(recording) * 100.0
}

/// True if the noise or the distance of the resonance from the excitation is impossible.
pub(crate) fn is_implausible(recording: &Recording, fit: &DirectFit) -> bool {
    detuning_hz(recording, fit) > MAX_DETUNING_HZ || NOISE.check(noise_percent(recording, fit)).is_some()
}

/// Largest distance of a resonance from the nearest excitation under the same temperature and
/// force, Hz. 0 without such an excitation.
pub(crate) fn detuning_hz(recording: &Recording, fit: &DirectFit) -> f64 {
    let distance = |(conditions, resonance): &(Conditions, Estimate)| {
        let driven = recording.inputs.iter().filter(|input| input.vpp > 0.0 && input.conditions == *conditions);
        driven.map(|input| (input.omega - resonance.value).abs()).reduce(f64::min)
    };
    fit.resonances.iter().filter_map(distance).fold(0.0, f64::max) / TAU
}

/// Schwarz's criterion `n ln s² + p ln n` of n values with the mean square s² and p parameters. A
/// smaller one is better. Residuals below rounding errors count as rounding errors.
pub(crate) fn information(recording: &Recording, fit: &DirectFit) -> f64 {
    let (count, parameters) = (2.0 * recording.outputs.len() as f64, fit.parameters as f64);
    let floor = ROUNDING * largest_amplitude(recording);
    let square = (fit.noise_um.powi(2) * (1.0 - parameters / count)).max(floor * floor).max(f64::MIN_POSITIVE);
    count * square.ln() + parameters * count.ln()
}

/// Sums of squared residuals in units of their mean square, and their numbers of values.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct TransientPower {
    after_changes: f64,
    values_after_changes: f64,
    rest: f64,
    values_of_rest: f64,
}

impl TransientPower {
    /// `None` if there are too few samples, or residuals below rounding errors.
    pub(crate) fn of(recording: &Recording, fit: &DirectFit) -> Option<Self> {
        let mut is_near = vec![false; recording.outputs.len()];
        let half = recording.period() / 2.0;
        for t in change_times(recording, fit) {
            let first = recording.outputs.partition_point(|output| output.t < t - half);
            is_near.iter_mut().skip(first).take(TRANSIENT_SAMPLES).for_each(|near| *near = true);
        }
        let near = is_near.iter().filter(|near| **near).count();
        if near < FEWEST_SAMPLES || is_near.len() - near < FEWEST_SAMPLES || !is_above_rounding(recording, fit) {
            return None;
        }
        let mut power = Self::default();
        for ((output, model), near) in recording.outputs.iter().zip(&fit.curve).zip(is_near) {
            let square = (output.w - model).norm_sqr() / fit.noise_um.powi(2);
            let (sum, count) = if near {
                (&mut power.after_changes, &mut power.values_after_changes)
            } else {
                (&mut power.rest, &mut power.values_of_rest)
            };
            *sum += square;
            *count += 2.0;
        }
        Some(power)
    }

    pub(crate) fn sum(powers: &[Self]) -> Self {
        powers.iter().fold(Self::default(), |sum, each| Self {
            after_changes: sum.after_changes + each.after_changes,
            values_after_changes: sum.values_after_changes + each.values_after_changes,
            rest: sum.rest + each.rest,
            values_of_rest: sum.values_of_rest + each.values_of_rest,
        })
    }

    /// Mean square after changes over that of the rest.
    pub(crate) fn ratio(&self) -> f64 {
        self.after_changes / self.values_after_changes / (self.rest / self.values_of_rest)
    }

    /// F test: true if chance gives such a ratio in `tests` tests with a probability below 1e-4.
    pub(crate) fn is_rejected(&self, tests: usize) -> bool {
        let distribution = FisherSnedecor::new(self.values_after_changes, self.values_of_rest);
        distribution.is_ok_and(|f| f.sf(self.ratio()) * (tests as f64) < TRANSIENT_LEVEL)
    }
}

/// Times at which the steady W changes by more than [`SMALLEST_CHANGE`].
fn change_times(recording: &Recording, fit: &DirectFit) -> Vec<f64> {
    let sigma = |force: f64| fit.time_constants.iter().find(|each| each.0 == force).map(|each| 1.0 / each.1.value);
    let free = fit.time_constants.first().map_or(0.0, |first| 1.0 / first.1.value);
    let steady = |input: &RecordedInput| {
        let omega0 = fit.resonances.iter().find(|each| each.0 == input.conditions)?.1.value;
        let rate = Complex64::new(sigma(input.conditions.finger_force_n)?, input.omega - omega0);
        Some(fit.gain.value * free * input.vpp / rate)
    };
    let steady: Vec<Complex64> = recording.inputs.iter().map(|input| steady(input).unwrap_or_default()).collect();
    let largest = steady.iter().map(|w| w.norm()).fold(0.0, f64::max);
    let steps = recording.inputs.iter().skip(1).zip(steady.array_windows());
    steps
        .filter(|(_, [before, after])| (after - before).norm() > SMALLEST_CHANGE * largest)
        .map(|(input, _)| input.t)
        .collect()
}

pub(crate) fn has_large_transients(recording: &Recording, fit: &DirectFit) -> bool {
    TransientPower::of(recording, fit).is_some_and(|power| power.is_rejected(1))
}

/// True if chance gives this many rejections of white residuals with a probability above 1 %.
pub(crate) fn is_explained_by_chance(rejected: usize, tests: usize) -> bool {
    let Some(fewer) = (rejected as u64).checked_sub(1) else { return true };
    // Allows for the rounding error of the computed probability.
    Binomial::new(LEVEL, tests as u64).is_ok_and(|count| count.sf(fewer) > LEVEL * (1.0 + 1e-9))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejections_explained_by_chance() {
        // Probabilities in %: 1 of 2 1.99; 2 of 15 0.96, 2 of 16 1.09; 3 of 66 2.9, 4 of 66 0.44.
        let cases =
            [(1, 1, false), (1, 2, true), (2, 15, false), (2, 16, true), (3, 66, true), (4, 66, false), (0, 5, true)];
        for (rejected, tests, expected) in cases {
            assert_eq!(is_explained_by_chance(rejected, tests), expected, "{rejected} of {tests}");
        }
    }

    #[test]
    fn compares_the_power_after_changes_by_an_f_test() {
        // F(40, 100): 2.44 is exceeded with a probability of 1.6e-4, 2.6 with 5.1e-5.
        let power = |ratio: f64| TransientPower {
            after_changes: 40.0 * ratio,
            values_after_changes: 40.0,
            rest: 100.0,
            values_of_rest: 100.0,
        };
        assert!((power(2.44).ratio() - 2.44).abs() < 1e-12);
        let rejected = [(2.44, 1), (2.6, 1), (2.6, 2)].map(|(ratio, tests)| power(ratio).is_rejected(tests));
        assert_eq!(rejected, [false, true, false]);
    }
}
