//! Identifies the parameters of one plate from all recordings together (section IV of the paper).

mod alignment;
mod effects;
pub mod estimate;
pub mod fit;
pub(crate) mod inconsistency;
pub(crate) mod residuals;
pub mod steps;
mod warning;

use alignment::{Examined, align_in_common, common_shift, correct, pool_with_scatter};
use effects::fit_effect;
use estimate::{FREEDOM_OF_KNOWN_ERRORS, pool_heating, pool_second_modes};
use inconsistency::{implausible_parameters, inconsistent_recordings, mirrored_recordings};
use nalgebra::{DMatrix, DVector};
use platebench_model::recording::{Recording, RecordingError};
use platebench_plate::Conditions;
use residuals::{information, is_coloured, is_explained_by_chance};
use schemars::JsonSchema;
use serde::Serialize;
use std::f64::consts::TAU;
use steps::{frequency_steps, frequency_time_constant, voltage_steps};
use warning::warnings;

pub use estimate::{
    ArxMethod, ArxModel, EffectFit, Estimate, IdentifiedHeating, IdentifiedSecondMode, WhitenessTest, arx,
};
pub use fit::{DirectFit, ShiftedInputs, fit_direct};
pub use inconsistency::Inconsistency;
pub use steps::{FrequencyStep, VoltageStep};
pub use warning::Warning;

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
    /// Time by which the inputs act later than recorded, in periods.
    pub input_shift_periods: Option<Estimate>,
    /// Angle by which the demodulator rotates W, degrees.
    pub demodulator_rotation_deg: Option<Estimate>,
    pub noise_um: f64,
    pub highest_vpp: f64,
    /// Faults of the recordings that the results take into account.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<Warning>,
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
    let mut examined: Vec<Examined> = recordings.iter().map(Examined::new).collect();
    align_in_common(&mut examined);
    let undetermined = examined.iter().filter(|each| each.best().is_none()).map(|each| each.recording.name.clone());
    let undetermined: Vec<String> = undetermined.collect();
    let warnings = warnings(&examined);
    let alignments = |of: fn(&fit::FittedAlignment) -> Option<Estimate>| {
        let fits = examined.iter().filter_map(|each| each.aligned.as_ref().or(each.free.as_ref()));
        pool_with_scatter(&fits.filter_map(|fit| of(&fit.alignment)).collect::<Vec<_>>())
    };
    let input_shift_periods = alignments(common_shift);
    let demodulator_rotation_deg = alignments(|alignment| alignment.rotation_deg.filter(|_| !alignment.is_mirrored));
    let fitted = with_effects(examined);
    if fitted.is_empty() {
        return Err(RecordingError::Undetermined);
    }
    let effects: Vec<EffectFit> = fitted.iter().filter_map(|(_, fit)| fit.effect).collect();
    let pooled = |values: Vec<Estimate>| Estimate::pool(&values);
    let lines: Vec<_> = fitted.iter().map(|(_, fit)| temperature_line(fit)).collect();
    let slope = pooled(lines.iter().filter_map(|line| line.as_ref()?.1).collect());
    let known_slope = slope_hz_per_k.map(|hz| hz * TAU).or(slope.map(|slope| slope.value));
    let reference = |(line, (_, fit)): (&Option<TemperatureLine>, &(Recording, DirectFit))| {
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
    let corrected: Vec<Recording> = fitted.iter().map(|(recording, fit)| correct(recording, &fit.alignment)).collect();
    let aligned = || corrected.iter().zip(fitted.iter().map(|(_, fit)| fit));
    let voltage: Vec<Vec<VoltageStep>> = aligned().map(|(recording, fit)| voltage_steps(recording, fit)).collect();
    let untouched = |fit: &DirectFit| fit.time_constants.first().is_some_and(|first| first.0 == 0.0);
    let free = || fitted.iter().zip(&voltage).filter(|((_, fit), _)| untouched(fit));
    let mut open: Vec<&DirectFit> = free().filter(|(_, steps)| !steps.is_empty()).map(|((_, fit), _)| fit).collect();
    if open.is_empty() {
        open = free().map(|((_, fit), _)| fit).collect();
    }
    let frequency: Vec<Vec<FrequencyStep>> =
        aligned().map(|(recording, fit)| frequency_steps(recording, fit, known_slope)).collect();
    let frequency_gain = |step: &FrequencyStep| Some((step.recording.clone(), step.instruments?[0]));
    let frequency_gains: Vec<_> = frequency.iter().flatten().filter_map(frequency_gain).collect();
    let frequency_taus = corrected.iter().zip(&frequency);
    let frequency_taus = frequency_taus.filter_map(|(recording, steps)| frequency_time_constant(recording, steps));
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
        input_shift_periods,
        demodulator_rotation_deg,
        noise_um: (squares / fitted.len() as f64).sqrt(),
        highest_vpp: highest.fold(0.0, f64::max),
        voltage_steps: voltage.into_iter().flatten().collect(),
        frequency_steps: frequency.into_iter().flatten().collect(),
        warnings,
        inconsistencies: Vec::new(),
    };
    let implausible = implausible_parameters(
        identification.resonance_hz,
        identification.time_constant_s,
        identification.gain_um_per_vpp,
        identification.second_mode,
        identification.gain_change_percent,
        identification.slope_hz_per_k,
    );
    let mirrored = mirrored_recordings(&fitted).into_iter().collect();
    identification.inconsistencies = [inconsistent_recordings(&fitted), mirrored, implausible].concat();
    Ok((identification, fitted.into_iter().map(|(_, fit)| fit).collect()))
}

/// Chooses the fit of each recording. Replaces a fit with coloured residuals by a fit with a second
/// mode or self-heating, if this makes the residuals white and no alignment explains them better.
/// Adds no effect if chance explains the number of coloured residuals.
fn with_effects(examined: Vec<Examined>) -> Vec<(Recording, DirectFit)> {
    let is_coloured_directly =
        |each: &Examined| each.direct.as_ref().is_some_and(|fit| is_coloured(&each.recording, fit));
    let coloured = examined.iter().filter(|each| is_coloured_directly(each)).count();
    let tested = examined.iter().filter(|each| each.direct.as_ref().is_some_and(|fit| fit.whiteness.is_some())).count();
    let choose = |each: Examined| {
        let best = each.best()?.clone();
        let may_have_effect = is_coloured_directly(&each) && !is_explained_by_chance(coloured, tested);
        let effect = each
            .direct
            .as_ref()
            .filter(|_| may_have_effect && !is_misoriented(&best))
            .and_then(|direct| fit_effect(&each.recording, direct, |other| !is_coloured(&each.recording, other)));
        let effect = effect.filter(|effect| {
            each.aligned.is_none() || information(&each.recording, effect) < information(&each.recording, &best)
        });
        Some((each.recording, effect.unwrap_or(best)))
    };
    examined.into_iter().filter_map(choose).collect()
}

/// True if the columns or signs of W are wrong. A second mode would be invented.
fn is_misoriented(fit: &DirectFit) -> bool {
    let angle = fit.alignment.rotation_deg.map_or(0.0, |angle| angle.value);
    fit.alignment.is_mirrored || angle.abs() > alignment::MAX_ROTATION_DEG
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
fn damping_ratios(fitted: &[(Recording, DirectFit)]) -> Vec<(f64, Estimate)> {
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

/// Change in percent of the mean gain from the lowest to the highest drive. Gains are compared
/// under one force only. `None` for fewer than three steps, or one step under each force.
fn gain_change_percent(steps: &[VoltageStep]) -> Option<Estimate> {
    let mut points: Vec<(f64, f64, Estimate)> =
        steps.iter().filter_map(|step| Some((step.force_n, step.vpp, step.direct?[0]))).collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    // Gains relative to the mean under their force, so one line describes all forces.
    let mut values: Vec<(usize, f64, Estimate)> = Vec::new();
    for (number, group) in points.chunk_by(|a, b| a.0 == b.0).enumerate() {
        let mean = group.iter().map(|(_, _, gain)| gain.value).sum::<f64>() / group.len() as f64;
        values.extend(group.iter().map(|(_, vpp, gain)| (number, *vpp, gain.scaled(1.0 / mean))));
    }
    let groups = values.last()?.0 + 1;
    if values.array_windows().all(|[a, b]| a.0 != b.0 || a.1 == b.1) {
        return None;
    }
    let (low, high) =
        values.iter().fold((f64::MAX, 0.0_f64), |(low, high), value| (low.min(value.1), high.max(value.1)));
    let middle = f64::midpoint(low, high);
    let variances = values.iter().map(|value| value.2.error.powi(2).max(f64::MIN_POSITIVE));
    let covariance = DMatrix::from_diagonal(&DVector::from_iterator(values.len(), variances));
    let places = DMatrix::from_fn(values.len(), groups + 1, |row, column| match column.checked_sub(1) {
        None => values[row].1 - middle,
        Some(group) => f64::from(u8::from(values[row].0 == group)),
    });
    let gains = DVector::from_iterator(values.len(), values.iter().map(|value| value.2.value));
    let line = generalised_least_squares(&places, &gains, &covariance).filter(|_| values.len() > 2)?;
    let mean = (1..=groups).map(|group| line[group].value).sum::<f64>() / groups as f64;
    Some(line[0].scaled((high - low) / mean * 100.0))
}

fn fit_resonance_line(fit: &DirectFit, abscissa: impl Fn(&Conditions) -> Option<f64>) -> Option<(Estimate, Estimate)> {
    let picked = fit.resonances.iter().enumerate();
    let picked: Vec<(usize, f64, f64)> =
        picked.filter_map(|(number, (conditions, omega))| Some((number, abscissa(conditions)?, omega.value))).collect();
    let points: Vec<(f64, f64)> = picked.iter().map(|(_, x, y)| (*x, *y)).collect();
    let numbers: Vec<usize> = picked.iter().map(|(number, _, _)| *number).collect();
    fit_line(&points, &fit.resonance_covariance.select_rows(&numbers).select_columns(&numbers))
}

/// Fits a line by generalised least squares and returns its value at 0 and its slope. `None` if all
/// abscissas are equal.
fn fit_line(points: &[(f64, f64)], covariance: &DMatrix<f64>) -> Option<(Estimate, Estimate)> {
    let first = points.first()?;
    if points.iter().all(|point| point.0 == first.0) {
        return None;
    }
    let places = DMatrix::from_fn(points.len(), 2, |row, column| if column == 0 { 1.0 } else { points[row].0 });
    // Differences to the first value, because they keep more digits.
    let values = DVector::from_iterator(points.len(), points.iter().map(|point| point.1 - first.1));
    let line = generalised_least_squares(&places, &values, covariance)?;
    Some((line.first()?.shifted(first.1), *line.get(1)?))
}

/// Estimates the factors of the columns of `places`. If the values scatter more than their
/// covariance, the errors grow. `None` if the columns are linearly dependent.
fn generalised_least_squares(
    places: &DMatrix<f64>,
    values: &DVector<f64>,
    covariance: &DMatrix<f64>,
) -> Option<Vec<Estimate>> {
    let factor = covariance.clone().cholesky()?;
    let known = (places.transpose() * factor.solve(places)).cholesky()?.inverse();
    let theta = &known * places.transpose() * factor.solve(values);
    let misfit = values - places * &theta;
    let squares = misfit.dot(&factor.solve(&misfit));
    let free = values.len().saturating_sub(places.ncols()) as f64;
    let (wider, freedom) =
        if squares > free && free > 0.0 { ((squares / free).sqrt(), free) } else { (1.0, FREEDOM_OF_KNOWN_ERRORS) };
    let estimate = |index: usize| Estimate::new(theta[index], wider * known[(index, index)].max(0.0).sqrt(), freedom);
    Some((0..theta.len()).map(estimate).collect())
}
