//! Two PI loops as the paper draws them, without anything that a firmware has around them, on the exact plate.
//!
//! No limit of drive, frequency or ratio, no rest at small amplitudes, no anti-windup: `V` from `Wd_ref − Wd`, ω from `Wq/Wd`. The loops are linear, the ratio
//! is not: far from the resonance a loop of small spectral radius need not find it (see [`Found`]).

use crate::case::Condition;
use crate::closed_loop::{AnalysisError, ClosedLoop, Timing};
use crate::controller::{Channel, Controller, Integral, Pi};
use crate::plant::Plant;
use platebench_plate::{Complex64, Drive, Flow, Plate, State, Tier};

/// Half the band of the settling time.
const BAND: f64 = 0.05;
/// Beyond this many setpoints it is a divergence.
const DIVERGED: f64 = 1e6;

/// Two loops in f64.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlainLoops {
    /// Drive from the error of Wd, Vpp per µm.
    pub amplitude: Pi,
    /// Excitation from Wq/Wd, rad/s.
    pub frequency: Pi,
    /// Control period, s.
    pub period: f64,
}

/// How a start from rest went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Found {
    /// First control instant from which |W| stays within 5 % of the setpoint, s; `None` where there is none.
    pub settled: Option<f64>,
    /// Largest and smallest |W|/setpoint in the last quarter.
    pub range: [f64; 2],
    /// ω − ω0 at the end, rad/s.
    pub detuning: f64,
    /// True where W grew without end or the excitation ran away from the resonance by as much as that is.
    pub diverged: bool,
}

impl PlainLoops {
    /// Equation 24 as printed for the untouched plate, `response` in s (2 ms in the paper).
    pub fn as_printed(plate: &Plate, integral: Integral, response: f64, period: f64) -> Self {
        let tau = 1.0 / plate.sigma0;
        let [amplitude, frequency] =
            [plate.gain, tau].map(|gain| Pi::as_printed(integral, gain, tau, response, period));
        Self { amplitude, frequency, period }
    }

    /// The loops around their steady state under `condition`, on the envelope and without delay.
    ///
    /// # Errors
    /// As [`ClosedLoop::new`].
    pub fn linear(&self, plate: &Plate, condition: Condition, setpoint: f64) -> Result<ClosedLoop, AnalysisError> {
        let mode = plate.mode(&condition.surroundings());
        let drive = Drive { vpp: mode.drive_for(setpoint), omega: mode.omega0 };
        let controller = Controller {
            drive: Some(Channel { pi: self.amplitude, error: [-1.0, 0.0] }),
            frequency: Some(Channel { pi: self.frequency, error: [0.0, 1.0 / setpoint] }),
            feedforward: 0.0,
        };
        let timing = Timing { period: self.period, delay: 0.0 };
        ClosedLoop::new(Plant::around(Tier::Envelope, &mode, &drive), controller, timing)
    }

    /// A start from rest towards `setpoint` µm over `periods`, without delay.
    pub fn start(&self, plate: &Plate, condition: Condition, setpoint: f64, periods: u32) -> Found {
        let mode = plate.mode(&condition.surroundings());
        let start = condition.start(plate);
        let (mut state, mut integrals) = (State::default(), [0.0; 2]);
        let mut found = Found { settled: None, range: [f64::INFINITY, 0.0], detuning: 0.0, diverged: false };
        for number in 0..periods {
            let Complex64 { re: wd, im: wq } = state.w;
            let share = state.w.norm() / setpoint;
            let inside = (share - 1.0).abs() <= BAND;
            found.settled = inside.then(|| found.settled.unwrap_or(f64::from(number) * self.period));
            if number >= periods - periods / 4 {
                found.range = [found.range[0].min(share), found.range[1].max(share)];
            }
            // At rest there is no ratio.
            let ratio = if wd == 0.0 { 0.0 } else { wq / wd };
            let mut outputs = [0.0; 2];
            let loops = [(self.amplitude, setpoint - wd), (self.frequency, ratio)];
            for ((output, integral), (pi, error)) in outputs.iter_mut().zip(&mut integrals).zip(loops) {
                *output = pi.proportional * error + *integral;
                *integral += pi.integral_per_period * error;
            }
            let omega = start + outputs[1];
            found.detuning = omega - mode.omega0;
            // An excitation below 0 or as far above the resonance has nothing to do with it any more.
            let lost = !(share < DIVERGED && found.detuning.abs() < mode.omega0);
            if lost {
                return Found { settled: None, diverged: true, ..found };
            }
            let drive = Drive { vpp: outputs[0], omega };
            state = Flow::new(Tier::Modal, &mode, &drive, &state).after(self.period);
        }
        found
    }
}
