//! Computes the temperature rise that the plate's own vibration causes.
//!
//! The temperature rise T follows `T' = κ (R |W|² − T)`, with R in K/µm². The loss of a mode is
//! proportional to y'². Its mean over a carrier period is proportional to |W|², and 1/κ is many
//! carrier periods. While the modes are constant, W is a sum `Σ aᵢ e^{pᵢt}`, hence
//!
//! `T(t) = T e^{−κt} + κR Σᵢⱼ aᵢ āⱼ (e^{(pᵢ + p̄ⱼ)t} − e^{−κt})/(pᵢ + p̄ⱼ + κ)`.

use crate::plate_error::{PlateError, check, finite};
use crate::raw_plate::RawHeating;
use num_complex::Complex64;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Heating {
    pub rise_k_per_um2: f64,
    /// Rate κ, the inverse of the time constant, 1/s.
    pub rate: f64,
}

impl Heating {
    pub(crate) fn check(raw: &RawHeating) -> Result<Self, PlateError> {
        const TIME_CONSTANT: &str = "heating.time_constant_s";
        const RISE: &str = "heating.rise_k_per_um2";
        let rise_k_per_um2 = finite(RISE, raw.rise_k_per_um2)?;
        check(rise_k_per_um2 >= 0.0, RISE, &rise_k_per_um2, "0 or more")?;
        let seconds = finite(TIME_CONSTANT, raw.time_constant_s)?;
        check(seconds >= 0.01, TIME_CONSTANT, &seconds, "at least 0.01 s, which is slow against the vibration")?;
        Ok(Self { rise_k_per_um2, rate: 1.0 / seconds })
    }

    /// Temperature rise T after `seconds`, K. `terms` are the pairs (aᵢ, pᵢ) of W.
    pub(crate) fn after(&self, start_k: f64, terms: &[(Complex64, Complex64)], seconds: f64) -> f64 {
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
