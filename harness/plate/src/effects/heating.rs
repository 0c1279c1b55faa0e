//! Computes the temperature rise that the plate's own vibration causes.
//!
//! The temperature rise T follows `T' = κ (R |W|² − T)`, with R in K/µm². The loss of a mode is
//! proportional to y'². Its mean over a carrier period is proportional to |W|², and 1/κ is many
//! carrier periods. While the modes are constant, W is a sum `Σ aᵢ e^{pᵢt}`, hence
//!
//! `T(t) = T e^{−κt} + κR Σᵢⱼ aᵢ āⱼ (e^{(pᵢ + p̄ⱼ)t} − e^{−κt})/(pᵢ + p̄ⱼ + κ)`.
//!
//! This W uses the modes of the middle of the step, so |W|² has a relative error of up to
//! `|λ'|h²/8`. Simpson's rule corrects it. The terms of a slow and a fast pole are a ripple of T at
//! twice the carrier. T contains it, but the parabola of ω0 over the step does not, because three
//! points cannot follow it.

use crate::effect::{ActiveEffect, Effect, PlateError, Step, check, finite};
use crate::flow::Term;
use num_complex::Complex64;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `[heating]`: the vibration warms the plate by T,
/// `time_constant_s · T' = rise_k_per_um2 · |W|² − T`. T adds to the temperature offset.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawHeating {
    /// Temperature rise in the steady state per square of the amplitude, K/µm².
    #[schemars(range(min = 0.0))]
    pub rise_k_per_um2: f64,
    /// Time constant of the temperature rise, s.
    #[schemars(range(min = 0.01))]
    pub time_constant_s: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Heating {
    pub rise_k_per_um2: f64,
    /// Rate κ, the inverse of the time constant, 1/s.
    pub rate: f64,
}

#[derive(Debug, Clone)]
struct ActiveHeating {
    heating: Heating,
    /// Temperature rise at start and end of the present step, K.
    start_k: f64,
    end_k: f64,
    /// At start, middle and end of the present step, without its ripple, K.
    rise_k: [f64; 3],
}

impl Effect for Heating {
    type Table = RawHeating;

    fn check(table: &RawHeating) -> Result<Self, PlateError> {
        const TIME_CONSTANT: &str = "heating.time_constant_s";
        const RISE: &str = "heating.rise_k_per_um2";
        let rise_k_per_um2 = finite(RISE, table.rise_k_per_um2)?;
        check(rise_k_per_um2 >= 0.0, RISE, &rise_k_per_um2, "0 or more")?;
        let seconds = finite(TIME_CONSTANT, table.time_constant_s)?;
        check(seconds >= 0.01, TIME_CONSTANT, &seconds, "at least 0.01 s, which is slow against the vibration")?;
        Ok(Self { rise_k_per_um2, rate: 1.0 / seconds })
    }

    fn key(&self) -> Option<&'static str> {
        Some("heating")
    }

    fn start(&self) -> Option<Box<dyn ActiveEffect>> {
        Some(Box::new(ActiveHeating { heating: *self, start_k: 0.0, end_k: 0.0, rise_k: [0.0; 3] }))
    }
}

impl ActiveEffect for ActiveHeating {
    fn temperature_rise_k(&self) -> [f64; 3] {
        self.rise_k
    }

    fn max_warming(&self, amplitude: f64) -> f64 {
        self.heating.rate * (self.heating.rise_k_per_um2 * amplitude * amplitude + self.rise_k[0].abs())
    }

    fn predict(&mut self, terms: &[Term], omega: f64, middle: f64, end: f64) {
        let [middle_k, end_k] = [middle, end].map(|seconds| self.heating.after(self.start_k, terms, seconds));
        let ripples = [0.0, middle, end].map(|seconds| self.heating.ripple(terms, omega, seconds));
        let [start_ripple, middle_ripple, end_ripple] = ripples;
        self.rise_k = [self.start_k - start_ripple, middle_k - middle_ripple, end_k - end_ripple];
        self.end_k = end_k;
    }

    fn correct(&mut self, [quarter, half, whole]: [f64; 3], seconds: f64) {
        let scale = self.heating.rate * self.heating.rise_k_per_um2 * seconds / 6.0;
        let end = scale * (4.0 * half + whole);
        self.rise_k[1] += scale / 2.0 * (4.0 * quarter + half);
        self.rise_k[2] += end;
        self.end_k += end;
    }

    fn finish(&mut self, _step: &Step<'_>) {
        self.start_k = self.end_k;
        self.rise_k = [self.end_k; 3];
    }
}

impl Heating {
    /// Temperature rise T after `seconds`, K. `terms` are the pairs (aᵢ, pᵢ) of W.
    fn after(&self, start_k: f64, terms: &[Term], seconds: f64) -> f64 {
        let kept = (-self.rate * seconds).exp();
        let mut sum = 0.0;
        for (index, (a, p)) in terms.iter().enumerate().filter(|(_, (a, _))| a.norm_sqr() > 0.0) {
            sum += a.norm_sqr() * self.exponential_convolution(Complex64::from(2.0 * p.re), kept, seconds).re;
            for (b, q) in terms.iter().skip(index + 1).filter(|(b, _)| b.norm_sqr() > 0.0) {
                sum += 2.0 * (a * b.conj() * self.exponential_convolution(p + q.conj(), kept, seconds)).re;
            }
        }
        start_k * kept + self.rate * self.rise_k_per_um2 * sum
    }

    /// Part of T that oscillates faster than ω after `seconds`, K.
    fn ripple(&self, terms: &[Term], omega: f64, seconds: f64) -> f64 {
        let mut sum = 0.0;
        for (index, (a, p)) in terms.iter().enumerate().filter(|(_, (a, _))| a.norm_sqr() > 0.0) {
            for (b, q) in terms.iter().skip(index + 1).filter(|(b, _)| b.norm_sqr() > 0.0) {
                let pole = p + q.conj();
                if pole.im.abs() > omega.abs() {
                    sum += 2.0 * (a * b.conj() * (pole * seconds).exp() / (pole + self.rate)).re;
                }
            }
        }
        self.rate * self.rise_k_per_um2 * sum
    }

    /// `∫ e^{−κ(t−s)} e^{ps} ds` from 0 to t.
    fn exponential_convolution(&self, pole: Complex64, kept: f64, seconds: f64) -> Complex64 {
        let sum = pole + self.rate;
        let x = sum * seconds;
        if x.norm_sqr() < 1e-6 {
            // The quotient below loses digits for small x. This series omits terms from x⁴/120 on.
            seconds * kept * (((x / 24.0 + 1.0 / 6.0) * x + 0.5) * x + 1.0)
        } else {
            ((pole * seconds).exp() - kept) / sum
        }
    }
}
