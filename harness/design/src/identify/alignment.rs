//! Finds out whether a recording has shifted inputs, a rotated or mirrored demodulator, or jittered
//! time stamps, and fits it with this alignment.
//!
//! A fit with an alignment is used only if it explains the recording much better, so a recording
//! without such faults has the results of the direct fit.

use crate::identify::estimate::Estimate;
use crate::identify::fit::{Alignment, DirectFit, FittedAlignment, ShiftedInputs, fit_aligned};
use crate::identify::residuals::{
    has_large_transients, information, is_coloured, is_explained_by_chance, is_implausible,
};
use crate::identify::steps::SAME_INSTANT;
use platebench_model::recording::{Gap, RecordedInput, RecordedSample, Recording};
use platebench_plate::Complex64;
use std::f64::consts::PI;

/// Smallest fall of the information criterion for which an alignment is used. For one parameter and
/// 100 samples noise alone has a probability of 1e-4.
const CLEAR_FALL: f64 = 10.0;
/// Smallest common shift or rotation that is used, in standard errors.
const CLEAR_ERRORS: f64 = 4.5;
/// A single recording is examined further from this number of standard errors on.
const NOTABLE_ERRORS: f64 = 3.0;
/// Smaller values have no effect, in periods and degrees.
const SMALLEST_SHIFT: f64 = 1e-3;
const SMALLEST_ROTATION_DEG: f64 = 0.02;
/// A fit with a value that is less certain does not determine it, in periods and degrees.
const MAX_SHIFT_ERROR: f64 = 0.3;
const MAX_ROTATION_ERROR_DEG: f64 = 20.0;
/// Largest rotation that is corrected. A larger one is a fault of the columns or signs.
pub(crate) const MAX_ROTATION_DEG: f64 = 45.0;
const SHIFT_STARTS: [f64; 5] = [-2.0, -1.0, 0.0, 1.0, 2.0];
const ROTATION_STARTS_DEG: [f64; 4] = [0.0, 90.0, 180.0, -90.0];
/// Smallest standard deviation of the time stamps that is examined, in periods.
const SMALLEST_JITTER: f64 = 2e-3;

/// A recording with its fits. All fits refer to `recording`, whose time stamps may be corrected.
pub(crate) struct Examined {
    pub recording: Recording,
    pub direct: Option<DirectFit>,
    /// Fit with a shift of the inputs and a rotation, as far as the recording determines them.
    pub free: Option<DirectFit>,
    /// Fit with an alignment that explains the recording much better than `direct`.
    pub aligned: Option<DirectFit>,
    /// Standard deviation of the time stamps from equal spacing in s, if equal spacing fits better.
    pub jitter_s: Option<f64>,
}

impl Examined {
    pub(crate) fn new(recording: &Recording) -> Self {
        let fit = |recording: &Recording| fit_aligned(recording, Alignment::default(), None).ok();
        let (mut recording, mut direct, mut jitter_s) = (recording.clone(), fit(recording), None);
        if let Some((regular, deviation)) = with_equal_spacing(&recording) {
            let other = fit(&regular);
            if is_clearly_better(&regular, other.as_ref(), direct.as_ref()) {
                (recording, direct, jitter_s) = (regular, other, Some(deviation));
            }
        }
        let free = direct.as_ref().and_then(|direct| fit_free(&recording, direct));
        let is_notable = |fit: &DirectFit| {
            let FittedAlignment { shift, rotation_deg, .. } = fit.alignment;
            shift
                .map(|shift| shift.1)
                .into_iter()
                .chain(rotation_deg)
                .any(|each| each.value.abs() > NOTABLE_ERRORS * each.error)
        };
        let is_poor = direct.as_ref().is_none_or(|fit| {
            is_coloured(&recording, fit) || has_large_transients(&recording, fit) || is_implausible(&recording, fit)
        });
        let aligned = (is_poor || free.as_ref().is_some_and(is_notable))
            .then(|| search(&recording, direct.as_ref()))
            .flatten()
            .filter(|fit| is_explained(&recording, fit) || is_half_as_noisy(fit, direct.as_ref()))
            .filter(|fit| is_clearly_better(&recording, Some(fit), direct.as_ref()));
        Self { recording, direct, free, aligned, jitter_s }
    }

    /// Fit of the recording, and its alignment.
    pub(crate) fn best(&self) -> Option<&DirectFit> {
        self.aligned.as_ref().or(self.direct.as_ref())
    }
}

/// Uses a shift or a rotation that the recordings have in common, although it may be small in each.
pub(crate) fn align_in_common(all: &mut [Examined]) {
    let estimates = |of: fn(&FittedAlignment) -> Option<Estimate>| -> Vec<Estimate> {
        all.iter().filter_map(|each| of(&each.aligned.as_ref().or(each.free.as_ref())?.alignment)).collect()
    };
    let is_clear = |estimates: &[Estimate], smallest: f64| {
        pool_with_scatter(estimates).is_some_and(|mean| mean.value.abs() > (CLEAR_ERRORS * mean.error).max(smallest))
    };
    let is_shifted = is_clear(&estimates(common_shift), SMALLEST_SHIFT);
    let is_rotated = is_clear(&estimates(|alignment| alignment.rotation_deg), SMALLEST_ROTATION_DEG);
    if !is_shifted && !is_rotated {
        return;
    }
    let fit = |each: &Examined| {
        let direct = each.direct.as_ref().filter(|_| each.aligned.is_none())?;
        let free = each.free.as_ref()?.alignment;
        let alignment = Alignment {
            shift: free.shift.filter(|_| is_shifted).map(|(inputs, periods)| (inputs, periods.value)),
            rotation: free.rotation_deg.filter(|_| is_rotated).map(|angle| angle.value * PI / 180.0),
        };
        (alignment != Alignment::default())
            .then(|| fit_aligned(&each.recording, alignment, Some(direct)).ok())
            .flatten()
    };
    let fits: Vec<Option<DirectFit>> = all.iter().map(fit).collect();
    let found = all.iter().zip(&fits).filter_map(|(each, fit)| Some((each, fit.as_ref()?)));
    let (count, coloured) = found.fold((0, 0), |(count, coloured), (each, fit)| {
        (count + 1, coloured + usize::from(!is_explained(&each.recording, fit)))
    });
    if is_explained_by_chance(coloured, count) {
        for (each, fit) in all.iter_mut().zip(fits) {
            each.aligned = each.aligned.take().or(fit);
        }
    }
}

pub(crate) fn common_shift(alignment: &FittedAlignment) -> Option<Estimate> {
    alignment.shift.filter(|(inputs, _)| *inputs == ShiftedInputs::All).map(|(_, periods)| periods)
}

/// Weighted mean. If the estimates scatter more than their errors, the error grows.
pub(crate) fn pool_with_scatter(estimates: &[Estimate]) -> Option<Estimate> {
    let mean = Estimate::combine_independent(estimates)?;
    let squares = estimates.iter().map(|each| ((each.value - mean.value) / each.error).powi(2)).sum::<f64>();
    let wider = (squares / (estimates.len() as f64 - 1.0).max(1.0)).sqrt().max(1.0);
    Some(if estimates.len() < 2 { mean } else { Estimate::new(mean.value, mean.error * wider, mean.freedom) })
}

fn is_explained(recording: &Recording, fit: &DirectFit) -> bool {
    !is_coloured(recording, fit) && !has_large_transients(recording, fit)
}

fn is_half_as_noisy(fit: &DirectFit, direct: Option<&DirectFit>) -> bool {
    direct.is_none_or(|direct| fit.noise_um < 0.5 * direct.noise_um)
}

fn is_clearly_better(recording: &Recording, fit: Option<&DirectFit>, than: Option<&DirectFit>) -> bool {
    match (fit, than) {
        (Some(fit), Some(than)) => information(recording, fit) + CLEAR_FALL < information(recording, than),
        (fit, _) => fit.is_some(),
    }
}

fn is_determined(fit: &DirectFit) -> bool {
    fit.alignment.shift.is_none_or(|(_, periods)| periods.error < MAX_SHIFT_ERROR)
        && fit.alignment.rotation_deg.is_none_or(|angle| angle.error < MAX_ROTATION_ERROR_DEG)
}

fn fit_free(recording: &Recording, direct: &DirectFit) -> Option<DirectFit> {
    let (shift, rotation) = (Some((ShiftedInputs::All, 0.0)), Some(0.0));
    let choices =
        [Alignment { shift, rotation }, Alignment { shift: None, rotation }, Alignment { shift, rotation: None }];
    choices.into_iter().filter_map(|alignment| fit_aligned(recording, alignment, Some(direct)).ok()).find(is_determined)
}

/// The fit with the smallest information criterion over shifts and rotations.
fn search(recording: &Recording, direct: Option<&DirectFit>) -> Option<DirectFit> {
    let changes = |value: fn(&RecordedInput) -> f64| {
        recording.inputs.array_windows().any(|[before, after]| value(before) != value(after))
    };
    let has_several_frequencies = changes(|input| input.omega);
    let mut found: Vec<DirectFit> = Vec::new();
    if let Some(direct) = direct {
        let kinds = [ShiftedInputs::All, ShiftedInputs::Drive, ShiftedInputs::Frequency];
        let kinds = if has_several_frequencies && changes(|input| input.vpp) { &kinds[..] } else { &kinds[..1] };
        for inputs in kinds {
            let starts = SHIFT_STARTS.map(|periods| Alignment { shift: Some((*inputs, periods)), rotation: None });
            found.extend(starts.iter().filter_map(|start| fit_aligned(recording, *start, Some(direct)).ok()));
        }
    }
    // Under one frequency a mirrored W has the samples of a plate with a mirrored resonance.
    for is_mirrored in if has_several_frequencies { &[false, true][..] } else { &[false] } {
        for degrees in ROTATION_STARTS_DEG {
            let start = Alignment { shift: None, rotation: Some(degrees * PI / 180.0) };
            found.extend(fit_view(recording, *is_mirrored, start, None));
        }
    }
    let best = |found: &[DirectFit]| {
        // A resonance far from the excitation is an alias.
        let determined = found.iter().filter(|fit| is_determined(fit) && !is_implausible(recording, fit));
        determined.min_by(|a, b| information(recording, a).total_cmp(&information(recording, b))).cloned()
    };
    let first = best(&found)?;
    let both = Alignment {
        shift: first
            .alignment
            .shift
            .map(|(inputs, periods)| (inputs, periods.value))
            .or(Some((ShiftedInputs::All, 0.0))),
        rotation: Some(first.alignment.rotation_deg.map_or(0.0, |angle| angle.value * PI / 180.0)),
    };
    found.extend(fit_view(recording, first.alignment.is_mirrored, both, Some(&first)));
    best(&found)
}

/// Fits the recording, or its mirror image with a reversed Wq.
fn fit_view(
    recording: &Recording,
    is_mirrored: bool,
    alignment: Alignment,
    start: Option<&DirectFit>,
) -> Option<DirectFit> {
    if !is_mirrored {
        return fit_aligned(recording, alignment, start).ok();
    }
    let mirror = |fit: DirectFit| DirectFit { curve: fit.curve.iter().map(Complex64::conj).collect(), ..fit };
    let start = start.cloned().map(mirror);
    let fit = mirror(fit_aligned(&turn_back(recording, true, 0.0), alignment, start.as_ref()).ok()?);
    Some(DirectFit { alignment: FittedAlignment { is_mirrored, ..fit.alignment }, ..fit })
}

fn turn_back(recording: &Recording, is_mirrored: bool, angle: f64) -> Recording {
    let turn = Complex64::cis(-angle);
    let back = |output: &RecordedSample| {
        let w = if is_mirrored { output.w.conj() } else { output.w };
        RecordedSample { w: w * turn, ..*output }
    };
    Recording { outputs: recording.outputs.iter().map(back).collect(), ..recording.clone() }
}

/// The recording as the plate sees it: shifted inputs, and W turned back.
pub(crate) fn correct(recording: &Recording, alignment: &FittedAlignment) -> Recording {
    let angle = alignment.rotation_deg.map_or(0.0, |angle| angle.value * PI / 180.0);
    let mut corrected = if angle == 0.0 && !alignment.is_mirrored {
        recording.clone()
    } else {
        turn_back(recording, alignment.is_mirrored, angle)
    };
    if let Some((inputs, periods)) = alignment.shift {
        corrected.inputs = shift_inputs(recording, inputs, periods.value * recording.period());
    }
    corrected
}

fn shift_inputs(recording: &Recording, shifted: ShiftedInputs, seconds: f64) -> Vec<RecordedInput> {
    let by = |inputs: ShiftedInputs| if [inputs, ShiftedInputs::All].contains(&shifted) { seconds } else { 0.0 };
    let (drive, frequency, rest) = (by(ShiftedInputs::Drive), by(ShiftedInputs::Frequency), by(ShiftedInputs::All));
    let inputs = &recording.inputs;
    let at = |t: f64| inputs.get(inputs.partition_point(|input| input.t <= t).saturating_sub(1));
    let mut times: Vec<f64> =
        inputs.iter().skip(1).flat_map(|input| [drive, frequency, rest].map(|shift| input.t + shift)).collect();
    times.extend(inputs.first().zip(recording.outputs.first()).map(|(input, output)| input.t.min(output.t)));
    times.sort_by(f64::total_cmp);
    // A shift and its subtraction give the recorded time only up to rounding.
    let rounding = 1e-6 * recording.period();
    times.dedup_by(|later, earlier| *later - *earlier <= rounding);
    // ARX models need an input at a sample, so a nearly whole shift is a whole one.
    let (outputs, near) = (&recording.outputs, SAME_INSTANT * recording.period());
    let snapped = |t: f64| {
        let next = outputs.get(outputs.partition_point(|output| output.t < t - near));
        next.filter(|output| output.t <= t + near).map_or(t, |output| output.t)
    };
    let acting = |t: f64| {
        let (drive, frequency, rest) =
            (at(t - drive + rounding)?, at(t - frequency + rounding)?, at(t - rest + rounding)?);
        let t = snapped(t);
        Some(RecordedInput { t, vpp: drive.vpp, omega: frequency.omega, conditions: rest.conditions })
    };
    times.into_iter().filter_map(acting).collect()
}

/// The recording with time stamps on a grid, and the standard deviation in s by which they move.
/// `None` if they are on one already, or no grid is near.
fn with_equal_spacing(recording: &Recording) -> Option<(Recording, f64)> {
    let (outputs, period) = (&recording.outputs, recording.period());
    let mut number = 0.0;
    let mut numbers = vec![0.0];
    for [before, after] in outputs.array_windows() {
        number += ((after.t - before.t) / period).round().max(1.0);
        numbers.push(number);
    }
    let count = outputs.len() as f64;
    let mean_number = numbers.iter().sum::<f64>() / count;
    let mean_time = outputs.iter().map(|output| output.t).sum::<f64>() / count;
    let along = numbers.iter().zip(outputs).map(|(number, output)| (number - mean_number) * (output.t - mean_time));
    let spacing = along.sum::<f64>() / numbers.iter().map(|number| (number - mean_number).powi(2)).sum::<f64>();
    let grid: Vec<f64> = numbers.iter().map(|number| mean_time + spacing * (number - mean_number)).collect();
    let squares = grid.iter().zip(outputs).map(|(t, output)| (output.t - t).powi(2)).sum::<f64>();
    let deviation = (squares / count).sqrt();
    if deviation < SMALLEST_JITTER * period || deviation > period {
        return None;
    }
    // Between two samples the time is interpolated.
    let moved = |t: f64| {
        let next = outputs.partition_point(|output| output.t < t).clamp(1, outputs.len() - 1);
        let (from, to) = (outputs.get(next - 1)?.t, outputs.get(next)?.t);
        let (start, end) = (grid.get(next - 1)?, grid.get(next)?);
        if t == to {
            return Some(*end);
        }
        Some(start + (end - start) * (t - from) / (to - from))
    };
    let inputs = recording.inputs.iter().filter_map(|input| Some(RecordedInput { t: moved(input.t)?, ..*input }));
    let inputs: Vec<RecordedInput> = inputs.collect();
    let outputs = grid.iter().zip(outputs).map(|(t, output)| RecordedSample { t: *t, ..*output }).collect();
    let gap = |gap: &Gap| Some(Gap { from: moved(gap.from)?, to: moved(gap.to)?, ..*gap });
    let gaps = recording.gaps.iter().filter_map(gap).collect();
    Some((Recording { inputs, outputs, gaps, ..recording.clone() }, deviation))
}
