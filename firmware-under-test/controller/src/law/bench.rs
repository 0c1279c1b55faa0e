//! A law on the envelope that the laws reckon with, in f64, for tests.

use crate::envelope::tests::moved;
use crate::law::{Actuation, Law, Measurement};
use platebench_wire::Configure;
use std::vec::Vec;

pub(crate) const SIGMA: f64 = 1.0 / 1.88e-3;
pub(crate) const FORCE: f64 = 0.00698 * SIGMA;
pub(crate) const PERIOD: f64 = 1e-3;
/// 9 K, rad/s.
pub(crate) const NINE_KELVIN: f64 = 544.8;

/// Law and plate, one period after the other.
pub(crate) struct Bench {
    pub(crate) law: Law,
    pub(crate) w: (f64, f64),
    /// What still acts at the start of a period: drive and offset in rad/s.
    pub(crate) acting: (f64, f64),
    /// σ/σ0
    pub(crate) damping: f64,
    /// The resonance above the start frequency, rad/s.
    pub(crate) resonance: f64,
    /// b, µm/s per Vpp.
    pub(crate) force: f64,
    /// Sampling to actuation, s.
    pub(crate) delay: f64,
    /// The next damping, and when in the next period, s.
    pub(crate) change: Option<(f64, f64)>,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct Period {
    /// |W| and Wq that the sample shows, µm.
    pub(crate) amplitude: f64,
    pub(crate) wq: f64,
    pub(crate) actuation: Actuation,
}

impl Bench {
    /// At rest, with the law that `configure` asks for.
    pub(crate) fn new(configure: &Configure, damping: f64, resonance: f64) -> Self {
        let law = Law::design(configure).unwrap().0;
        Self { law, w: (0.0, 0.0), acting: (0.0, 0.0), damping, resonance, force: FORCE, delay: 0.0, change: None }
    }

    /// The damping changes after `share` of the next period.
    pub(crate) fn changes_to(&mut self, damping: f64, share: f64) {
        self.change = Some((damping, share * PERIOD));
    }

    fn pass(&mut self, seconds: f64) {
        let (vpp, offset) = self.acting;
        self.w = moved(self.w, self.force, self.damping * SIGMA, offset - self.resonance, vpp, seconds);
    }

    pub(crate) fn play(&mut self, setpoint_um: f64, periods: u32) -> Vec<Period> {
        (0..periods).map(|_| self.period(setpoint_um)).collect()
    }

    pub(crate) fn period(&mut self, setpoint_um: f64) -> Period {
        let (wd, wq) = self.w;
        let measurement = Measurement { setpoint_um: setpoint_um as f32, wd_um: wd as f32, wq_um: wq as f32 };
        let actuation = self.law.step(&measurement);
        self.pass(self.delay);
        self.acting =
            (f64::from(actuation.drive_vpp), f64::from(actuation.frequency_offset_hz) * core::f64::consts::TAU);
        match self.change.take() {
            Some((damping, after)) => {
                self.pass(after);
                self.damping = damping;
                self.pass(PERIOD - self.delay - after);
            }
            None => self.pass(PERIOD - self.delay),
        }
        Period { amplitude: wd.hypot(wq), wq, actuation }
    }
}
