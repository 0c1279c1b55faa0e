//! Computes the regularised incomplete beta function of whole numbers up to those of `u32`.
//!
//! The factor before the continued fraction is a binomial probability. C. Loader, *Fast and accurate
//! computation of binomial probabilities*, 2000, computes it from deviances, because the logarithms
//! of gamma functions of large numbers cancel. The continued fraction needs about √max(a, b) terms:
//! W. Press and others, *Numerical Recipes*, 3rd ed. 2007, section 6.4.

use statrs::function::gamma::ln_gamma;
use std::f64::consts::TAU;

/// Change of the continued fraction by its last term.
const TOLERANCE: f64 = 1e-15;
/// The largest numbers need 3 × 10⁵ terms.
const MAX_TERMS: u32 = 4_000_000;
const SMALLEST: f64 = f64::MIN_POSITIVE / f64::EPSILON;

/// `I_x(a, b)` with x and 1 − x, so that both keep their digits.
pub(super) fn incomplete_beta(a: f64, b: f64, x: f64, complement: f64) -> f64 {
    if x <= 0.0 || complement <= 0.0 {
        return if x <= 0.0 { 0.0 } else { 1.0 };
    }
    if x < (a + 1.0) / (a + b + 2.0) { lower_part(a, b, x, complement) } else { 1.0 - lower_part(b, a, complement, x) }
}

fn lower_part(a: f64, b: f64, x: f64, complement: f64) -> f64 {
    // x^a (1 − x)^b / (a B(a, b))
    let factor = binomial_probability(a, b, x, complement) * b / (a + b);
    (factor * continued_fraction(a, b, x)).clamp(0.0, 1.0)
}

/// Lentz's method.
fn continued_fraction(a: f64, b: f64, x: f64) -> f64 {
    let bounded = |value: f64| if value.abs() < SMALLEST { SMALLEST } else { value };
    let mut c = 1.0;
    let mut d = bounded(1.0 - (a + b) * x / (a + 1.0)).recip();
    let mut value = d;
    for term in (1..MAX_TERMS).map(f64::from) {
        let even = a + 2.0 * term;
        let numerators =
            [term * (b - term) / (even - 1.0) * (x / even), -(a + term) / even * ((a + b + term) / (even + 1.0) * x)];
        let mut change = 1.0;
        for numerator in numerators {
            d = bounded(1.0 + numerator * d).recip();
            c = bounded(1.0 + numerator / c);
            change = c * d;
            value *= change;
        }
        if (change - 1.0).abs() < TOLERANCE {
            break;
        }
    }
    value
}

/// Probability of `a` events in `a + b` trials.
fn binomial_probability(a: f64, b: f64, x: f64, complement: f64) -> f64 {
    let count = a + b;
    let correction = stirling_error(count) - stirling_error(a) - stirling_error(b);
    let exponent = correction - deviance(a, count * x) - deviance(b, count * complement);
    exponent.exp() * (count / (TAU * a * b)).sqrt()
}

/// `ln n! − ln(√(2πn) (n/e)ⁿ)`
fn stirling_error(n: f64) -> f64 {
    if n < 16.0 {
        return ln_gamma(n + 1.0) - (n + 0.5) * n.ln() + n - 0.5 * TAU.ln();
    }
    let square = n * n;
    (1.0 / 12.0 - (1.0 / 360.0 - (1.0 / 1260.0 - (1.0 / 1680.0 - 1.0 / 1188.0 / square) / square) / square) / square)
        / n
}

/// `x ln(x/mean) + mean − x`
fn deviance(x: f64, mean: f64) -> f64 {
    let (difference, sum) = (x - mean, x + mean);
    let ratio = difference / sum;
    if ratio.abs() >= 0.1 {
        return x * (x / mean).ln() + mean - x;
    }
    let mut value = difference * ratio;
    let mut power = 2.0 * x * ratio;
    for odd in (3..1_000).step_by(2).map(f64::from) {
        power *= ratio * ratio;
        let next = value + power / odd;
        if next == value {
            break;
        }
        value = next;
    }
    value
}
