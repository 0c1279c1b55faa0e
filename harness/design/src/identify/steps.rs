//! Finds the steps in a recording and fits each step by three methods: the rows of Tables I and II.

use crate::identify::estimate::Estimate;
use crate::identify::estimate::{ArxMethod, ArxModel, arx_with_gaps};
use crate::identify::fit::{DirectFit, fit_direct};
use platebench_model::recording::{RecordedInput, Recording};
use schemars::JsonSchema;
use serde::Serialize;

const MIN_SAMPLES: usize = 6;
/// Largest difference of two drives that count as equal, as a fraction of the largest drive.
const SAME_DRIVE: f64 = 0.01;
/// Smallest step as a fraction of the largest drive. Smaller changes come from a control loop.
const SMALLEST_STEP: f64 = 0.05;
/// Largest |τΔω| of a voltage step. At a larger detuning Wd does not respond with first order.
const MAX_TAU_DETUNING: f64 = 0.1;
/// Largest relative deviation of Wd from its mean while a control loop keeps Wd constant.
const HELD_BAND: f64 = 0.1;
/// Largest relative deviation of Wd at which the loop counts as settled before the first step.
const STARTED_BAND: f64 = 0.03;
/// Smallest width of both bands, in standard deviations of the noise.
const NOISE_BAND: f64 = 4.0;
const SAME_DETUNING: f64 = 1.0;
/// Largest distance of two instants that count as equal, in periods.
pub(crate) const SAME_INSTANT: f64 = 0.02;

/// Step of the drive without control: a row of Table I.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct VoltageStep {
    pub recording: String,
    pub t: f64,
    pub from_vpp: f64,
    pub vpp: f64,
    /// Finger force, N.
    pub force_n: f64,
    /// Mean of Wd over the last third of the step, a point of Fig. 7.
    pub settled_um: f64,
    /// K1 in µm/Vpp and τ1 in s by ARX with least squares; `None` if the model is not stable.
    pub least_squares: Option<[Estimate; 2]>,
    pub instruments: Option<[Estimate; 2]>,
    pub direct: Option<[Estimate; 2]>,
}

/// Step of the detuning at constant Wd: a row of Table II.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct FrequencyStep {
    pub recording: String,
    pub t: f64,
    /// Detuning in rad/s, relative to the resonance from the recording's direct fit.
    pub from_detuning: f64,
    pub detuning: f64,
    /// Largest deviation of Wd from its mean, percent (Fig. 10).
    pub wd_percent: f64,
    /// K2 in s and τ2 in s by ARX with least squares.
    pub least_squares: Option<[Estimate; 2]>,
    pub instruments: Option<[Estimate; 2]>,
    /// τ in s by the direct fit. The gain K2 equals τ (equation 19).
    pub direct: Option<Estimate>,
    /// First sample of both levels, and the index after the last sample.
    #[serde(skip)]
    window: (usize, usize),
}

/// Index ranges (first, after the last) in which each input is the `same` as the first one.
fn constant_intervals(
    acting: &[RecordedInput],
    same: impl Fn(&RecordedInput, &RecordedInput) -> bool,
) -> Vec<(usize, usize)> {
    let mut runs: Vec<(usize, usize)> = Vec::new();
    for (index, input) in acting.iter().enumerate() {
        match runs.last_mut() {
            Some(run) if acting.get(run.0).is_some_and(|first| same(first, input)) => run.1 = index + 1,
            _ => runs.push((index, index + 1)),
        }
    }
    runs
}

/// Finds upward steps between two constant drives, close to the resonance that `whole` identified.
pub fn voltage_steps(recording: &Recording, whole: &DirectFit) -> Vec<VoltageStep> {
    let Some(tau) = whole.time_constant() else { return Vec::new() };
    let is_near = |input: &RecordedInput| {
        let resonance = whole.resonances.iter().find(|(conditions, _)| *conditions == input.conditions);
        resonance.is_some_and(|(_, omega0)| ((input.omega - omega0.value) * tau.value).abs() <= MAX_TAU_DETUNING)
    };
    let acting = recording.inputs_at_samples();
    let largest = acting.iter().map(|input| input.vpp).fold(0.0, f64::max);
    let same = |a: &RecordedInput, b: &RecordedInput| {
        (a.vpp - b.vpp).abs() <= SAME_DRIVE * largest && a.omega == b.omega && a.conditions == b.conditions
    };
    let runs = constant_intervals(&acting, same);
    let mut steps = Vec::new();
    for (index, &(start, end)) in runs.iter().enumerate() {
        // The first level is not a step, because it may have started before the recording.
        let Some(before) = index.checked_sub(1).and_then(|index| runs.get(index)) else { continue };
        let (Some(from), Some(to)) = (acting.get(before.0), acting.get(start)) else { continue };
        let alike = from.omega == to.omega && from.conditions == to.conditions;
        let settled_before = before.1 - before.0 >= MIN_SAMPLES || from.vpp == 0.0;
        if !alike
            || !settled_before
            || end - start < MIN_SAMPLES
            || to.vpp - from.vpp < SMALLEST_STEP * largest
            || !is_near(to)
        {
            continue;
        }
        // The sample at the time of the step still belongs to the earlier drive.
        let (first, last) = (start.saturating_sub(1), (end + 1).min(acting.len()));
        let Ok(part) = recording.slice(first, last) else { continue };
        let wd: Vec<f64> = part.outputs.iter().map(|output| output.w.re).collect();
        let drive: Vec<f64> = part.inputs_at_samples().iter().map(|input| input.vpp).collect();
        let steps_between = periods_between_samples(&part);
        let by = |method| {
            let steps = steps_between.as_ref()?;
            let arx = arx_with_gaps(&wd, std::slice::from_ref(&drive), steps, part.period(), method)?;
            estimate_pair(&arx)
        };
        let third = wd.len() - wd.len() / 3;
        let settled = wd.get(third..).unwrap_or_default();
        steps.push(VoltageStep {
            recording: recording.name.clone(),
            t: part.inputs.last().map_or(0.0, |input| input.t),
            from_vpp: from.vpp,
            vpp: to.vpp,
            force_n: to.conditions.finger_force_n,
            settled_um: settled.iter().sum::<f64>() / settled.len() as f64,
            least_squares: by(ArxMethod::LeastSquares),
            instruments: by(ArxMethod::InstrumentalVariables),
            direct: fit_direct(&part).ok().and_then(|fit| Some([fit.gain, fit.time_constant()?])),
        });
    }
    steps
}

/// Number of periods from each sample to the next one. `None` if a spacing is no whole number of
/// periods, or an input changes between two samples: an ARX model does not apply.
fn periods_between_samples(part: &Recording) -> Option<Vec<usize>> {
    let period = part.period();
    let is_whole = |periods: f64| (periods - periods.round()).abs() <= SAME_INSTANT;
    let at_sample = |input: &RecordedInput| {
        // An input shortly after a sample would count from the next sample on.
        let next = part.outputs.partition_point(|output| output.t < input.t);
        part.outputs.get(next).is_some_and(|output| output.t <= input.t + SAME_INSTANT * period)
    };
    let spacings: Vec<f64> =
        part.outputs.array_windows().map(|[before, after]| (after.t - before.t) / period).collect();
    let fits = spacings.iter().all(|periods| is_whole(*periods)) && part.inputs.iter().skip(1).all(at_sample);
    fits.then(|| spacings.iter().map(|periods| periods.round() as usize).collect())
}

fn estimate_pair(arx: &ArxModel) -> Option<[Estimate; 2]> {
    Some([*arx.gains.first()?, arx.time_constant])
}

/// Finds steps of the detuning while a loop keeps Wd constant. `slope` is the change of the
/// resonance in rad/s per K. A step of the resonance by `−Δ` equals a step of the frequency by
/// `+Δ`, because only Δω matters (equations 11 and 18).
pub fn frequency_steps(recording: &Recording, whole: &DirectFit, slope: Option<f64>) -> Vec<FrequencyStep> {
    let acting = recording.inputs_at_samples();
    let Some((reference, resonance)) = whole.resonances.first() else { return Vec::new() };
    let is_warmed =
        recording.conditions.iter().any(|other| other.temperature_offset_k != reference.temperature_offset_k);
    let Some(slope) = slope.or((!is_warmed).then_some(0.0)) else { return Vec::new() };
    let detuning = |input: &RecordedInput| {
        let warmer = input.conditions.temperature_offset_k - reference.temperature_offset_k;
        input.omega - resonance.value - slope * warmer
    };
    let same = |a: &RecordedInput, b: &RecordedInput| {
        (detuning(a) - detuning(b)).abs() <= SAME_DETUNING && a.conditions.finger_force_n == b.conditions.finger_force_n
    };
    let runs = constant_intervals(&acting, same);
    let mut steps = Vec::new();
    for &[(mut first, middle), (start, end)] in runs.array_windows() {
        let (Some(from), Some(to)) = (acting.get(first), acting.get(start)) else { continue };
        if middle - first < MIN_SAMPLES
            || end - start < MIN_SAMPLES
            || from.conditions.finger_force_n != to.conditions.finger_force_n
        {
            continue;
        }
        let wd = |from: usize, to: usize| {
            recording.outputs.get(from..to).unwrap_or_default().iter().map(|output| output.w.re)
        };
        let mean = wd(start, end).sum::<f64>() / (end - start) as f64;
        let deviation = |value: &f64| (value - mean).abs() / mean.abs();
        let noise = NOISE_BAND * whole.noise_um / mean.abs();
        first += wd(first, middle)
            .collect::<Vec<_>>()
            .iter()
            .rposition(|value| deviation(value) > STARTED_BAND.max(noise))
            .map_or(0, |last| last + 1);
        if middle.saturating_sub(first) < MIN_SAMPLES
            || !wd(start, end).all(|value| deviation(&value) < HELD_BAND.max(noise))
        {
            continue;
        }
        let window = (first, (end + 1).min(acting.len()));
        let Ok(part) = recording.slice(window.0, window.1) else { continue };
        // A constant drive means that no loop controls Wd.
        if part.inputs.iter().all(|input| input.vpp == to.vpp) {
            continue;
        }
        let length = end - first;
        let ratio: Vec<f64> = part.outputs.iter().take(length + 1).map(|output| output.w.im / output.w.re).collect();
        // The static gain from Δω to Wq/Wd is −K2.
        let input: Vec<f64> = part.inputs_at_samples().iter().map(|input| detuning(from) - detuning(input)).collect();
        let ones = vec![1.0; input.len()];
        let steps_between = periods_between_samples(&part);
        let by = |method| {
            let inputs = [input.clone(), ones.clone()];
            let arx = arx_with_gaps(&ratio, &inputs, steps_between.as_ref()?, part.period(), method)?;
            estimate_pair(&arx)
        };
        steps.push(FrequencyStep {
            recording: recording.name.clone(),
            t: recording.outputs.get(start).map_or(0.0, |output| output.t),
            from_detuning: detuning(from),
            detuning: detuning(to),
            wd_percent: wd(first, end).map(|value| (value / mean - 1.0).abs() * 100.0).fold(0.0, f64::max),
            least_squares: by(ArxMethod::LeastSquares),
            instruments: by(ArxMethod::InstrumentalVariables),
            direct: fit_direct(&part).ok().and_then(|fit| fit.time_constant()),
            window,
        });
    }
    steps
}

/// τ2 in s by direct fits of all steps of one recording. Neighbouring steps share a level, and
/// separate fits of them would not be independent. Therefore connected steps are one fit.
pub fn frequency_time_constant(recording: &Recording, steps: &[FrequencyStep]) -> Option<Estimate> {
    let mut parts: Vec<(usize, usize)> = Vec::new();
    for step in steps {
        match parts.last_mut() {
            Some(part) if step.window.0 < part.1 => part.1 = step.window.1,
            _ => parts.push(step.window),
        }
    }
    let fit = |(first, end)| fit_direct(&recording.slice(first, end).ok()?).ok()?.time_constant();
    Estimate::combine_independent(&parts.into_iter().filter_map(fit).collect::<Vec<_>>())
}
