//! Identifies the parameters of one plate from all recordings together (section IV of the paper).

pub mod estimate;
pub mod fit;
pub(crate) mod inconsistency;
pub mod steps;

use estimate::{FREEDOM_OF_KNOWN_ERRORS, pool_heating, pool_second_modes};
use fit::fit_effect;
use inconsistency::{
    has_exchanged_components, implausible_parameters, inconsistent_recordings, is_coloured, is_explained_by_chance,
};
use nalgebra::{DMatrix, DVector};
use platebench_model::recording::{Recording, RecordingError};
use platebench_plate::Conditions;
use schemars::JsonSchema;
use serde::Serialize;
use std::f64::consts::TAU;
use steps::{frequency_steps, frequency_time_constant, voltage_steps};

pub use estimate::{
    ArxMethod, ArxModel, EffectFit, Estimate, IdentifiedHeating, IdentifiedSecondMode, WhitenessTest, arx,
};
pub use fit::{DirectFit, fit_direct};
pub use inconsistency::Inconsistency;
pub use steps::{FrequencyStep, VoltageStep};

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct RecordingFit {
    pub recording: String,
    pub samples: usize,
    /// Gain at the lowest force; `time_constant_s` is that at the same force.
    pub gain_um_per_vpp: Estimate,
    pub time_constant_s: Estimate,
    /// Resonance at the first temperature and force of the recording.
    pub resonance_hz: Estimate,
    /// First excitation frequency minus `resonance_hz`.
    pub detuning_hz: Estimate,
    pub noise_um: f64,
    pub whiteness: Option<WhitenessTest>,
}

/// The identified plate. Parameters that the recordings do not determine are `None` or empty.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct Identification {
    pub voltage_steps: Vec<VoltageStep>,
    pub frequency_steps: Vec<FrequencyStep>,
    pub recordings: Vec<RecordingFit>,
    pub undetermined: Vec<String>,
    /// Gain and time constant are from direct fits without a finger.
    pub gain_um_per_vpp: Option<Estimate>,
    pub time_constant_s: Option<Estimate>,
    /// K2 of the paper's Table II, by ARX with instrumental variables.
    pub frequency_gain_s: Option<Estimate>,
    /// τ2 of the paper's Table II, by direct fits of the frequency steps.
    pub frequency_time_constant_s: Option<Estimate>,
    /// Resonance at the reference temperature.
    pub resonance_hz: Option<Estimate>,
    pub slope_hz_per_k: Option<Estimate>,
    /// Pairs of force in N and σ/σ0.
    pub damping_ratio: Vec<(f64, Estimate)>,
    pub shift_hz_per_n: Option<Estimate>,
    /// Change of K1 from the lowest to the highest drive.
    pub gain_change_percent: Option<Estimate>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub second_mode: Option<IdentifiedSecondMode>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heating: Option<IdentifiedHeating>,
    pub noise_um: f64,
    pub highest_vpp: f64,
    #[serde(rename = "doubts")]
    pub inconsistencies: Vec<Inconsistency>,
}

/// Returns the identification and the fits in the order of [`Identification::recordings`].
/// Temperature steps count as frequency steps only if the slope of the resonance is given or
/// follows from recordings. Fails if no recording determines the parameters.
pub fn identify(
    recordings: &[Recording],
    slope_hz_per_k: Option<f64>,
) -> Result<(Identification, Vec<DirectFit>), RecordingError> {
    let fitted: Vec<_> = recordings.iter().map(|recording| (recording, fit_direct(recording))).collect();
    let exchanged: Vec<&Recording> = fitted
        .iter()
        .filter(|(recording, fit)| has_exchanged_components(recording, fit.as_ref().ok()))
        .map(|(recording, _)| *recording)
        .collect();
    let undetermined = fitted.iter().filter(|(_, fit)| fit.is_err()).map(|(recording, _)| recording.name.clone());
    let undetermined: Vec<String> = undetermined.collect();
    let fitted: Vec<(&Recording, DirectFit)> =
        fitted.into_iter().filter_map(|(recording, fit)| Some((recording, fit.ok()?))).collect();
    if fitted.is_empty() {
        return Err(RecordingError::Undetermined);
    }
    let fitted = with_effects(fitted, &exchanged);
    let effects: Vec<EffectFit> = fitted.iter().filter_map(|(_, fit)| fit.effect).collect();
    let pooled = |values: Vec<Estimate>| Estimate::pool(&values);
    let lines: Vec<_> = fitted.iter().map(|(_, fit)| temperature_line(fit)).collect();
    let slope = pooled(lines.iter().filter_map(|line| line.as_ref()?.1).collect());
    let known_slope = slope_hz_per_k.map(|hz| hz * TAU).or(slope.map(|slope| slope.value));
    let reference = |(line, (_, fit)): (&Option<TemperatureLine>, &(&Recording, DirectFit))| {
        let (at_reference, own_slope) = (*line)?;
        let warmer = fit.resonances.first()?.0.temperature_offset_k;
        match (own_slope, known_slope) {
            (Some(_), _) => Some(at_reference),
            (None, slope) if warmer == 0.0 || slope.is_some() => {
                Some(at_reference.shifted(-slope.unwrap_or(0.0) * warmer))
            }
            _ => None,
        }
    };
    let resonance = pooled(lines.iter().zip(&fitted).filter_map(reference).collect());
    let voltage: Vec<Vec<VoltageStep>> = fitted.iter().map(|(recording, fit)| voltage_steps(recording, fit)).collect();
    let untouched = |fit: &DirectFit| fit.time_constants.first().is_some_and(|first| first.0 == 0.0);
    let free = || fitted.iter().zip(&voltage).filter(|((_, fit), _)| untouched(fit));
    let mut open: Vec<&DirectFit> = free().filter(|(_, steps)| !steps.is_empty()).map(|((_, fit), _)| fit).collect();
    if open.is_empty() {
        open = free().map(|((_, fit), _)| fit).collect();
    }
    let frequency: Vec<Vec<FrequencyStep>> =
        fitted.iter().map(|(recording, fit)| frequency_steps(recording, fit, known_slope)).collect();
    let frequency_gain = |step: &FrequencyStep| Some((step.recording.clone(), step.instruments?[0]));
    let frequency_gains: Vec<_> = frequency.iter().flatten().filter_map(frequency_gain).collect();
    let frequency_taus = fitted.iter().zip(&frequency);
    let frequency_taus = frequency_taus.filter_map(|((recording, _), steps)| frequency_time_constant(recording, steps));
    let squares: f64 = fitted.iter().map(|(_, fit)| fit.noise_um.powi(2)).sum();
    let highest = fitted.iter().flat_map(|(recording, _)| &recording.inputs).map(|input| input.vpp);
    let mut identification = Identification {
        recordings: fitted.iter().filter_map(|(recording, fit)| summarise_fit(recording, fit)).collect(),
        undetermined,
        gain_um_per_vpp: pooled(open.iter().map(|fit| fit.gain).collect()),
        time_constant_s: pooled(open.iter().filter_map(|fit| fit.time_constant()).collect()),
        frequency_gain_s: Estimate::pool_by_recording(&frequency_gains),
        frequency_time_constant_s: pooled(frequency_taus.collect()),
        resonance_hz: resonance.map(|omega| omega.scaled(1.0 / TAU)),
        slope_hz_per_k: slope.map(|omega| omega.scaled(1.0 / TAU)),
        damping_ratio: damping_ratios(&fitted),
        shift_hz_per_n: pooled(fitted.iter().filter_map(|(_, fit)| force_slope(fit)).collect())
            .map(|omega| omega.scaled(1.0 / TAU)),
        gain_change_percent: pooled(voltage.iter().filter_map(|steps| gain_change_percent(steps)).collect()),
        second_mode: pool_second_modes(&effects),
        heating: pool_heating(&effects),
        noise_um: (squares / fitted.len() as f64).sqrt(),
        highest_vpp: highest.fold(0.0, f64::max),
        voltage_steps: voltage.into_iter().flatten().collect(),
        frequency_steps: frequency.into_iter().flatten().collect(),
        inconsistencies: Vec::new(),
    };
    let swapped = exchanged.iter().map(|recording| Inconsistency::Swapped { recording: recording.name.clone() });
    let implausible = implausible_parameters(
        identification.resonance_hz,
        identification.time_constant_s,
        identification.gain_um_per_vpp,
        identification.second_mode,
        identification.gain_change_percent,
    );
    identification.inconsistencies = [swapped.collect(), inconsistent_recordings(&fitted), implausible].concat();
    Ok((identification, fitted.into_iter().map(|(_, fit)| fit).collect()))
}

/// Replaces a fit with coloured residuals by a fit with a second mode or self-heating, if this
/// makes the residuals white. Changes nothing if chance explains the number of coloured residuals,
/// and no recording with exchanged components, whose second mode would be invented.
fn with_effects<'a>(
    mut fitted: Vec<(&'a Recording, DirectFit)>,
    exchanged: &[&Recording],
) -> Vec<(&'a Recording, DirectFit)> {
    let coloured = fitted.iter().filter(|(recording, fit)| is_coloured(recording, fit)).count();
    let tested = fitted.iter().filter(|(_, fit)| fit.whiteness.is_some()).count();
    if coloured == 0 || is_explained_by_chance(coloured, tested) {
        return fitted;
    }
    let is_exchanged = |recording: &Recording| exchanged.iter().any(|other| std::ptr::eq(*other, recording));
    for (recording, fit) in fitted.iter_mut().filter(|(recording, fit)| is_coloured(recording, fit)) {
        if is_exchanged(recording) {
            continue;
        }
        if let Some(better) = fit_effect(recording, fit, |other| !is_coloured(recording, other)) {
            *fit = better;
        }
    }
    fitted
}

fn summarise_fit(recording: &Recording, fit: &DirectFit) -> Option<RecordingFit> {
    let resonance_hz = fit.resonances.first()?.1.scaled(1.0 / TAU);
    let excitation_hz = recording.inputs.first()?.omega / TAU;
    Some(RecordingFit {
        recording: recording.name.clone(),
        samples: recording.outputs.len(),
        gain_um_per_vpp: fit.gain,
        time_constant_s: fit.time_constant()?,
        resonance_hz,
        detuning_hz: resonance_hz.scaled(-1.0).shifted(excitation_hz),
        noise_um: fit.noise_um,
        whiteness: fit.whiteness,
    })
}

/// Resonance at the reference temperature, rad/s, and its slope, rad/s per K.
type TemperatureLine = (Estimate, Option<Estimate>);

fn temperature_line(fit: &DirectFit) -> Option<TemperatureLine> {
    let force = fit.time_constants.first()?.0;
    let untouched = |conditions: &Conditions| conditions.finger_force_n == force;
    let only = || fit.resonances.iter().find(|(conditions, _)| untouched(conditions)).map(|(_, omega)| (*omega, None));
    let line = fit_resonance_line(fit, |conditions| untouched(conditions).then_some(conditions.temperature_offset_k));
    line.map(|(start, slope)| (start, Some(slope))).or_else(only)
}

/// Change of the resonance in rad/s per newton, at the temperature of the first conditions.
fn force_slope(fit: &DirectFit) -> Option<Estimate> {
    let warm = fit.resonances.first()?.0.temperature_offset_k;
    let line = fit_resonance_line(fit, |conditions| {
        (conditions.temperature_offset_k == warm).then_some(conditions.finger_force_n)
    });
    line.map(|(_, slope)| slope)
}

/// Pairs of force in N and σ/σ0, by rising force, from recordings with the untouched plate.
fn damping_ratios(fitted: &[(&Recording, DirectFit)]) -> Vec<(f64, Estimate)> {
    let untouched = fitted
        .iter()
        .filter(|(_, fit)| fit.damping.len() > 1 && fit.damping.first().is_some_and(|first| first.0 == 0.0));
    let mut all: Vec<(f64, Estimate)> = untouched.flat_map(|(_, fit)| fit.damping.iter().skip(1).copied()).collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    let groups = all.chunk_by(|a, b| a.0 == b.0);
    let pool = |group: &[(f64, Estimate)]| {
        let estimates: Vec<Estimate> = group.iter().map(|(_, estimate)| *estimate).collect();
        Some((group.first()?.0, Estimate::pool(&estimates)?))
    };
    groups.filter_map(pool).collect()
}

/// Change in percent of the mean gain. `None` for fewer than three steps.
fn gain_change_percent(steps: &[VoltageStep]) -> Option<Estimate> {
    let points: Vec<_> = steps.iter().filter_map(|step| Some((step.vpp, step.direct?[0]))).collect();
    let drives = points.iter().map(|point| point.0);
    let (low, high) = drives.fold((f64::MAX, 0.0_f64), |(low, high), vpp| (low.min(vpp), high.max(vpp)));
    let variances = points.iter().map(|point| point.1.error.powi(2).max(f64::MIN_POSITIVE));
    let covariance = DMatrix::from_diagonal(&DVector::from_iterator(points.len(), variances));
    let values: Vec<(f64, f64)> = points.iter().map(|point| (point.0, point.1.value)).collect();
    let (start, slope) = fit_line(&values, &covariance).filter(|_| points.len() > 2)?;
    let middle = start.value + slope.value * f64::midpoint(low, high);
    Some(slope.scaled((high - low) / middle * 100.0))
}

fn fit_resonance_line(fit: &DirectFit, abscissa: impl Fn(&Conditions) -> Option<f64>) -> Option<(Estimate, Estimate)> {
    let picked = fit.resonances.iter().enumerate();
    let picked: Vec<(usize, f64, f64)> =
        picked.filter_map(|(number, (conditions, omega))| Some((number, abscissa(conditions)?, omega.value))).collect();
    let points: Vec<(f64, f64)> = picked.iter().map(|(_, x, y)| (*x, *y)).collect();
    let numbers: Vec<usize> = picked.iter().map(|(number, _, _)| *number).collect();
    fit_line(&points, &fit.resonance_covariance.select_rows(&numbers).select_columns(&numbers))
}

/// Fits a line by generalised least squares and returns its value at 0 and its slope. If the points
/// scatter more than their covariance, the errors grow. `None` if all abscissas are equal.
fn fit_line(points: &[(f64, f64)], covariance: &DMatrix<f64>) -> Option<(Estimate, Estimate)> {
    let first = points.first()?;
    if points.iter().all(|point| point.0 == first.0) {
        return None;
    }
    let places = DMatrix::from_fn(points.len(), 2, |row, column| if column == 0 { 1.0 } else { points[row].0 });
    // Differences to the first value, because they keep more digits.
    let values = DVector::from_iterator(points.len(), points.iter().map(|point| point.1 - first.1));
    let factor = covariance.clone().cholesky()?;
    let known = (places.transpose() * factor.solve(&places)).try_inverse()?;
    let theta = &known * places.transpose() * factor.solve(&values);
    let misfit = &values - &places * &theta;
    let squares = misfit.dot(&factor.solve(&misfit));
    let free = points.len().saturating_sub(2) as f64;
    let (wider, freedom) =
        if squares > free && free > 0.0 { ((squares / free).sqrt(), free) } else { (1.0, FREEDOM_OF_KNOWN_ERRORS) };
    let error = |index: usize| wider * known[(index, index)].max(0.0).sqrt();
    Some((Estimate::new(first.1 + theta[0], error(0), freedom), Estimate::new(theta[1], error(1), freedom)))
}
