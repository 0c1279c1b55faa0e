//! Finds recordings that no single plate can produce, and parameters that no plate has.

use crate::identify::alignment::MAX_ROTATION_DEG;
use crate::identify::estimate::{Estimate, IdentifiedSecondMode};
use crate::identify::fit::DirectFit;
use crate::identify::residuals::{
    TRANSIENT_SAMPLES, TransientPower, detuning_hz, is_coloured, is_explained_by_chance, noise_percent,
};
use platebench_model::recording::Recording;
use platebench_plate::plausible::{
    GAIN, MAX_DETUNING_HZ, NOISE, PlausibleRange, QUALITY_FACTOR, RESONANCE, TIME_CONSTANT,
};
use platebench_plate::{Complex64, ImplausibleValue};
use schemars::JsonSchema;
use serde::Serialize;
use std::f64::consts::{PI, TAU};

/// A component is clipped if a larger fraction of samples equals its largest or smallest value.
const CLIPPED_SHARE: f64 = 0.02;
/// Smallest number of samples at a limit that count as clipping.
const MIN_CLIPPED: usize = 5;
/// A mirrored Wq is probable if the resonances then disagree this many times less; more for fewer
/// than [`MANY_POINTS`] degrees of freedom.
const MIRRORED_AGREEMENT: f64 = 4.0;
const MIRRORED_AGREEMENT_OF_FEW: f64 = 10.0;
const MANY_POINTS: f64 = 4.0;
/// Smallest disagreement of resonances, in standard errors, that a mirrored Wq explains.
const DISAGREEMENT: f64 = 5.0;
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
    #[error(
        "{count} of {tested} recordings: the mean square of the residuals in the {TRANSIENT_SAMPLES} samples from each \
         change on is {ratio:.1} times that of the other samples: the inputs act at other times than recorded. Check \
         for lost rows, wrong or jittered time stamps, and a varying delay between a row and its drive"
    )]
    Transients {
        /// Number of recordings with such residuals.
        count: usize,
        tested: usize,
        ratio: f64,
    },
    /// Wd and Wq are exchanged, or the demodulator is rotated by about 90°.
    #[error("{recording}: {text}")]
    Swapped {
        recording: String,
        rotation_deg: f64,
        #[serde(skip)]
        text: String,
    },
    /// A component has the wrong sign, or the demodulator is rotated by a large angle.
    #[error("{recording}: {text}")]
    Rotated {
        recording: String,
        rotation_deg: f64,
        /// True if the sign of Wq is reversed too.
        is_mirrored: bool,
        #[serde(skip)]
        text: String,
    },
    #[error(
        "the sign of Wq is probably reversed: the resonances of the recordings disagree by {direct_hz:.2} Hz, and with \
         a reversed Wq by {mirrored_hz:.2} Hz (root mean square). Check the sign of wq and the demodulator; \
         --columns wq=COLUMN:-UNIT reverses it"
    )]
    Mirrored { direct_hz: f64, mirrored_hz: f64 },
    #[error(
        "the resonance rises by {slope_hz_per_k:.2} Hz per kelvin, expected a fall (−9.6 Hz/K in the paper): a plate \
         becomes softer if it warms. The sign of Wq is probably reversed (--columns wq=COLUMN:-UNIT reverses it), or \
         the sign of the temperature"
    )]
    RisingResonance { slope_hz_per_k: f64 },
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
pub(crate) fn inconsistent_recordings(fitted: &[(Recording, DirectFit)]) -> Vec<Inconsistency> {
    let mut inconsistencies: Vec<Inconsistency> =
        fitted.iter().flat_map(|(recording, _)| find_clipping(recording)).collect();
    inconsistencies.extend(fitted.iter().filter_map(|(recording, fit)| misoriented(recording, fit)));
    inconsistencies.extend(large_transients(fitted));
    let coloured: Vec<_> = fitted.iter().filter(|(recording, fit)| is_coloured(recording, fit)).collect();
    let tested = fitted.iter().filter(|(_, fit)| fit.whiteness.is_some()).count();
    if !coloured.is_empty() && !is_explained_by_chance(coloured.len(), tested) {
        inconsistencies.push(Inconsistency::Residuals { rejected: coloured.len(), tested });
    }
    for (recording, fit) in fitted {
        if let Some(distance_hz) = Some(detuning_hz(recording, fit)).filter(|distance| *distance > MAX_DETUNING_HZ) {
            inconsistencies.push(Inconsistency::Detuned { recording: recording.name.clone(), distance_hz });
        }
        let noise = NOISE.check(noise_percent(recording, fit));
        inconsistencies.extend(noise.map(|found| Inconsistency::implausible(&found, Some(recording))));
    }
    inconsistencies
}

fn large_transients(fitted: &[(Recording, DirectFit)]) -> Option<Inconsistency> {
    let powers = fitted.iter().filter_map(|(recording, fit)| TransientPower::of(recording, fit));
    let powers: Vec<TransientPower> = powers.collect();
    let tested = powers.len();
    let rejected: Vec<TransientPower> = powers.iter().filter(|power| power.is_rejected(tested)).copied().collect();
    let whole = TransientPower::sum(&powers);
    if !rejected.is_empty() {
        let ratio = TransientPower::sum(&rejected).ratio();
        return Some(Inconsistency::Transients { count: rejected.len(), tested, ratio });
    }
    (tested > 1 && whole.is_rejected(1)).then(|| Inconsistency::Transients {
        count: tested,
        tested,
        ratio: whole.ratio(),
    })
}

/// A rotation that is too large to be corrected, or a reversed component.
fn misoriented(recording: &Recording, fit: &DirectFit) -> Option<Inconsistency> {
    let is_mirrored = fit.alignment.is_mirrored;
    let angle = fit.alignment.rotation_deg.filter(|angle| is_mirrored || angle.value.abs() > MAX_ROTATION_DEG)?.value;
    let is_near = |degrees: f64| (angle.abs() - degrees).abs() <= 90.0 - MAX_ROTATION_DEG;
    let knows_sign =
        recording.inputs.iter().any(|input| recording.inputs.first().is_some_and(|first| first.omega != input.omega));
    let name = recording.name.clone();
    let (excitation, resonance) = (recording.inputs.first()?.omega / TAU, fit.resonances.first()?.1.value / TAU);
    let other = 2.0 * excitation - resonance;
    if is_near(90.0) {
        let text = match (knows_sign, is_mirrored) {
            (true, true) => "the model fits with Wd and Wq exchanged; check the columns of wd and wq".to_owned(),
            (true, false) => format!(
                "the demodulator rotates W by {angle:.1}°; check its reference phase. Do not exchange the columns of wd \
                 and wq, because this reverses the sign of the detuning"
            ),
            (false, _) => format!(
                "the model fits with Wd and Wq exchanged (resonance {other:.1} Hz), and as well with a demodulator that \
                 rotates W by {angle:.1}° (resonance {resonance:.1} Hz); one frequency does not show which. Check the \
                 columns of wd and wq and the reference phase, and record a step of the frequency"
            ),
        };
        return Some(Inconsistency::Swapped { recording: name, rotation_deg: angle, text });
    }
    let is_reversed = is_near(180.0);
    let text = match (knows_sign, is_mirrored, is_reversed) {
        (true, true, false) => {
            "the model fits with a reversed sign of Wq; --columns wq=COLUMN:-UNIT reverses it".to_owned()
        }
        (true, true, true) => {
            "the model fits with a reversed sign of Wd; --columns wd=COLUMN:-UNIT reverses it".to_owned()
        }
        (true, false, true) => format!(
            "W is rotated by {angle:.1}°: the signs of Wd and Wq are reversed; --columns wd=COLUMN:-UNIT and \
             wq=COLUMN:-UNIT reverse them"
        ),
        (false, _, true) => format!(
            "the model fits with a reversed sign of Wd (resonance {other:.1} Hz), and as well with reversed signs of Wd \
             and Wq (resonance {resonance:.1} Hz); one frequency does not show which. Check the signs of wd and wq, \
             and record a step of the frequency; --columns wd=COLUMN:-UNIT reverses a sign"
        ),
        _ => format!("the demodulator rotates W by {angle:.1}°; check its reference phase"),
    };
    Some(Inconsistency::Rotated { recording: name, rotation_deg: angle, is_mirrored, text })
}

/// Compares the resonances of recordings with one excitation frequency each, as recorded and with a
/// reversed Wq. `None` if the recordings do not show the sign.
pub(crate) fn mirrored_recordings(fitted: &[(Recording, DirectFit)]) -> Option<Inconsistency> {
    let mut points: Vec<[f64; 4]> = Vec::new();
    for (recording, fit) in fitted {
        let omega = recording.inputs.first()?.omega;
        if recording.inputs.iter().all(|input| input.omega == omega) {
            let free = fit.resonances.iter().filter(|(conditions, _)| conditions.finger_force_n == 0.0);
            points.extend(free.map(|(conditions, at)| {
                [conditions.temperature_offset_k, at.value - omega, omega, at.error.max(f64::MIN_POSITIVE)]
            }));
        }
    }
    let middle = points.first()?[2];
    let line = |sign: f64| {
        weighted_line(points.iter().map(|[kelvin, y, omega, error]| [*kelvin, omega - middle + sign * y, *error]))
    };
    let (direct, mirrored) = (line(1.0)?, line(-1.0)?);
    let agreement = if direct.freedom < MANY_POINTS { MIRRORED_AGREEMENT_OF_FEW } else { MIRRORED_AGREEMENT };
    let is_mirrored = direct.score > DISAGREEMENT && direct.score > agreement * mirrored.score.max(1.0);
    is_mirrored
        .then_some(Inconsistency::Mirrored { direct_hz: direct.deviation / TAU, mirrored_hz: mirrored.deviation / TAU })
}

/// Residuals of a line.
struct LineResiduals {
    /// Root mean square in standard errors.
    score: f64,
    /// Root mean square.
    deviation: f64,
    freedom: f64,
}

/// Fits a line to points `[x, y, standard error]`; a constant if all abscissas are equal.
fn weighted_line(points: impl Iterator<Item = [f64; 3]> + Clone) -> Option<LineResiduals> {
    let sum = |of: fn([f64; 3]) -> f64| points.clone().map(|point| of(point) / point[2].powi(2)).sum::<f64>();
    let weight = sum(|_| 1.0);
    let (x, y) = (sum(|point| point[0]) / weight, sum(|point| point[1]) / weight);
    let square: f64 = points.clone().map(|point| ((point[0] - x) / point[2]).powi(2)).sum();
    let product: f64 = points.clone().map(|point| (point[0] - x) * (point[1] - y) / point[2].powi(2)).sum();
    let count = points.clone().count() as f64;
    let (slope, freedom) = if square > 0.0 { (product / square, count - 2.0) } else { (0.0, count - 1.0) };
    let residual = |point: [f64; 3]| point[1] - y - slope * (point[0] - x);
    let squares: f64 = points.clone().map(|point| (residual(point) / point[2]).powi(2)).sum();
    let plain: f64 = points.map(|point| residual(point).powi(2)).sum();
    (freedom > 0.0).then(|| LineResiduals {
        score: (squares / freedom).sqrt(),
        deviation: (plain / count).sqrt(),
        freedom,
    })
}

pub(crate) fn implausible_parameters(
    resonance_hz: Option<Estimate>,
    time_constant_s: Option<Estimate>,
    gain_um_per_vpp: Option<Estimate>,
    second_mode: Option<IdentifiedSecondMode>,
    gain_change_percent: Option<Estimate>,
    slope_hz_per_k: Option<Estimate>,
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
    if let Some(slope) = slope_hz_per_k.filter(|slope| slope.low > 0.0) {
        inconsistencies.push(Inconsistency::RisingResonance { slope_hz_per_k: slope.value });
    }
    inconsistencies
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
