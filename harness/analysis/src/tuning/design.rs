//! Equation 24, made discrete in three ways, and what is asked of it.

use crate::closed_loop::{AnalysisError, ClosedLoop, Timing};
use crate::controller::{Channel, Controller, Integral, Pi};
use crate::plant::Plant;
use crate::tuning::transient::{Setting, Transient};
use platebench_plate::{Conditions, Drive, Mode, Plate, Tier};
use platebench_wire::Gains;

/// How long a response is looked at: so many periods, response times and time constants of the plate, whichever is longest, and delays on top.
const PERIODS: f64 = 60.0;
const RESPONSES: f64 = 6.0;
const TIME_CONSTANTS: f64 = 20.0;
const DELAYS: f64 = 20.0;

/// How equation 24 is read at a control period.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Reading {
    /// As printed, with a forward-Euler integral.
    Forward,
    /// As printed, with a backward-Euler integral.
    Backward,
    /// Matched to the zero-order hold.
    Matched,
}

impl Reading {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Forward, Self::Backward, Self::Matched];

    /// Its name in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Forward => "forward Euler, as printed",
            Self::Backward => "backward Euler, as printed",
            Self::Matched => "zero-order-hold match",
        }
    }

    /// The loop of a plant K/(1 + τp): `gain` K, all times in s.
    fn pi(self, gain: f64, time_constant: f64, response: f64, period: f64) -> Pi {
        match self {
            Self::Forward => Pi::as_printed(Integral::Forward, gain, time_constant, response, period),
            Self::Backward => Pi::as_printed(Integral::Backward, gain, time_constant, response, period),
            Self::Matched => Pi::matched(gain, time_constant, response, period),
        }
    }
}

/// What a tuning is to do, where, and when its commands act.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Demand<'a> {
    /// The plate that the gains are designed for; its drive limit counts.
    pub plate: &'a Plate,
    /// The finger that they are designed for, N.
    pub force_n: f64,
    /// µm, above 0.
    pub setpoint: f64,
    /// 5 % response time of |W|, s, above 0.
    pub response: f64,
    /// Control period, µs, above 0.
    pub period_us: u32,
    /// Sampling to actuation, s, 0 or more.
    pub delay: f64,
    /// Phase margin of both loops, degrees.
    pub phase_margin_deg: f64,
}

impl Demand<'_> {
    /// The control period, s.
    pub fn period(&self) -> f64 {
        f64::from(self.period_us) * 1e-6
    }

    /// The mode under the finger.
    pub fn mode(&self) -> Mode {
        self.plate.mode(&Conditions { temperature_offset_k: 0.0, finger_force_n: self.force_n })
    }

    /// No controller brings |W| to the band's edge sooner with this drive, s; `None` where none gets there at all.
    pub fn floor(&self) -> Option<f64> {
        self.mode().time_floor(self.setpoint, 0.95, self.plate.drive_limit_vpp)
    }

    /// Periods over which a response is looked at.
    pub fn horizon(&self) -> u32 {
        let slowest = (RESPONSES * self.response).max(TIME_CONSTANTS / self.mode().sigma);
        let seconds = (PERIODS * self.period()).max(slowest) + DELAYS * self.delay;
        (seconds / self.period()).ceil() as u32
    }
}

/// Both loops of a design.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Design {
    /// How equation 24 was read.
    pub reading: Reading,
    /// The response time that was put into it, s.
    pub response: f64,
    /// Drive from the error of Wd, Vpp per µm.
    pub amplitude: Pi,
    /// Excitation from Wq/Wd, rad/s.
    pub frequency: Pi,
}

impl Design {
    /// Equation 24 for the plate under the demand's finger and `response` s. With σ of that plate K = b/σ and τ = 1/σ for the amplitude, K = τ for the frequency.
    pub fn new(demand: &Demand<'_>, reading: Reading, response: f64) -> Self {
        let mode = demand.mode();
        let tau = 1.0 / mode.sigma;
        let [amplitude, frequency] =
            [mode.envelope_constant * tau, tau].map(|gain| reading.pi(gain, tau, response, demand.period()));
        Self { reading, response, amplitude, frequency }
    }

    /// The gains as the firmware is told: its integral is the forward one, into whose proportional part a backward one's share is put.
    pub fn gains(&self, period: f64) -> Gains {
        Gains {
            amplitude_kp: self.amplitude.proportional as f32,
            amplitude_ki: (self.amplitude.integral_per_period / period) as f32,
            frequency_kp: self.frequency.proportional as f32,
            frequency_ki: (self.frequency.integral_per_period / period) as f32,
        }
    }

    /// Both loops, or one of them, around the steady state at the setpoint, on `plate` under the demand's finger.
    ///
    /// # Errors
    /// [`AnalysisError::NotFinite`].
    pub fn closed(
        &self,
        demand: &Demand<'_>,
        plate: &Plate,
        tier: Tier,
        [drive, frequency]: [bool; 2],
    ) -> Result<ClosedLoop, AnalysisError> {
        let (plant, controller) = self.parts(&Demand { plate, ..*demand }, tier);
        let controller = Controller {
            drive: controller.drive.filter(|_| drive),
            frequency: controller.frequency.filter(|_| frequency),
            ..controller
        };
        ClosedLoop::new(plant, controller, Timing { period: demand.period(), delay: demand.delay })
    }

    /// The plate around its steady state, and the loops.
    pub(crate) fn parts(&self, demand: &Demand<'_>, tier: Tier) -> (Plant, Controller) {
        let mode = demand.mode();
        let drive = Drive { vpp: mode.drive_for(demand.setpoint), omega: mode.omega0 };
        let plant = Plant::around(tier, &mode, &drive);
        let controller = Controller {
            drive: Some(Channel { pi: self.amplitude, error: [-1.0, 0.0] }),
            frequency: Some(Channel { pi: self.frequency, error: [0.0, 1.0 / plant.at().re] }),
            feedforward: 0.0,
        };
        (plant, controller)
    }

    /// A step from rest on `plate` under `force_n`.
    pub fn step(&self, demand: &Demand<'_>, plate: &Plate, force_n: f64) -> Transient {
        let Demand { period_us, delay, setpoint, .. } = *demand;
        let Self { amplitude, frequency, .. } = *self;
        Setting { plate, force_n, amplitude, frequency, period_us, delay, setpoint }.step(demand.horizon())
    }
}
