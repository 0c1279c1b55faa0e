//! Fits a second mode or self-heating to a recording that one mode does not explain.
//!
//! A second mode has the same drive, and W is the sum of both modes. Self-heating gives the
//! resonance `ω0 + s T` with `T' = (|W|² − T)/τ_h`, T in µm² and 0 at the first sample. Each
//! interval between samples or inputs uses the resonance at its middle.

use crate::identify::estimate::{EffectFit, Estimate, IdentifiedHeating, IdentifiedSecondMode, WhitenessTest};
use crate::identify::fit::{DirectFit, FittedAlignment, OMEGA_UNIT, covariance_of, minimise};
use nalgebra::{DMatrix, DVector};
use platebench_model::recording::Recording;
use platebench_plate::{Complex64, Drive, Flow, Mode, Model, State};
use std::f64::consts::TAU;

/// Longest interval of the model. In longer ones |W|² and T are not nearly linear.
const LONGEST_PIECE_S: f64 = 1e-3;
/// Unit of the parameter s of self-heating, rad/s per µm².
const SHIFT_UNIT: f64 = 10.0;
/// Start values of the distance of the second mode, as a fraction of the sampling rate. A mode
/// further than half the sampling rate from the excitation has the samples of a nearer one.
const SECOND_MODE_DISTANCES: [f64; 10] = [-0.42, -0.3, -0.2, -0.12, -0.06, 0.06, 0.12, 0.2, 0.3, 0.42];
const MAX_DISTANCE_FROM_EXCITATION: f64 = 0.5;
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
                let distances = SECOND_MODE_DISTANCES.iter();
                let place = |distance: &f64| {
                    let at = parameter + TAU * distance / self.recording.period() / OMEGA_UNIT;
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

    /// True if one of the modes is so far from the excitation that it is an alias of a nearer one.
    fn is_alias(&self, theta: &DVector<f64>) -> bool {
        let farthest = MAX_DISTANCE_FROM_EXCITATION * TAU / self.recording.period();
        let is_far = |parameter: f64| {
            let distances = self.recording.inputs.iter().map(|input| (self.omega(parameter) - input.omega).abs());
            distances.fold(f64::INFINITY, f64::min) > farthest
        };
        self.kind == EffectKind::SecondMode && (is_far(theta[2]) || is_far(theta[6]))
    }

    fn fit(&self, one_mode: &DirectFit) -> Option<DirectFit> {
        let samples = 2 * self.recording.outputs.len();
        let residuals = |theta: &DVector<f64>| self.residuals(theta);
        let found = self.start_points(one_mode)?.into_iter().filter_map(|start| minimise(&residuals, start));
        let found = found.filter(|(theta, _)| !self.is_alias(theta));
        let (theta, squares) = found.min_by(|a, b| a.1.total_cmp(&b.1))?;
        let (theta, squares) = match self.exchange_modes(&theta) {
            Some(exchanged) => minimise(&residuals, exchanged)?,
            None => (theta, squares),
        };
        if self.is_alias(&theta) {
            return None;
        }
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
            alignment: FittedAlignment::default(),
            parameters: theta.len(),
        })
    }
}

/// Fits a second mode and self-heating, and returns the fit with the smaller residuals that
/// `is_explained` accepts. `None` if it accepts none, if temperature or force changes, or if inputs
/// are unknown.
pub(crate) fn fit_effect(
    recording: &Recording,
    one_mode: &DirectFit,
    is_explained: impl Fn(&DirectFit) -> bool,
) -> Option<DirectFit> {
    if recording.conditions.len() != 1 || !recording.samples_after_unknown_inputs().is_empty() {
        return None;
    }
    let mean_omega = recording.inputs.iter().map(|input| input.omega).sum::<f64>() / recording.inputs.len() as f64;
    let kinds = [EffectKind::Heating, EffectKind::SecondMode];
    let fits = kinds.into_iter().filter_map(|kind| EffectModel { recording, kind, mean_omega }.fit(one_mode));
    fits.filter(is_explained).min_by(|a, b| a.noise_um.total_cmp(&b.noise_um))
}
