//! A step of the setpoint, played by the linear loop: settling, overshoot, drive.

use crate::closed_loop::ClosedLoop;
use nalgebra::Vector2;
use platebench_plate::Complex64;
use std::collections::VecDeque;

/// Points per period at which the response is read.
const POINTS: u32 = 40;
/// Half the band of the settling time.
const BAND: f64 = 0.05;
/// A response that grows beyond this many setpoints is a divergence.
const DIVERGED: f64 = 1e3;

/// What a setpoint step from rest looks like. No limit acts: of drive, range or slew.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepResponse {
    /// 5 % settling time in s; `None` where the response was not inside by the end of the horizon.
    pub settling: Option<f64>,
    /// Overshoot as a share of the step.
    pub overshoot: f64,
    /// Highest drive, Vpp.
    pub peak_drive: f64,
    /// True where it grew without end.
    pub diverged: bool,
}

impl ClosedLoop {
    /// The response of W, along the phase of its steady state, to a setpoint step from 0 to `setpoint` µm at the first control instant, over `periods`.
    ///
    /// The loop is linear in the amplitude at resonance, so that from rest it is exact there; detuned or with a frequency loop that has to find the
    /// resonance first it is the response to a small step, scaled.
    pub fn step(&self, setpoint: f64, periods: u32) -> StepResponse {
        let [direct, integral] = self.controller.matrices();
        let along = self.along();
        // A higher setpoint is to the loops what a deviation the other way is.
        let wished = -Vector2::from(along) * setpoint;
        let (whole, rest) = self.timing.split();
        let mut states = vec![Complex64::ZERO; self.plant.poles().len()];
        let mut commands: VecDeque<Vector2<f64>> = vec![Vector2::zeros(); whole + 2].into();
        let mut integrals = Vector2::zeros();
        let mut response = StepResponse { settling: None, overshoot: 0.0, peak_drive: 0.0, diverged: false };
        let (mut before, mut entered) = (0.0_f64, None);
        for period in 0..periods {
            let w: Complex64 = states.iter().sum();
            let seen = Vector2::new(w.re, w.im) + wished;
            let mut command: Vector2<f64> = direct * seen + integrals;
            command.x += self.controller.feedforward * setpoint;
            integrals += integral * seen;
            response.peak_drive = response.peak_drive.max(command.x);
            commands.push_front(command);
            commands.truncate(whole + 2);
            let [late, now] = [whole + 1, whole].map(|age| commands.get(age).copied().unwrap_or_default());
            for (command, span, from) in [(late, rest, 0.0), (now, self.timing.period - rest, rest)] {
                let start = states.clone();
                for point in 1..=POINTS {
                    let seconds = span * f64::from(point) / f64::from(POINTS);
                    if seconds == 0.0 {
                        continue;
                    }
                    for ((state, start), pole) in states.iter_mut().zip(&start).zip(self.plant.poles()) {
                        let [drive, frequency] = pole.pushes(seconds);
                        *state = pole.growth(seconds) * start + drive * command.x + frequency * command.y;
                    }
                    let w: Complex64 = states.iter().sum();
                    let share = (w.re * along[0] + w.im * along[1]) / setpoint;
                    response.overshoot = response.overshoot.max(share - 1.0);
                    let (was, is) = ((before - 1.0).abs() <= BAND, (share - 1.0).abs() <= BAND);
                    if is && !was {
                        // Where the straight line between both points crosses the edge.
                        let edge = if before < 1.0 { 1.0 - BAND } else { 1.0 + BAND };
                        let part = ((edge - before) / (share - before)).clamp(0.0, 1.0);
                        let step = span / f64::from(POINTS);
                        entered = Some(f64::from(period) * self.timing.period + from + seconds - step * (1.0 - part));
                    } else if !is {
                        entered = None;
                    }
                    before = share;
                }
            }
            if !before.is_finite() || before.abs() > DIVERGED {
                return StepResponse { settling: None, diverged: true, ..response };
            }
        }
        StepResponse { settling: entered, ..response }
    }

    /// The direction of W0, of Wd where the plate rests.
    fn along(&self) -> [f64; 2] {
        let at = self.plant.at();
        let size = at.norm();
        if size > 0.0 { [at.re / size, at.im / size] } else { [1.0, 0.0] }
    }
}
