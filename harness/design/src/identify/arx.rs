//! Fits ARX models of order one at the control period (paper, section IV.B and reference \[24\]).
//!
//! The model is `y[k+1] = a y[k] + Σ c_i u_i[k] + e[k]`, so `τ = −Ts / ln a`, and a static gain is
//! `c / (1 − a)`. Least squares assume that `y[k]` is exact, so noise makes `a` and τ too small for
//! any number of samples. Instrumental variables (T. Söderström, P. Stoica, *System
//! Identification*, 1989, chapter 8) use the noise-free response of an auxiliary model in three
//! iterations and are consistent. Their intervals allow for the colour of the error
//! `e[k] = v[k+1] − a v[k]` of white noise v.

use crate::identify::estimate::Estimate;
use nalgebra::{DMatrix, DVector};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ArxMethod {
    LeastSquares,
    InstrumentalVariables,
}

#[derive(Debug, Clone, PartialEq)]
pub struct ArxModel {
    /// Time constant τ, s.
    pub time_constant: Estimate,
    pub gains: Vec<Estimate>,
}

/// Samples are `period` s apart, and inputs are constant between them. `None` if there are too few
/// samples, the inputs are linearly dependent, or `a` is not between 0 and 1.
pub fn arx(y: &[f64], inputs: &[Vec<f64>], period: f64, method: ArxMethod) -> Option<ArxModel> {
    let (rows, width) = (y.len().checked_sub(1)?, inputs.len() + 1);
    let freedom = rows.checked_sub(width).filter(|&freedom| freedom > 0)? as f64;
    let with = |states: &[f64]| {
        DMatrix::from_fn(rows, width, |row, column| match column.checked_sub(1) {
            None => states.get(row).copied().unwrap_or(0.0),
            Some(input) => inputs.get(input).and_then(|values| values.get(row)).copied().unwrap_or(0.0),
        })
    };
    let (regressors, target) = (with(y), DVector::from_iterator(rows, y.iter().skip(1).copied()));
    let mut instruments = regressors.clone();
    let mut theta = solve(&instruments, &regressors, &target)?;
    if method == ArxMethod::InstrumentalVariables {
        for _ in 0..3 {
            instruments = with(&response(&theta, inputs, y.len())?);
            theta = solve(&instruments, &regressors, &target)?;
        }
    }
    let a = theta.get(0).copied().filter(|a| (1e-3..0.9999).contains(a))?;
    let residuals = &target - &regressors * &theta;
    let power = residuals.norm_squared() / freedom;
    let inverse = (instruments.transpose() * &regressors).try_inverse()?;
    let middle = match method {
        ArxMethod::LeastSquares => instruments.transpose() * &instruments * power,
        ArxMethod::InstrumentalVariables => {
            // E[e eᵀ]: (1 + a²)σ² on the diagonal, −aσ² next to it; σ² is the power of v.
            let noise = power / (1.0 + a * a);
            let mut coloured = &instruments * power;
            for row in 1..rows {
                for column in 0..width {
                    coloured[(row, column)] -= a * noise * instruments[(row - 1, column)];
                    coloured[(row - 1, column)] -= a * noise * instruments[(row, column)];
                }
            }
            instruments.transpose() * coloured
        }
    };
    let covariance = &inverse * middle * inverse.transpose();
    let error = |gradient: DVector<f64>| (gradient.transpose() * &covariance * &gradient).sum().max(0.0).sqrt();
    let gradient = |entries: &[(usize, f64)]| {
        let mut gradient = DVector::zeros(width);
        for &(index, value) in entries {
            gradient[index] = value;
        }
        gradient
    };
    let slope = period / (a * a.ln().powi(2));
    let gain = |(index, &c): (usize, &f64)| {
        let direction = gradient(&[(0, c / (1.0 - a).powi(2)), (index, 1.0 / (1.0 - a))]);
        Estimate::new(c / (1.0 - a), error(direction), freedom)
    };
    Some(ArxModel {
        time_constant: Estimate::new(-period / a.ln(), error(gradient(&[(0, slope)])), freedom),
        gains: theta.iter().enumerate().skip(1).map(gain).collect(),
    })
}

fn solve(instruments: &DMatrix<f64>, regressors: &DMatrix<f64>, target: &DVector<f64>) -> Option<DVector<f64>> {
    let theta = (instruments.transpose() * regressors).lu().solve(&(instruments.transpose() * target))?;
    theta.iter().all(|value| value.is_finite()).then_some(theta)
}

/// Response of the model, which starts in the steady state of the first inputs. `None` if the model
/// is unstable.
fn response(theta: &DVector<f64>, inputs: &[Vec<f64>], length: usize) -> Option<Vec<f64>> {
    let a = theta.get(0).copied().filter(|a| a.abs() < 1.0)?;
    let forced = |k: usize| -> f64 {
        let terms = theta.iter().skip(1).zip(inputs).map(|(c, input)| c * input.get(k).copied().unwrap_or(0.0));
        terms.sum()
    };
    let mut x = forced(0) / (1.0 - a);
    let mut all = Vec::with_capacity(length);
    for k in 0..length {
        all.push(x);
        x = a * x + forced(k);
    }
    Some(all)
}
