//! Finds recordings that no single plate can produce, and parameters that no plate has.

use crate::identify::estimate::Estimate;
use crate::identify::estimate::IdentifiedSecondMode;
use crate::identify::fit::{DirectFit, fit_direct};
use platebench_model::recording::{RecordedSample, Recording};
use platebench_plate::plausible::{
    GAIN, MAX_DETUNING_HZ, NOISE, PlausibleRange, QUALITY_FACTOR, RESONANCE, TIME_CONSTANT,
};
use platebench_plate::{Complex64, Conditions, ImplausibleValue};
use schemars::JsonSchema;
use serde::Serialize;
use statrs::distribution::{Binomial, DiscreteCDF};
use std::f64::consts::{PI, TAU};

const LEVEL: f64 = 0.01;
/// Smallest residuals, as a fraction of the largest |W|, that are tested. Smaller ones are rounding
/// errors, because the protocol uses f32.
const ROUNDING: f64 = 1e-5;
/// A component is clipped if a larger fraction of samples equals its largest or smallest value.
const CLIPPED_SHARE: f64 = 0.02;
/// Smallest number of samples at a limit that count as clipping.
const MIN_CLIPPED: usize = 5;
/// Largest change of K1 between the drives of a linear plate, percent.
const LINEAR_PERCENT: f64 = 2.0;

/// Reason why the identified parameters are doubtful.
#[derive(Debug, Clone, PartialEq, Serialize, thiserror::Error, JsonSchema)]
#[serde(rename_all = "kebab-case", tag = "kind")]
pub enum Inconsistency {
    /// The residuals are not white, because the model does not describe a change of the plate.
    #[error(
        "{rejected} of {tested} recordings have residuals that are not white: the plate changed (drift, \
         amplitude-dependent damping) or the columns are wrong"
    )]
    Residuals {
        /// Number of recordings with such residuals.
        rejected: usize,
        tested: usize,
    },
    #[error("{recording}: {component} is clipped at {limit_um} µm in {samples} samples")]
    Clipped {
        recording: String,
        /// `Wd` or `Wq`.
        component: &'static str,
        limit_um: f64,
        samples: usize,
    },
    #[error("{recording}: the model fits better with Wd and Wq exchanged; check the columns of wd and wq")]
    Swapped { recording: String },
    /// A parameter outside the range of `platebench_plate::plausible`.
    #[error("{text}")]
    Implausible {
        quantity: &'static str,
        value: f64,
        low: f64,
        high: f64,
        #[serde(skip)]
        text: String,
    },
    #[error(
        "{recording}: the resonance is {distance_hz:.0} Hz from the excitation, expected at most {MAX_DETUNING_HZ} \
         Hz; check the unit of the frequency, the drive, and that wd and wq are not exchanged"
    )]
    Detuned {
        recording: String,
        /// Distance of the resonance from the nearest excitation frequency.
        distance_hz: f64,
    },
    #[error("K1 changes by {change_percent:.1} % from the lowest to the highest drive, expected a linear plate")]
    NotLinear { change_percent: f64 },
}

impl Inconsistency {
    fn implausible(found: &ImplausibleValue, recording: Option<&Recording>) -> Self {
        let PlausibleRange { quantity, low, high, .. } = found.range;
        let text = recording.map_or_else(|| found.to_string(), |recording| format!("{}: {found}", recording.name));
        Self::Implausible { quantity, value: found.value, low, high, text }
    }
}

/// Clipped samples, residuals that are not white, and estimates that do not fit the recording.
pub(crate) fn inconsistent_recordings(fitted: &[(&Recording, DirectFit)]) -> Vec<Inconsistency> {
    let mut inconsistencies: Vec<Inconsistency> =
        fitted.iter().flat_map(|(recording, _)| find_clipping(recording)).collect();
    let coloured: Vec<_> = fitted.iter().filter(|(recording, fit)| is_coloured(recording, fit)).collect();
    let tested = fitted.iter().filter(|(_, fit)| fit.whiteness.is_some()).count();
    if !coloured.is_empty() && !is_explained_by_chance(coloured.len(), tested) {
        inconsistencies.push(Inconsistency::Residuals { rejected: coloured.len(), tested });
    }
    for (recording, fit) in fitted {
        if let Some(distance_hz) = Some(detuning_hz(recording, fit)).filter(|distance| *distance > MAX_DETUNING_HZ) {
            inconsistencies.push(Inconsistency::Detuned { recording: recording.name.clone(), distance_hz });
        }
        let noise = NOISE.check(fit.noise_um / largest_amplitude(recording) * 100.0);
        inconsistencies.extend(noise.map(|found| Inconsistency::implausible(&found, Some(recording))));
    }
    inconsistencies
}

/// Largest distance of a resonance from the nearest excitation under the same temperature and
/// force, Hz. 0 without such an excitation.
fn detuning_hz(recording: &Recording, fit: &DirectFit) -> f64 {
    let distance = |(conditions, resonance): &(Conditions, Estimate)| {
        let driven = recording.inputs.iter().filter(|input| input.vpp > 0.0 && input.conditions == *conditions);
        driven.map(|input| (input.omega - resonance.value).abs()).reduce(f64::min)
    };
    fit.resonances.iter().filter_map(distance).fold(0.0, f64::max) / TAU
}

fn largest_amplitude(recording: &Recording) -> f64 {
    recording.outputs.iter().map(|output| output.w.norm()).fold(0.0, f64::max)
}

pub(crate) fn implausible_parameters(
    resonance_hz: Option<Estimate>,
    time_constant_s: Option<Estimate>,
    gain_um_per_vpp: Option<Estimate>,
    second_mode: Option<IdentifiedSecondMode>,
    gain_change_percent: Option<Estimate>,
) -> Vec<Inconsistency> {
    let value = |estimate: Option<Estimate>| estimate.map(|estimate| estimate.value);
    let quality = value(resonance_hz).zip(value(time_constant_s)).map(|(resonance, tau)| PI * resonance * tau);
    let second_tau = PlausibleRange { quantity: "time constant of the second mode", ..TIME_CONSTANT };
    let checks = [
        (RESONANCE, value(resonance_hz)),
        (TIME_CONSTANT, value(time_constant_s).map(|tau| tau * 1e3)),
        (GAIN, value(gain_um_per_vpp)),
        (QUALITY_FACTOR, quality),
        (second_tau, second_mode.map(|second| second.time_constant_s.value * 1e3)),
    ];
    let implausible = checks.into_iter().filter_map(|(range, value)| range.check(value?));
    let mut inconsistencies: Vec<Inconsistency> =
        implausible.map(|found| Inconsistency::implausible(&found, None)).collect();
    if let Some(change) = gain_change_percent
        && change.value.abs() > LINEAR_PERCENT
        && !change.contains(0.0)
    {
        inconsistencies.push(Inconsistency::NotLinear { change_percent: change.value });
    }
    inconsistencies
}

pub(crate) fn is_coloured(recording: &Recording, fit: &DirectFit) -> bool {
    fit.whiteness.is_some_and(|white| white.is_rejected()) && fit.noise_um > ROUNDING * largest_amplitude(recording)
}

fn find_clipping(recording: &Recording) -> Vec<Inconsistency> {
    type Component = fn(&Complex64) -> f64;
    let components: [(&str, Component); 2] = [("Wd", |w| w.re), ("Wq", |w| w.im)];
    let mut inconsistencies = Vec::new();
    for (component, value) in components {
        let values: Vec<f64> = recording.outputs.iter().map(|output| value(&output.w)).collect();
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        for limit_um in [low, high] {
            let samples = values.iter().filter(|value| **value == limit_um).count();
            // A plate at rest gives 0, and a constant column has equal limits; neither is clipping.
            let enough = samples >= MIN_CLIPPED && samples as f64 > CLIPPED_SHARE * values.len() as f64;
            if limit_um != 0.0 && low < high && enough {
                inconsistencies.push(Inconsistency::Clipped {
                    recording: recording.name.clone(),
                    component,
                    limit_um,
                    samples,
                });
            }
        }
    }
    inconsistencies
}

/// True if the columns of Wd and Wq are probably exchanged: the fit is poor, far from the
/// excitation or impossible, and the fit with exchanged components is better. `fit` has no effects,
/// because a second mode describes exchanged components well.
pub(crate) fn has_exchanged_components(recording: &Recording, fit: Option<&DirectFit>) -> bool {
    let is_detuned = |fit: &DirectFit| detuning_hz(recording, fit) > MAX_DETUNING_HZ;
    if fit.is_some_and(|fit| !is_coloured(recording, fit) && !is_detuned(fit)) {
        return false;
    }
    let exchange = |output: &RecordedSample| RecordedSample { w: Complex64::new(output.w.im, output.w.re), ..*output };
    let exchanged = Recording { outputs: recording.outputs.iter().map(exchange).collect(), ..recording.clone() };
    let Ok(other) = fit_direct(&exchanged) else { return false };
    match fit {
        Some(fit) if is_detuned(fit) => !is_detuned(&other) && other.noise_um < 2.0 * fit.noise_um,
        Some(fit) => other.noise_um < 0.5 * fit.noise_um,
        None => !is_detuned(&other) && NOISE.check(other.noise_um / largest_amplitude(recording) * 100.0).is_none(),
    }
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
}
