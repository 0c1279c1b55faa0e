//! Computes gain, phase and delay margins.

use crate::loops::closed_loop::{AnalysisError, ClosedLoop, LoopTiming};
use crate::loops::controller::LinearController;
use crate::loops::plant::LinearPlant;
use platebench_engine::delay_boundary::DelayBoundary;
use platebench_plate::Complex64;
use platebench_verdict::bisection::{bisect, try_bisect};
use std::f64::consts::PI;

const FREQUENCIES: u32 = 400;
const LOWEST_FREQUENCY: f64 = 1e-3;
const BISECTIONS: u32 = 40;
/// Step of the scan over delays, as a share of a period.
const SCAN_STEP: f64 = 0.05;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StabilityMargins {
    /// Factor by which the gain may rise. Below 1 the gain must fall. `None` if it has no limit.
    pub gain: Option<f64>,
    /// Phase margin at |L| = 1. `None` if |L| is never 1.
    pub phase_deg: Option<f64>,
}

impl ClosedLoop {
    /// The smaller margin of both loops, each with the other loop closed. These loops are stable at
    /// small gain. A rising gain first meets the outermost crossing of the negative real axis, or L
    /// at half the sampling frequency.
    pub fn margins(&self) -> StabilityMargins {
        let mut margins = StabilityMargins { gain: None, phase_deg: None };
        let smaller = |known: Option<f64>, new: f64| Some(known.map_or(new, |known| known.min(new)));
        for kind in 0..2 {
            let Some(open) = self.open_loop_transfer(kind) else { continue };
            let at = |theta: f64| open(Complex64::from_polar(1.0, theta));
            for &[low, high] in frequency_grid().array_windows() {
                let (Some(before), Some(after)) = (at(low), at(high)) else { continue };
                if before.im * after.im < 0.0
                    && let Some(crossing) = at(root(low, high, |theta| at(theta).map(|l| l.im)))
                    && crossing.re < 0.0
                {
                    margins.gain = smaller(margins.gain, 1.0 / crossing.norm());
                }
                if (before.norm() - 1.0) * (after.norm() - 1.0) < 0.0
                    && let Some(crossing) = at(root(low, high, |theta| at(theta).map(|l| l.norm() - 1.0)))
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

/// Rising frequencies, rad per period, up to just below half the sampling frequency.
fn frequency_grid() -> Vec<f64> {
    let last = PI * (1.0 - 1e-9);
    let ratio = (last / LOWEST_FREQUENCY).ln();
    (0..=FREQUENCIES).map(|n| LOWEST_FREQUENCY * (ratio * f64::from(n) / f64::from(FREQUENCIES)).exp()).collect()
}

fn root(low: f64, high: f64, value: impl Fn(f64) -> Option<f64>) -> f64 {
    let sign = |at: f64| value(at).unwrap_or(0.0).signum();
    let first = sign(low);
    let [low, high] = bisect([low, high], BISECTIONS, |at| sign(at) == first);
    f64::midpoint(low, high)
}

/// First delay, up to `longest` s, at which the spectral radius reaches 1.
pub fn delay_boundary(
    plant: &LinearPlant,
    controller: &LinearController,
    period: f64,
    longest: f64,
) -> Result<DelayBoundary, AnalysisError> {
    let stable = |delay: f64| {
        ClosedLoop::new(plant.clone(), *controller, LoopTiming { period, delay })?.spectral_radius().map(|r| r < 1.0)
    };
    if !stable(0.0)? {
        return Ok(DelayBoundary::Unstable);
    }
    let steps = (longest / (SCAN_STEP * period)).ceil() as u32;
    let mut low = 0.0;
    for step in 1..=steps {
        let high = (f64::from(step) * SCAN_STEP * period).min(longest);
        if !stable(high)? {
            return Ok(DelayBoundary::At(try_bisect([low, high], BISECTIONS, stable)?[0]));
        }
        low = high;
    }
    Ok(DelayBoundary::Beyond(longest))
}
