//! Gain, phase and delay margins: how far a loop is from its boundary.

use crate::closed_loop::{AnalysisError, ClosedLoop, Timing};
use crate::controller::Controller;
use crate::plant::Plant;
use platebench_plate::Complex64;
use std::f64::consts::PI;

/// Frequencies at which the loop transfer function is looked at, from the lowest to half the sampling frequency, evenly in the logarithm.
const FREQUENCIES: u32 = 400;
/// rad per period.
const LOWEST: f64 = 1e-3;
const BISECTIONS: u32 = 40;
/// The boundary over the delay is looked for in steps of this share of a period.
const SCAN: f64 = 0.05;

/// How far a loop is from instability; the worse of its two channels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Margins {
    /// Factor by which the gain of a loop may rise; below 1 it has to fall. `None` where no gain makes it unstable.
    pub gain: Option<f64>,
    /// Phase that is left where |L| = 1, degrees; `None` where |L| never is.
    pub phase_deg: Option<f64>,
}

impl ClosedLoop {
    /// Gain and phase margin on the unit circle, of the drive's and the frequency's loop each with the other closed: the smaller ones.
    ///
    /// The loops here are stable at small gain, so the boundary of a gain that rises is the outermost crossing of the negative real axis; half the sampling
    /// frequency, where L is real, counts.
    pub fn margins(&self) -> Margins {
        let mut margins = Margins { gain: None, phase_deg: None };
        let smaller = |known: Option<f64>, new: f64| Some(known.map_or(new, |known| known.min(new)));
        for kind in 0..2 {
            let Some(open) = self.opened(kind) else { continue };
            let at = |theta: f64| open(Complex64::from_polar(1.0, theta));
            for pair in grid().windows(2) {
                let [low, high] = [pair[0], pair[1]];
                let (Some(before), Some(after)) = (at(low), at(high)) else { continue };
                if before.im * after.im < 0.0
                    && let Some(crossing) = at(bisect(low, high, |theta| at(theta).map(|l| l.im)))
                    && crossing.re < 0.0
                {
                    margins.gain = smaller(margins.gain, 1.0 / crossing.norm());
                }
                if (before.norm() - 1.0) * (after.norm() - 1.0) < 0.0
                    && let Some(crossing) = at(bisect(low, high, |theta| at(theta).map(|l| l.norm() - 1.0)))
                {
                    margins.phase_deg = smaller(margins.phase_deg, (-crossing).arg().to_degrees());
                }
            }
            if let Some(end) = at(PI)
                && end.re < 0.0
            {
                margins.gain = smaller(margins.gain, 1.0 / end.norm());
            }
        }
        margins
    }
}

/// rad per period, rising, the last just below half the sampling frequency.
fn grid() -> Vec<f64> {
    let last = PI * (1.0 - 1e-9);
    let ratio = (last / LOWEST).ln();
    (0..=FREQUENCIES).map(|n| LOWEST * (ratio * f64::from(n) / f64::from(FREQUENCIES)).exp()).collect()
}

/// Where `value` changes its sign between `low` and `high`.
fn bisect(mut low: f64, mut high: f64, value: impl Fn(f64) -> Option<f64>) -> f64 {
    let sign = value(low).unwrap_or(0.0).signum();
    for _ in 0..BISECTIONS {
        let middle = f64::midpoint(low, high);
        if value(middle).unwrap_or(0.0).signum() == sign {
            low = middle;
        } else {
            high = middle;
        }
    }
    f64::midpoint(low, high)
}

/// Where a loop ends to be stable as its delay grows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DelayBoundary {
    /// Unstable without any delay.
    Never,
    /// Stable up to this delay, s.
    At(f64),
    /// Stable as far as was looked, s.
    Beyond(f64),
}

impl DelayBoundary {
    /// The boundary in s, where there is one.
    pub fn seconds(self) -> Option<f64> {
        match self {
            Self::At(seconds) => Some(seconds),
            Self::Never | Self::Beyond(_) => None,
        }
    }
}

/// The first delay at which the spectral radius reaches 1, up to `longest` s. Fractions of a period are exact, so this is the delay margin of a loop
/// without delay; what is left at a delay is the difference.
///
/// # Errors
/// As [`ClosedLoop::new`] and [`ClosedLoop::poles`].
pub fn delay_boundary(
    plant: &Plant,
    controller: &Controller,
    period: f64,
    longest: f64,
) -> Result<DelayBoundary, AnalysisError> {
    let stable = |delay: f64| {
        ClosedLoop::new(plant.clone(), *controller, Timing { period, delay })?.spectral_radius().map(|r| r < 1.0)
    };
    if !stable(0.0)? {
        return Ok(DelayBoundary::Never);
    }
    let steps = (longest / (SCAN * period)).ceil() as u32;
    let mut low = 0.0;
    for step in 1..=steps {
        let mut high = (f64::from(step) * SCAN * period).min(longest);
        if !stable(high)? {
            for _ in 0..BISECTIONS {
                let middle = f64::midpoint(low, high);
                if stable(middle)? {
                    low = middle;
                } else {
                    high = middle;
                }
            }
            return Ok(DelayBoundary::At(low));
        }
        low = high;
    }
    Ok(DelayBoundary::Beyond(longest))
}
