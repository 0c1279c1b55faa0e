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
//! The recorded inputs can act earlier or later than recorded, and the demodulator can be rotated.
//! Both are parameters of an aligned fit. If rows are missing and the inputs changed meanwhile, W at
//! the next sample is a parameter too, because the inputs in the gap are unknown.

use crate::identify::estimate::{ArxMethod, EffectFit, Estimate, WhitenessTest, arx};
use nalgebra::{DMatrix, DVector};
use platebench_model::recording::{RecordedInput, Recording, RecordingError};
use platebench_plate::{Complex64, Conditions, Drive, Flow, Mode, Model, State};
use schemars::JsonSchema;
use serde::Serialize;
use std::f64::consts::PI;

/// Largest number of gaps with unknown inputs in one recording.
const MAX_RESTARTS: usize = 64;
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
    pub alignment: FittedAlignment,
    /// Number of fitted parameters.
    pub parameters: usize,
}

/// Inputs that an aligned fit shifts in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ShiftedInputs {
    /// All inputs, or W in the other direction.
    All,
    Drive,
    Frequency,
}

/// Start values of the parameters of an aligned fit.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Alignment {
    /// Inputs, and the time in periods by which they act later than recorded.
    pub shift: Option<(ShiftedInputs, f64)>,
    /// Angle in rad by which the demodulator rotates W.
    pub rotation: Option<f64>,
}

/// Estimated alignment. All `None` or false if the recording is taken as it is.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct FittedAlignment {
    /// Inputs, and the time in periods by which they act later than recorded.
    pub shift: Option<(ShiftedInputs, Estimate)>,
    /// Angle by which the demodulator rotates W, degrees.
    pub rotation_deg: Option<Estimate>,
    /// True if the sign of Wq is reversed, before the rotation.
    pub is_mirrored: bool,
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
    alignment: Alignment,
    /// Changes of the drive: time in s and Vpp.
    drive: Vec<(f64, f64)>,
    /// Changes of the frequency: time in s and rad/s.
    frequency: Vec<(f64, f64)>,
    /// Samples at which W is a parameter, in addition to the first one.
    restarts: Vec<usize>,
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
    fn new(recording: &'a Recording, alignment: Alignment) -> Self {
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
        let track = |value: fn(&RecordedInput) -> f64| {
            let mut track: Vec<(f64, f64)> = recording.inputs.iter().map(|input| (input.t, value(input))).collect();
            track.dedup_by(|later, earlier| later.1 == earlier.1);
            track
        };
        Self {
            recording,
            alignment,
            drive: track(|input| input.vpp),
            frequency: track(|input| input.omega),
            restarts: recording.samples_after_unknown_inputs(),
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

    /// Number of parameters `[ln K1, ln τ …, resonance …, Re W, Im W, Re W, Im W at each restart …,
    /// shift in periods, rotation, touch time in periods …]`.
    fn parameter_count(&self) -> usize {
        self.touch_index(if self.touch_weight > 0.0 { self.touches } else { 0 })
    }

    fn touch_index(&self, touch: usize) -> usize {
        self.rotation_index() + usize::from(self.alignment.rotation.is_some()) + touch
    }

    fn rotation_index(&self) -> usize {
        self.shift_index() + usize::from(self.alignment.shift.is_some())
    }

    fn shift_index(&self) -> usize {
        self.state_index() + 2 + 2 * self.restarts.len()
    }

    /// Unit of the shift, periods. The response to a step at time δ contains a small part with the
    /// phase 2ωδ, which would hide the descent. Differences over π/ω do not contain it.
    fn shift_unit(&self) -> f64 {
        PI / self.mean_omega / self.period / DIFFERENCE_STEP
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
        let outputs = &self.recording.outputs;
        let state_at = |number: usize| {
            let index = self.state_index() + 2 * number;
            Complex64::new(theta[index], theta[index + 1])
        };
        let turn = Complex64::cis(self.alignment.rotation.map_or(0.0, |_| theta[self.rotation_index()]));
        let shift = self.alignment.shift.map_or(0.0, |_| theta[self.shift_index()] * self.shift_unit() * self.period);
        let shift_of = |inputs: ShiftedInputs| match self.alignment.shift {
            Some((shifted, _)) if shifted == inputs || shifted == ShiftedInputs::All => shift,
            _ => 0.0,
        };
        let (drive_shift, frequency_shift) = (shift_of(ShiftedInputs::Drive), shift_of(ShiftedInputs::Frequency));
        let delay = |touch: usize| theta.get(self.touch_index(touch)).map_or(0.0, |periods| periods * self.period);
        let at = |change: &LevelChange| change.t + change.touch.map_or(shift_of(ShiftedInputs::All), delay);
        let (mut changes, mut number) = (self.changes.iter().peekable(), self.first_conditions);
        let mut restarts = (1..).zip(&self.restarts).peekable();
        let mut now = outputs[0].t;
        let current =
            |track: &[(f64, f64)], shift: f64| track.partition_point(|(t, _)| t + shift <= now).saturating_sub(1);
        let mut driven = current(&self.drive, drive_shift);
        let mut excited = current(&self.frequency, frequency_shift);
        let w = state_at(0);
        let mut state = State { w, u: Complex64::I * self.frequency[excited].1 * w };
        let mut all = Vec::with_capacity(outputs.len());
        for (sample, output) in outputs.iter().enumerate() {
            while now < output.t {
                while let Some(change) = changes.next_if(|change| at(change) <= now) {
                    number = change.conditions;
                }
                let next_drive = self.drive.get(driven + 1).map_or(f64::INFINITY, |next| next.0 + drive_shift);
                let next_omega = self.frequency.get(excited + 1).map_or(f64::INFINITY, |next| next.0 + frequency_shift);
                let end = next_drive.min(next_omega).min(output.t);
                let end = changes.peek().map_or(end, |change| at(change).min(end));
                let drive = Drive { vpp: self.drive[driven].1, omega: self.frequency[excited].1 };
                state = Flow::new(Model::Modal, &modes[number], &drive, &state).after(end - now);
                now = end;
                driven += usize::from(next_drive <= now);
                excited += usize::from(next_omega <= now);
            }
            if let Some((restart, _)) = restarts.next_if(|(_, at)| **at == sample) {
                let w = state_at(restart);
                state = State { w, u: state.u + Complex64::I * self.frequency[excited].1 * (w - state.w) };
            }
            all.push(state.w * turn);
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

    /// Sets W at the first sample and at each restart, and the alignment.
    fn set_states(&self, theta: &mut DVector<f64>, w: impl Fn(usize) -> Complex64) {
        let turn = Complex64::cis(-self.alignment.rotation.unwrap_or(0.0));
        for (number, sample) in std::iter::once(&0).chain(&self.restarts).enumerate() {
            let (index, w) = (self.state_index() + 2 * number, w(*sample) * turn);
            (theta[index], theta[index + 1]) = (w.re, w.im);
        }
        if let Some((_, periods)) = self.alignment.shift {
            theta[self.shift_index()] = periods / self.shift_unit();
        }
        if let Some(angle) = self.alignment.rotation {
            theta[self.rotation_index()] = angle;
        }
    }

    /// Start at the parameters of `fit`.
    fn start_at(&self, fit: &DirectFit) -> DVector<f64> {
        let mut theta = DVector::zeros(self.parameter_count());
        theta[0] = fit.gain.value.ln();
        for (force, (_, tau)) in fit.time_constants.iter().enumerate() {
            theta[1 + force] = tau.value.ln();
        }
        for (number, (_, omega0)) in fit.resonances.iter().enumerate() {
            theta[self.resonance_index(number)] = (omega0.value - self.mean_omega) / OMEGA_UNIT;
        }
        self.set_states(&mut theta, |sample| fit.curve.get(sample).copied().unwrap_or_default());
        theta
    }

    fn start_vector(&self, tau: f64, detuning: f64) -> DVector<f64> {
        let mut theta = DVector::zeros(self.parameter_count());
        for force in 0..self.forces.len() {
            theta[1 + force] = tau.ln();
        }
        for number in 0..self.force_index.len() {
            theta[self.resonance_index(number)] = -detuning / OMEGA_UNIT;
        }
        self.set_states(&mut theta, |sample| self.recording.outputs[sample].w);
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
    fit_aligned(recording, Alignment::default(), None)
}

/// Fits the alignment too. Starts from the parameters of `start`, or from general start points.
pub(crate) fn fit_aligned(
    recording: &Recording,
    alignment: Alignment,
    start: Option<&DirectFit>,
) -> Result<DirectFit, RecordingError> {
    let mut layout = ParameterLayout::new(recording, alignment);
    if layout.restarts.len() > MAX_RESTARTS {
        return Err(RecordingError::Undetermined);
    }
    let count = layout.touch_index(layout.touches);
    let freedom = (2 * recording.outputs.len()).checked_sub(count).filter(|&freedom| freedom > 1);
    let freedom = freedom.ok_or(RecordingError::Undetermined)? as f64;
    let starts: Vec<DVector<f64>> = match start {
        Some(fit) => vec![layout.start_at(fit)],
        None => start_points(recording).iter().map(|(tau, detuning)| layout.start_vector(*tau, *detuning)).collect(),
    };
    let best = starts
        .into_iter()
        .filter_map(|start| minimise(&|theta| layout.residuals(theta), start))
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
    let shift = |(inputs, _): (ShiftedInputs, f64)| {
        let index = layout.shift_index();
        (inputs, Estimate::new(theta[index], error(index), freedom).scaled(layout.shift_unit()))
    };
    let rotation = |_| {
        let index = layout.rotation_index();
        let turns = (theta[index] / (2.0 * PI)).round();
        Estimate::new(theta[index] - 2.0 * PI * turns, error(index), freedom).scaled(180.0 / PI)
    };
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
        alignment: FittedAlignment {
            shift: alignment.shift.map(shift),
            rotation_deg: alignment.rotation.map(rotation),
            is_mirrored: false,
        },
        parameters: count,
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
