//! Simulates the two PI loops of the paper's block diagram on the exact plate. `V` follows from
//! `Wd_ref − Wd` and ω from `Wq/Wd`, without limits, guard for small amplitudes and anti-windup.
//! The ratio `Wq/Wd` is not linear. Far from the resonance a loop with a small spectral radius may
//! diverge.

use crate::loops::case::OperatingCondition;
use crate::loops::closed_loop::{AnalysisError, ClosedLoop, LoopTiming};
use crate::loops::controller::{Discretisation, LinearController, LoopChannel, PiGains};
use crate::loops::plant::LinearPlant;
use platebench_plate::{Complex64, Drive, Flow, Plate, State, Tier};

const BAND: f64 = 0.05;
/// |W| above this many setpoints counts as divergence.
const DIVERGENCE_LIMIT: f64 = 1e6;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlainLoops {
    /// PI from the error of Wd to the drive, Vpp per µm.
    pub amplitude: PiGains,
    /// PI from Wq/Wd to the excitation frequency, rad/s.
    pub frequency: PiGains,
    pub period: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StartResult {
    /// First control instant from which |W| stays within 5 % of the setpoint, s.
    pub settled: Option<f64>,
    /// Smallest and largest |W|/setpoint in the last quarter of the start.
    pub range: [f64; 2],
    /// ω − ω0 at the end, rad/s.
    pub detuning: f64,
    /// True if W diverged or the detuning reached the resonance frequency.
    pub diverged: bool,
}

impl PlainLoops {
    /// Gains by equation 24 for the untouched plate. `response` is in s (2 ms in the paper).
    pub fn new(plate: &Plate, discretisation: Discretisation, response: f64, period: f64) -> Self {
        let tau = 1.0 / plate.sigma0;
        let [amplitude, frequency] = [plate.gain, tau].map(|gain| discretisation.gains(gain, tau, response, period));
        Self { amplitude, frequency, period }
    }

    /// Linearises around the steady state under `condition`, on the envelope and without delay.
    pub fn linearise(
        &self,
        plate: &Plate,
        condition: OperatingCondition,
        setpoint: f64,
    ) -> Result<ClosedLoop, AnalysisError> {
        let mode = plate.mode(&condition.conditions());
        let drive = Drive { vpp: mode.drive_for(setpoint), omega: mode.omega0 };
        let controller = LinearController {
            drive: Some(LoopChannel { pi: self.amplitude, error_weights: [-1.0, 0.0] }),
            frequency: Some(LoopChannel { pi: self.frequency, error_weights: [0.0, 1.0 / setpoint] }),
            feedforward: 0.0,
        };
        let timing = LoopTiming { period: self.period, delay: 0.0 };
        ClosedLoop::new(LinearPlant::linearised_at(Tier::Envelope, &mode, &drive), controller, timing)
    }

    /// Starts from rest towards `setpoint` µm, without delay.
    pub fn simulate_start(
        &self,
        plate: &Plate,
        condition: OperatingCondition,
        setpoint: f64,
        periods: u32,
    ) -> StartResult {
        let mode = plate.mode(&condition.conditions());
        let start = condition.start_omega(plate);
        let (mut state, mut integrals) = (State::default(), [0.0; 2]);
        let mut result = StartResult { settled: None, range: [f64::INFINITY, 0.0], detuning: 0.0, diverged: false };
        for number in 0..periods {
            let Complex64 { re: wd, im: wq } = state.w;
            let share = state.w.norm() / setpoint;
            let inside = (share - 1.0).abs() <= BAND;
            result.settled = inside.then(|| result.settled.unwrap_or(f64::from(number) * self.period));
            if number >= periods - periods / 4 {
                result.range = [result.range[0].min(share), result.range[1].max(share)];
            }
            let ratio = if wd == 0.0 { 0.0 } else { wq / wd };
            let mut outputs = [0.0; 2];
            let loops = [(self.amplitude, setpoint - wd), (self.frequency, ratio)];
            for ((output, integral), (pi, error)) in outputs.iter_mut().zip(&mut integrals).zip(loops) {
                *output = pi.proportional * error + *integral;
                *integral += pi.integral_per_period * error;
            }
            let omega = start + outputs[1];
            result.detuning = omega - mode.omega0;
            let lost = !(share < DIVERGENCE_LIMIT && result.detuning.abs() < mode.omega0);
            if lost {
                return StartResult { settled: None, diverged: true, ..result };
            }
            let drive = Drive { vpp: outputs[0], omega };
            state = Flow::new(Tier::Modal, &mode, &drive, &state).after(self.period);
        }
        result
    }
}
