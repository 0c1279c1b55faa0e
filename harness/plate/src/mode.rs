//! Defines what a mode depends on: temperature, finger force and drive.

use crate::profile::Profile;
use crate::time::Time;
use std::array;

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Conditions {
    /// Temperature minus the plate's reference temperature.
    pub temperature_offset_k: f64,
    pub finger_force_n: f64,
}

#[derive(Debug, Clone, PartialEq)]
pub struct ConditionProfiles {
    pub temperature_offset_k: Profile,
    pub finger_force_n: Profile,
}

impl ConditionProfiles {
    pub fn at(&self, time: Time) -> Conditions {
        let [conditions] = self.at_each([time]);
        conditions
    }

    /// Conditions at increasing `times`. No profile may have a point after the first one up to the
    /// last one.
    pub(crate) fn at_each<const N: usize>(&self, times: [Time; N]) -> [Conditions; N] {
        let offsets = self.temperature_offset_k.at_each(times);
        let forces = self.finger_force_n.at_each(times);
        array::from_fn(|n| Conditions { temperature_offset_k: offsets[n], finger_force_n: forces[n] })
    }

    pub fn next_point_after(&self, time: Time) -> Option<Time> {
        let points = [&self.temperature_offset_k, &self.finger_force_n].map(|profile| profile.next_point_after(time));
        points.into_iter().flatten().min()
    }

    pub(crate) fn bandwidth(&self) -> f64 {
        self.temperature_offset_k.bandwidth().max(self.finger_force_n.bandwidth())
    }
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
