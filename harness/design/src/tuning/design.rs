//! Designs gains by equation 24 of the paper in three discretisations.

use crate::loops::closed_loop::{AnalysisError, ClosedLoop, LoopTiming};
use crate::loops::controller::{Discretisation, LinearController, LoopChannel, PiGains};
use crate::loops::plant::LinearPlant;
use platebench_plate::{Conditions, Drive, Mode, Plate, Tier};
use platebench_wire::Gains;

/// The horizon is the simulated time of a step. It is the longest of these numbers of periods,
/// response times and time constants, plus the delays.
const HORIZON_PERIODS: f64 = 60.0;
const HORIZON_RESPONSES: f64 = 6.0;
const HORIZON_TIME_CONSTANTS: f64 = 20.0;
const HORIZON_DELAYS: f64 = 20.0;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TuningTarget<'a> {
    pub plate: &'a Plate,
    pub force_n: f64,
    /// Setpoint, µm, above 0.
    pub setpoint: f64,
    /// 5 % response time of |W|, s, above 0.
    pub response: f64,
    /// Control period, µs, above 0.
    pub period_us: u32,
    /// Delay from sampling to actuation, s.
    pub delay: f64,
    /// Smallest allowed phase margin of each loop, degrees.
    pub phase_margin_deg: f64,
}

impl TuningTarget<'_> {
    pub fn period(&self) -> f64 {
        f64::from(self.period_us) * 1e-6
    }

    pub fn mode(&self) -> Mode {
        self.plate.mode(&Conditions { temperature_offset_k: 0.0, finger_force_n: self.force_n })
    }

    /// Shortest time, s, from rest into the band with the drive limit. `None` if out of reach.
    pub fn time_floor(&self) -> Option<f64> {
        self.mode().min_rise_time(self.setpoint, 0.95, self.plate.drive_limit_vpp)
    }

    pub fn horizon(&self) -> u32 {
        let slowest = (HORIZON_RESPONSES * self.response).max(HORIZON_TIME_CONSTANTS / self.mode().sigma);
        let seconds = (HORIZON_PERIODS * self.period()).max(slowest) + HORIZON_DELAYS * self.delay;
        (seconds / self.period()).ceil() as u32
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GainDesign {
    pub discretisation: Discretisation,
    pub response: f64,
    /// PI from the error of Wd to the drive, Vpp per µm.
    pub amplitude: PiGains,
    /// PI from Wq/Wd to the excitation frequency, rad/s.
    pub frequency: PiGains,
}

impl GainDesign {
    /// Gains by equation 24 under the target's finger. For the amplitude K = b/σ, for the frequency
    /// K = τ, for both τ = 1/σ.
    pub fn new(target: &TuningTarget<'_>, discretisation: Discretisation, response: f64) -> Self {
        let mode = target.mode();
        let tau = 1.0 / mode.sigma;
        let [amplitude, frequency] =
            [mode.envelope_constant * tau, tau].map(|gain| discretisation.gains(gain, tau, response, target.period()));
        Self { discretisation, response, amplitude, frequency }
    }

    /// Gains for the firmware's forward-Euler integral. `period` is in s.
    pub fn firmware_gains(&self, period: f64) -> Gains {
        let Self { amplitude, frequency, .. } = self;
        Gains {
            amplitude_kp: amplitude.proportional as f32,
            amplitude_ki: (amplitude.integral_per_period / period) as f32,
            frequency_kp: frequency.proportional as f32,
            frequency_ki: (frequency.integral_per_period / period) as f32,
        }
    }

    /// `which` selects the closed loops (drive, frequency). The target's finger presses `plate`.
    pub fn closed_loop(
        &self,
        target: &TuningTarget<'_>,
        plate: &Plate,
        tier: Tier,
        which: [bool; 2],
    ) -> Result<ClosedLoop, AnalysisError> {
        let (plant, controller) = self.linear_parts(&TuningTarget { plate, ..*target }, tier, which);
        ClosedLoop::new(plant, controller, LoopTiming { period: target.period(), delay: target.delay })
    }

    pub(crate) fn linear_parts(
        &self,
        target: &TuningTarget<'_>,
        tier: Tier,
        [drive, frequency]: [bool; 2],
    ) -> (LinearPlant, LinearController) {
        let mode = target.mode();
        let steady = Drive { vpp: mode.drive_for(target.setpoint), omega: mode.omega0 };
        let plant = LinearPlant::linearised_at(tier, &mode, &steady);
        let controller = LinearController {
            drive: drive.then_some(LoopChannel { pi: self.amplitude, error_weights: [-1.0, 0.0] }),
            frequency: frequency
                .then_some(LoopChannel { pi: self.frequency, error_weights: [0.0, 1.0 / plant.at().re] }),
            feedforward: 0.0,
        };
        (plant, controller)
    }
}
