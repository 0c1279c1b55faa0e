//! Computes damping and resonance of the mode under a finger force and at a temperature.

use crate::plate::Plate;

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Conditions {
    /// Temperature minus the plate's reference temperature.
    pub temperature_offset_k: f64,
    pub finger_force_n: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mode {
    /// Damping σ = d/2m, 1/s.
    pub sigma: f64,
    /// Undamped resonance ω0, rad/s.
    pub omega0: f64,
    /// Constant N/m of the plate (equation 8), µm/s² per Vpp.
    pub force_constant: f64,
    /// Constant of the envelope, `b = K1 σ0`, µm/s per Vpp.
    pub envelope_constant: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Drive {
    pub vpp: f64,
    /// Excitation frequency ω, rad/s.
    pub omega: f64,
}

impl Plate {
    pub fn mode(&self, conditions: &Conditions) -> Mode {
        let omega0 = self.omega0
            + self.omega0_per_k * conditions.temperature_offset_k
            + self.omega0_per_n * conditions.finger_force_n;
        Mode {
            sigma: self.sigma0 * self.damping_ratio_at(conditions.finger_force_n),
            omega0,
            force_constant: self.force_constant(),
            envelope_constant: self.gain * self.sigma0,
        }
    }

    /// A finger and the temperature change its σ and ω0 in proportion to those of the first mode.
    pub fn second_mode(&self, conditions: &Conditions) -> Option<Mode> {
        self.second_mode.map(|second| {
            let first = self.mode(conditions);
            Mode {
                sigma: second.sigma0 * (first.sigma / self.sigma0),
                omega0: second.omega0 * (first.omega0 / self.omega0),
                force_constant: second.force_constant(),
                envelope_constant: second.gain * second.sigma0,
            }
        })
    }

    /// Largest σ for forces from `low` to `high` N, 1/s.
    pub(crate) fn max_sigma(&self, (low, high): (f64, f64)) -> f64 {
        let bends = self.damping_ratio.iter().map(|point| point[0]).filter(|force| (low..=high).contains(force));
        self.sigma0 * bends.chain([low, high]).map(|force| self.damping_ratio_at(force)).fold(0.0_f64, f64::max)
    }
}

impl Mode {
    pub fn is_resonant(&self) -> bool {
        self.sigma > 0.0 && self.omega0 > self.sigma
    }

    /// Drive that holds `amplitude` µm at resonance: `V = W σ / b`, Vpp.
    pub fn drive_for(&self, amplitude: f64) -> f64 {
        amplitude * self.sigma / self.envelope_constant
    }

    /// Shortest time in s from rest to the amplitude `share · setpoint` µm at resonance:
    /// `−ln(1 − share·setpoint/W∞)/σ`. W∞ is the steady amplitude at `limit` Vpp. `None` if W∞ is
    /// too small.
    pub fn min_rise_time(&self, setpoint: f64, share: f64, limit: f64) -> Option<f64> {
        let missing = 1.0 - share * self.drive_for(setpoint) / limit;
        (missing > 0.0).then(|| -missing.ln() / self.sigma)
    }
}
