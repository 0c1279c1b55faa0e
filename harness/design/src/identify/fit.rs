//! Fits the exact response of the mode to all samples (the direct fit).
//!
//! The plate is the modal model with piecewise constant drive, frequency, temperature and force. Its
//! parameters are K1, one time constant per force, one resonance per temperature and force, the
//! time of each change of force, and W at the first sample. Noise is modelled as an error of the
//! output. Therefore the estimates are unbiased to first order, and the residuals of the right
//! model are white. The Levenberg-Marquardt method minimises them over logarithms of positive
//! parameters. The curvature at the minimum and the power of the residuals give the intervals.
//!
//! A finger touches between two rows, and the recording contains the new force from the next row
//! on. The time of a touch is therefore known only to one period. Its error δ changes the first
//! sample by `ΔW(1 − e^(−δ/τ))` and biases τ.
//!
//! If one mode does not explain a recording under one temperature and force, a second mode or
//! self-heating is fitted too. A second mode has the same drive, and W is the sum of both modes.
//! Self-heating gives the resonance `ω0 + s T` with `T' = (|W|² − T)/τ_h`, T in µm² and 0 at the
//! first sample. Each interval between samples or inputs uses the resonance at its middle.

use crate::identify::estimate::{
    ArxMethod, EffectFit, Estimate, IdentifiedHeating, IdentifiedSecondMode, WhitenessTest, arx,
};
use nalgebra::{DMatrix, DVector};
use platebench_model::recording::{Recording, RecordingError};
use platebench_plate::{Complex64, Conditions, Drive, Flow, Mode, Model, State};
use std::f64::consts::TAU;

const MAX_ITERATIONS: usize = 80;
const CONVERGENCE_TOLERANCE: f64 = 1e-10;
const DIFFERENCE_STEP: f64 = 1e-6;
/// Unit of the resonance parameters, rad/s. They are relative to the mean excitation frequency.
pub(crate) const OMEGA_UNIT: f64 = 500.0;
/// A fit fails if the relative error of K1 or τ is larger.
const MAX_RELATIVE_ERROR: f64 = 0.5;
/// Fits with variable touch times. Each derives `touch_weight` from the noise of the previous one.
const TOUCH_FITS: usize = 2;
/// Lower limit of `touch_weight`, below rounding errors. Without this limit, a touch time without
/// effect would make a noise-free fit singular.
const SMALLEST_NOISE_UM: f64 = 1e-12;

#[derive(Debug, Clone, PartialEq)]
pub struct DirectFit {
    /// K1 at the lowest force, µm/Vpp.
    pub gain: Estimate,
    /// Pairs of force in N, lowest first, and τ in s.
    pub time_constants: Vec<(f64, Estimate)>,
    /// Pairs of force in N and σ relative to σ at the lowest force.
    pub damping: Vec<(f64, Estimate)>,
    /// ω0 in rad/s for each temperature and force.
    pub resonances: Vec<(Conditions, Estimate)>,
    /// Covariance in (rad/s)². An error of τ shifts all resonances that are excited off resonance.
    pub resonance_covariance: DMatrix<f64>,
    /// Standard deviation of the residuals on each component.
    pub noise_um: f64,
    pub whiteness: Option<WhitenessTest>,
    /// W of the model at each sample.
    pub curve: Vec<Complex64>,
    pub effect: Option<EffectFit>,
}

impl DirectFit {
    pub fn time_constant(&self) -> Option<Estimate> {
        self.time_constants.first().map(|(_, estimate)| *estimate)
    }
}

struct LevelChange {
    /// Time in the recording, s.
    t: f64,
    conditions: usize,
    /// Number of the touch; `None` if the force does not change.
    touch: Option<usize>,
}

struct ParameterLayout<'a> {
    recording: &'a Recording,
    first_conditions: usize,
    changes: Vec<LevelChange>,
    touches: usize,
    period: f64,
    /// Factor from a touch time in periods to a residual in µm; 0 keeps the recorded touch times.
    touch_weight: f64,
    /// Finger forces in N, lowest first.
    forces: Vec<f64>,
    force_index: Vec<usize>,
    mean_omega: f64,
}

impl<'a> ParameterLayout<'a> {
    fn new(recording: &'a Recording) -> Self {
        let mut forces: Vec<f64> = recording.conditions.iter().map(|conditions| conditions.finger_force_n).collect();
        forces.sort_by(f64::total_cmp);
        forces.dedup();
        let number = |conditions: &Conditions| forces.iter().position(|force| *force == conditions.finger_force_n);
        let force_of = recording.conditions.iter().map(|conditions| number(conditions).unwrap_or(0)).collect();
        let omega = recording.inputs.iter().map(|input| input.omega).sum::<f64>() / recording.inputs.len() as f64;
        let level = |at: &Conditions| recording.conditions.iter().position(|other| other == at).unwrap_or(0);
        let mut changes = Vec::new();
        let mut touches = 0;
        for [before, after] in recording.inputs.array_windows() {
            let is_touch = before.conditions.finger_force_n != after.conditions.finger_force_n;
            if before.conditions != after.conditions {
                let touch = is_touch.then_some(touches);
                changes.push(LevelChange { t: after.t, conditions: level(&after.conditions), touch });
                touches += usize::from(is_touch);
            }
        }
        Self {
            recording,
            first_conditions: recording.inputs.first().map_or(0, |first| level(&first.conditions)),
            changes,
            touches,
            period: recording.period(),
            touch_weight: 0.0,
            forces,
            force_index: force_of,
            mean_omega: omega,
        }
    }

    /// Number of parameters `[ln K1, ln τ …, resonance …, Re W, Im W, touch time in periods …]`.
    fn parameter_count(&self) -> usize {
        self.touch_index(if self.touch_weight > 0.0 { self.touches } else { 0 })
    }

    fn touch_index(&self, touch: usize) -> usize {
        self.state_index() + 2 + touch
    }

    fn state_index(&self) -> usize {
        self.resonance_index(0) + self.force_index.len()
    }

    fn resonance_index(&self, conditions: usize) -> usize {
        1 + self.forces.len() + conditions
    }

    fn response(&self, theta: &DVector<f64>) -> Vec<Complex64> {
        let sigma = |force: usize| (-theta[1 + force]).exp();
        let constant = theta[0].exp() * sigma(0);
        let omega0 = |conditions: usize| self.mean_omega + OMEGA_UNIT * theta[self.resonance_index(conditions)];
        let modes: Vec<Mode> = (0..self.force_index.len())
            .map(|number| Mode {
                sigma: sigma(self.force_index[number]),
                omega0: omega0(number),
                force_constant: 2.0 * constant * omega0(0),
                envelope_constant: constant,
            })
            .collect();
        let Recording { inputs, outputs, .. } = self.recording;
        let w = Complex64::new(theta[self.state_index()], theta[self.state_index() + 1]);
        let delay = |touch: usize| theta.get(self.touch_index(touch)).map_or(0.0, |periods| periods * self.period);
        let at = |change: &LevelChange| change.t + change.touch.map_or(0.0, delay);
        let (mut changes, mut number) = (self.changes.iter().peekable(), self.first_conditions);
        let mut state = State { w, u: Complex64::I * inputs[0].omega * w };
        let mut now = outputs[0].t;
        let mut index = inputs.partition_point(|input| input.t <= now).saturating_sub(1);
        let mut all = Vec::with_capacity(outputs.len());
        for output in outputs {
            while now < output.t {
                while let Some(change) = changes.next_if(|change| at(change) <= now) {
                    number = change.conditions;
                }
                let (input, next) = (inputs[index], inputs.get(index + 1));
                let end = next.map_or(output.t, |next| next.t.min(output.t));
                let end = changes.peek().map_or(end, |change| at(change).min(end));
                let drive = Drive { vpp: input.vpp, omega: input.omega };
                state = Flow::new(Model::Modal, &modes[number], &drive, &state).after(end - now);
                now = end;
                index += usize::from(next.is_some_and(|next| next.t <= now));
            }
            all.push(state.w);
        }
        all
    }

    fn residuals(&self, theta: &DVector<f64>) -> DVector<f64> {
        let response = self.response(theta);
        let differences = self.recording.outputs.iter().zip(response).map(|(output, w)| output.w - w);
        let touches = theta.iter().skip(self.touch_index(0)).map(|periods| periods * self.touch_weight);
        let samples = differences.flat_map(|difference| [difference.re, difference.im]);
        DVector::from_iterator(2 * self.recording.outputs.len() + touches.len(), samples.chain(touches))
    }

    fn start_vector(&self, tau: f64, detuning: f64) -> DVector<f64> {
        let mut theta = DVector::zeros(self.parameter_count());
        for force in 0..self.forces.len() {
            theta[1 + force] = tau.ln();
        }
        for number in 0..self.force_index.len() {
            theta[self.resonance_index(number)] = -detuning / OMEGA_UNIT;
        }
        let first = self.recording.outputs[0].w;
        (theta[self.state_index()], theta[self.state_index() + 1]) = (first.re, first.im);
        let unit = self.response(&theta);
        let seen = &self.recording.outputs;
        let along: f64 = seen.iter().zip(&unit).map(|(output, w)| output.w.re * w.re + output.w.im * w.im).sum();
        let power: f64 = unit.iter().map(Complex64::norm_sqr).sum();
        theta[0] = (along / power).abs().max(1e-12).ln();
        theta
    }
}

/// Fails if the samples do not determine the parameters.
pub fn fit_direct(recording: &Recording) -> Result<DirectFit, RecordingError> {
    let mut layout = ParameterLayout::new(recording);
    let count = layout.touch_index(layout.touches);
    let freedom = (2 * recording.outputs.len()).checked_sub(count).filter(|&freedom| freedom > 1);
    let freedom = freedom.ok_or(RecordingError::Undetermined)? as f64;
    let best = start_points(recording)
        .into_iter()
        .filter_map(|(tau, detuning)| minimise(&|theta| layout.residuals(theta), layout.start_vector(tau, detuning)))
        .min_by(|a, b| a.1.total_cmp(&b.1));
    let (mut theta, mut squares) = best.ok_or(RecordingError::Undetermined)?;
    for _ in 0..if layout.touches > 0 { TOUCH_FITS } else { 0 } {
        layout.touch_weight = (squares / freedom).sqrt().max(SMALLEST_NOISE_UM);
        let start = theta.resize_vertically(count, 0.0);
        (theta, squares) = minimise(&|theta| layout.residuals(theta), start).ok_or(RecordingError::Undetermined)?;
    }
    let power = squares / freedom;
    let covariance =
        covariance_of(&|theta| layout.residuals(theta), &theta).ok_or(RecordingError::Undetermined)? * power;
    let error = |index: usize| covariance[(index, index)].max(0.0).sqrt();
    let positive = |index: usize| Estimate::from_logarithm(theta[index], error(index), freedom);
    if !(0..=layout.forces.len()).all(|index| error(index) < MAX_RELATIVE_ERROR) {
        return Err(RecordingError::Undetermined);
    }
    let ratio = |force: usize| {
        let index = 1 + force;
        let variance = covariance[(1, 1)] + covariance[(index, index)] - 2.0 * covariance[(1, index)];
        Estimate::from_logarithm(theta[1] - theta[index], variance.max(0.0).sqrt(), freedom)
    };
    let resonance = |(number, conditions): (usize, &Conditions)| {
        let index = layout.resonance_index(number);
        let value = layout.mean_omega + OMEGA_UNIT * theta[index];
        (*conditions, Estimate::new(value, OMEGA_UNIT * error(index), freedom))
    };
    let forces = || layout.forces.iter().copied().enumerate();
    let (residuals, levels) = (layout.residuals(&theta), recording.conditions.len());
    let samples = 2 * recording.outputs.len();
    let component = |offset: usize| residuals.iter().take(samples).skip(offset).step_by(2).copied().collect();
    Ok(DirectFit {
        gain: positive(0),
        time_constants: forces().map(|(number, force)| (force, positive(1 + number))).collect(),
        damping: forces().map(|(number, force)| (force, ratio(number))).collect(),
        resonances: recording.conditions.iter().enumerate().map(resonance).collect(),
        resonance_covariance: covariance.view((layout.resonance_index(0), layout.resonance_index(0)), (levels, levels))
            * OMEGA_UNIT.powi(2),
        noise_um: power.sqrt(),
        whiteness: WhitenessTest::ljung_box(&[component(0), component(1)]),
        curve: layout.response(&theta),
        effect: None,
    })
}

/// Start values `(τ in s, Δω in rad/s)`: one from a first-order fit of Wd at resonance, and two
/// around the paper's plate.
fn start_points(recording: &Recording) -> Vec<(f64, f64)> {
    let wd: Vec<f64> = recording.outputs.iter().map(|output| output.w.re).collect();
    let drive: Vec<f64> = recording.inputs_at_samples().iter().map(|input| input.vpp).collect();
    let first =
        arx(&wd, &[drive], recording.period(), ArxMethod::LeastSquares).map_or(2e-3, |arx| arx.time_constant.value);
    vec![(first.clamp(1e-4, 1e-1), 0.0), (1.9e-3, 600.0), (1.9e-3, -600.0)]
}

fn jacobian(
    of: &impl Fn(&DVector<f64>) -> DVector<f64>,
    theta: &DVector<f64>,
    residuals: &DVector<f64>,
) -> DMatrix<f64> {
    let column = |index: usize| {
        let mut moved = theta.clone();
        moved[index] += DIFFERENCE_STEP;
        (of(&moved) - residuals) / DIFFERENCE_STEP
    };
    DMatrix::from_columns(&(0..theta.len()).map(column).collect::<Vec<_>>())
}

/// Covariance of the parameters if the residuals have the variance 1. `None` if the samples do not
/// determine the parameters.
pub(crate) fn covariance_of(
    residuals: &impl Fn(&DVector<f64>) -> DVector<f64>,
    theta: &DVector<f64>,
) -> Option<DMatrix<f64>> {
    let jacobian = jacobian(residuals, theta, &residuals(theta));
    (jacobian.transpose() * &jacobian).cholesky().map(|factor| factor.inverse())
}

/// Minimises the residuals `of` the parameters by the Levenberg-Marquardt method. Returns the
/// parameters and the sum of squares.
pub(crate) fn minimise(
    of: &impl Fn(&DVector<f64>) -> DVector<f64>,
    mut theta: DVector<f64>,
) -> Option<(DVector<f64>, f64)> {
    let mut residuals = of(&theta);
    let mut squares = residuals.norm_squared();
    let mut damping = 1e-3;
    for _ in 0..MAX_ITERATIONS {
        let jacobian = jacobian(of, &theta, &residuals);
        let (normal, gradient) = (jacobian.transpose() * &jacobian, jacobian.transpose() * &residuals);
        let mut fall = 0.0;
        while damping < 1e9 {
            let mut damped = normal.clone();
            for index in 0..theta.len() {
                damped[(index, index)] += damping * (normal[(index, index)] + 1e-12);
            }
            let step = damped.cholesky()?.solve(&gradient);
            let moved = &theta - step;
            let (sane, new) = (moved.iter().all(|value| value.abs() < 50.0), of(&moved));
            let lower = new.norm_squared();
            if sane && lower <= squares {
                fall = (squares - lower) / squares.max(f64::MIN_POSITIVE);
                (theta, residuals, squares) = (moved, new, lower);
                damping = (damping * 0.1).max(1e-12);
                break;
            }
            damping *= 10.0;
        }
        if fall < CONVERGENCE_TOLERANCE {
            break;
        }
    }
    squares.is_finite().then_some((theta, squares))
}

/// Longest interval of the model. In longer ones |W|² and T are not nearly linear.
const LONGEST_PIECE_S: f64 = 1e-3;
/// Unit of the parameter s of self-heating, rad/s per µm².
const SHIFT_UNIT: f64 = 10.0;
/// Start values, below the Nyquist frequency of 500 Hz with a reserve for the detuning.
const SECOND_MODE_DISTANCES_HZ: [f64; 10] = [-420.0, -300.0, -200.0, -120.0, -60.0, 60.0, 120.0, 200.0, 300.0, 420.0];
/// Start values as a fraction of K1.
const SECOND_GAINS: [f64; 2] = [0.1, -0.1];
const HEATING_TIME_CONSTANTS_S: [f64; 3] = [0.05, 0.3, 2.0];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum EffectKind {
    SecondMode,
    Heating,
}

/// Parameters `[ln K1, ln τ, resonance, Re W, Im W]`, followed by `[ln τ2, resonance, gain/K1]` of
/// a second mode or `[s, ln τ_h]` of self-heating.
struct EffectModel<'a> {
    recording: &'a Recording,
    kind: EffectKind,
    mean_omega: f64,
}

fn mode(gain: f64, sigma: f64, omega0: f64) -> Mode {
    let envelope_constant = gain * sigma;
    Mode { sigma, omega0, force_constant: 2.0 * envelope_constant * omega0, envelope_constant }
}

impl EffectModel<'_> {
    fn omega(&self, parameter: f64) -> f64 {
        self.mean_omega + OMEGA_UNIT * parameter
    }

    fn response(&self, theta: &DVector<f64>) -> Vec<Complex64> {
        let (gain, sigma, omega0) = (theta[0].exp(), (-theta[1]).exp(), self.omega(theta[2]));
        let (second, shift, rate) = match self.kind {
            EffectKind::SecondMode => (Some(mode(gain * theta[7], (-theta[5]).exp(), self.omega(theta[6]))), 0.0, 0.0),
            EffectKind::Heating => (None, SHIFT_UNIT * theta[5], (-theta[6]).exp()),
        };
        let Recording { inputs, outputs, .. } = self.recording;
        let w = Complex64::new(theta[3], theta[4]);
        let mut first = State { w, u: Complex64::I * inputs[0].omega * w };
        let mut other = State::default();
        let mut warmth = 0.0;
        let mut now = outputs[0].t;
        let mut index = inputs.partition_point(|input| input.t <= now).saturating_sub(1);
        let mut all = Vec::with_capacity(outputs.len());
        for output in outputs {
            while now < output.t {
                let (input, next) = (inputs[index], inputs.get(index + 1));
                let end = next.map_or(output.t, |next| next.t.min(output.t)).min(now + LONGEST_PIECE_S);
                let drive = Drive { vpp: input.vpp, omega: input.omega };
                let seconds = end - now;
                let squared = (first.w + other.w).norm_sqr();
                let middle = warmth + rate * seconds / 2.0 * (squared - warmth);
                let plate = mode(gain, sigma, omega0 + shift * middle);
                first = Flow::new(Model::Modal, &plate, &drive, &first).after(seconds);
                if let Some(second) = &second {
                    other = Flow::new(Model::Modal, second, &drive, &other).after(seconds);
                }
                let mean = squared.midpoint((first.w + other.w).norm_sqr());
                warmth = mean + (warmth - mean) * (-rate * seconds).exp();
                now = end;
                index += usize::from(next.is_some_and(|next| next.t <= now));
            }
            all.push(first.w + other.w);
        }
        all
    }

    fn residuals(&self, theta: &DVector<f64>) -> DVector<f64> {
        let response = self.response(theta);
        let differences = self.recording.outputs.iter().zip(response).map(|(output, w)| output.w - w);
        DVector::from_iterator(2 * self.recording.outputs.len(), differences.flat_map(|d| [d.re, d.im]))
    }

    fn start_points(&self, fit: &DirectFit) -> Option<Vec<DVector<f64>>> {
        let (tau, resonance) = (fit.time_constant()?.value, fit.resonances.first()?.1.value);
        let first = self.recording.outputs[0].w;
        let parameter = (resonance - self.mean_omega) / OMEGA_UNIT;
        let common = [fit.gain.value.ln(), tau.ln(), parameter, first.re, first.im];
        let with = |more: &[f64]| DVector::from_vec([&common[..], more].concat());
        Some(match self.kind {
            EffectKind::SecondMode => {
                let distances = SECOND_MODE_DISTANCES_HZ.iter();
                let place = |hz: &f64| {
                    let at = parameter + TAU * hz / OMEGA_UNIT;
                    SECOND_GAINS.map(|gain| with(&[tau.ln(), at, gain]))
                };
                distances.flat_map(place).collect()
            }
            EffectKind::Heating => {
                let starts = HEATING_TIME_CONSTANTS_S.iter();
                starts.flat_map(|seconds: &f64| [-1.0, 1.0].map(|shift| with(&[shift, seconds.ln()]))).collect()
            }
        })
    }

    /// Parameters with exchanged modes as a new start, if the second mode has the larger gain.
    fn exchange_modes(&self, theta: &DVector<f64>) -> Option<DVector<f64>> {
        if self.kind != EffectKind::SecondMode || theta[7].abs() <= 1.0 {
            return None;
        }
        let gain = theta[0] + theta[7].abs().ln();
        let more = [theta[1], theta[2], 1.0 / theta[7]];
        Some(DVector::from_vec([&[gain, theta[5], theta[6], theta[3], theta[4]][..], &more].concat()))
    }

    fn fit(&self, one_mode: &DirectFit) -> Option<DirectFit> {
        let samples = 2 * self.recording.outputs.len();
        let residuals = |theta: &DVector<f64>| self.residuals(theta);
        let found = self.start_points(one_mode)?.into_iter().filter_map(|start| minimise(&residuals, start));
        let (theta, squares) = found.min_by(|a, b| a.1.total_cmp(&b.1))?;
        let (theta, squares) = match self.exchange_modes(&theta) {
            Some(exchanged) => minimise(&residuals, exchanged)?,
            None => (theta, squares),
        };
        let freedom = samples.checked_sub(theta.len()).filter(|freedom| *freedom > 1)? as f64;
        let covariance = covariance_of(&residuals, &theta)? * (squares / freedom);
        let error = |index: usize| covariance[(index, index)].max(0.0).sqrt();
        let positive = |index: usize| Estimate::from_logarithm(theta[index], error(index), freedom);
        let resonance = |index: usize| Estimate::new(self.omega(theta[index]), OMEGA_UNIT * error(index), freedom);
        let effect = match self.kind {
            EffectKind::SecondMode => {
                let (gain, share) = (theta[0].exp(), theta[7]);
                let variance =
                    share * share * covariance[(0, 0)] + covariance[(7, 7)] + 2.0 * share * covariance[(0, 7)];
                EffectFit::SecondMode(IdentifiedSecondMode {
                    resonance_hz: resonance(6).scaled(1.0 / TAU),
                    time_constant_s: positive(5),
                    gain_um_per_vpp: Estimate::new(gain * share, gain * variance.max(0.0).sqrt(), freedom),
                })
            }
            EffectKind::Heating => EffectFit::Heating(IdentifiedHeating {
                shift_hz_per_um2: Estimate::new(theta[5], error(5), freedom).scaled(SHIFT_UNIT / TAU),
                time_constant_s: positive(6),
            }),
        };
        if !effect.is_determined() {
            return None;
        }
        let residuals = self.residuals(&theta);
        let component = |offset: usize| residuals.iter().skip(offset).step_by(2).copied().collect();
        let (force, conditions) = (one_mode.time_constants.first()?.0, one_mode.resonances.first()?.0);
        Some(DirectFit {
            gain: positive(0),
            time_constants: vec![(force, positive(1))],
            damping: one_mode.damping.clone(),
            resonances: vec![(conditions, resonance(2))],
            resonance_covariance: DMatrix::from_element(1, 1, covariance[(2, 2)] * OMEGA_UNIT.powi(2)),
            noise_um: (squares / freedom).sqrt(),
            whiteness: WhitenessTest::ljung_box(&[component(0), component(1)]),
            curve: self.response(&theta),
            effect: Some(effect),
        })
    }
}

/// Fits a second mode and self-heating, and returns the fit with the smaller residuals that
/// `is_explained` accepts. `None` if it accepts none, or if temperature or force changes.
pub(crate) fn fit_effect(
    recording: &Recording,
    one_mode: &DirectFit,
    is_explained: impl Fn(&DirectFit) -> bool,
) -> Option<DirectFit> {
    if recording.conditions.len() != 1 {
        return None;
    }
    let mean_omega = recording.inputs.iter().map(|input| input.omega).sum::<f64>() / recording.inputs.len() as f64;
    let kinds = [EffectKind::Heating, EffectKind::SecondMode];
    let fits = kinds.into_iter().filter_map(|kind| EffectModel { recording, kind, mean_omega }.fit(one_mode));
    fits.filter(is_explained).min_by(|a, b| a.noise_um.total_cmp(&b.noise_um))
}
