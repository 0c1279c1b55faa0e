//! Simulates a setpoint step of the linear loop: settling, overshoot, drive.

use crate::loops::closed_loop::ClosedLoop;
use nalgebra::Vector2;
use platebench_plate::Complex64;
use std::collections::VecDeque;

const POINTS_PER_PERIOD: u32 = 40;
const BAND: f64 = 0.05;
/// |W| above this many setpoints counts as divergence.
const DIVERGENCE_LIMIT: f64 = 1e3;

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StepResponse {
    /// 5 % settling time, s. `None` if the response is outside the band at its end.
    pub settling: Option<f64>,
    /// Overshoot as a share of the step.
    pub overshoot: f64,
    pub peak_drive: f64,
    /// Number of periods at the drive limit. It is 0 in the linear loop, which has no limits.
    pub saturated_periods: u32,
    pub diverged: bool,
}

impl ClosedLoop {
    /// Steps the setpoint from rest to `setpoint` µm without limits. The response is W's component
    /// along the phase of the steady state. It is exact at resonance. Off resonance it is the
    /// scaled response to a small step.
    pub fn step_response(&self, setpoint: f64, periods: u32) -> StepResponse {
        let [direct, integral] = self.controller.matrices();
        let along = self.output_direction();
        // A higher setpoint acts like a negative deviation of W.
        let setpoint_deviation = -Vector2::from(along) * setpoint;
        let (whole, rest) = self.timing.split_delay();
        let mut states = vec![Complex64::ZERO; self.plant.poles().len()];
        let mut commands: VecDeque<Vector2<f64>> = vec![Vector2::zeros(); whole + 2].into();
        let mut integrals = Vector2::zeros();
        let mut response = StepResponse::default();
        let (mut before, mut entered) = (0.0_f64, None);
        for period in 0..periods {
            let w: Complex64 = states.iter().sum();
            let deviation = Vector2::new(w.re, w.im) + setpoint_deviation;
            let mut command: Vector2<f64> = direct * deviation + integrals;
            command.x += self.controller.feedforward * setpoint;
            integrals += integral * deviation;
            response.peak_drive = response.peak_drive.max(command.x);
            commands.push_front(command);
            commands.truncate(whole + 2);
            let [late, now] = [whole + 1, whole].map(|age| commands.get(age).copied().unwrap_or_default());
            for (command, span, from) in [(late, rest, 0.0), (now, self.timing.period - rest, rest)] {
                let start = states.clone();
                for point in 1..=POINTS_PER_PERIOD {
                    let seconds = span * f64::from(point) / f64::from(POINTS_PER_PERIOD);
                    if seconds == 0.0 {
                        continue;
                    }
                    for ((state, start), pole) in states.iter_mut().zip(&start).zip(self.plant.poles()) {
                        let [drive, frequency] = pole.input_effects(seconds);
                        *state = pole.transition(seconds) * start + drive * command.x + frequency * command.y;
                    }
                    let w: Complex64 = states.iter().sum();
                    let share = (w.re * along[0] + w.im * along[1]) / setpoint;
                    response.overshoot = response.overshoot.max(share - 1.0);
                    let (was, is) = ((before - 1.0).abs() <= BAND, (share - 1.0).abs() <= BAND);
                    if is && !was {
                        let edge = if before < 1.0 { 1.0 - BAND } else { 1.0 + BAND };
                        let part = ((edge - before) / (share - before)).clamp(0.0, 1.0);
                        let step = span / f64::from(POINTS_PER_PERIOD);
                        entered = Some(f64::from(period) * self.timing.period + from + seconds - step * (1.0 - part));
                    } else if !is {
                        entered = None;
                    }
                    before = share;
                }
            }
            if !before.is_finite() || before.abs() > DIVERGENCE_LIMIT {
                return StepResponse { settling: None, diverged: true, ..response };
            }
        }
        StepResponse { settling: entered, ..response }
    }

    fn output_direction(&self) -> [f64; 2] {
        let at = self.plant.at();
        let size = at.norm();
        if size > 0.0 { [at.re / size, at.im / size] } else { [1.0, 0.0] }
    }
}
