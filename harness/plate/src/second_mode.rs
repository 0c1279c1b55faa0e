//! Checks the plate's second bending mode.

use crate::plate_error::{PlateError, check, finite, positive};
use crate::raw_plate::{HIGHEST_RESONANCE_HZ, RawSecondMode};
use std::f64::consts::TAU;

/// The waveform is the sum of both modes, and each obeys equation 1 with its own constants.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SecondMode {
    /// Resonance at the reference temperature, rad/s.
    pub omega0: f64,
    /// Damping of the untouched plate, 1/s.
    pub sigma0: f64,
    /// Gain of the untouched plate at this mode's resonance, µm/Vpp. It is negative if the sensor
    /// measures the mode with the opposite sign.
    pub gain: f64,
}

impl SecondMode {
    pub(crate) fn check(raw: &RawSecondMode) -> Result<Self, PlateError> {
        const RESONANCE: &str = "second_mode.resonance_hz";
        const TIME_CONSTANT: &str = "second_mode.time_constant_ms";
        const GAIN: &str = "second_mode.gain_um_per_vpp";
        let resonance_hz = positive(RESONANCE, raw.resonance_hz)?;
        check(resonance_hz <= HIGHEST_RESONANCE_HZ, RESONANCE, &resonance_hz, "at most 2.5e6")?;
        let omega0 = resonance_hz * TAU;
        let sigma0 = 1e3 / positive(TIME_CONSTANT, raw.time_constant_ms)?;
        check(
            omega0 / (2.0 * sigma0) > 1.0,
            TIME_CONSTANT,
            &raw.time_constant_ms,
            "a time constant with Q = π · resonance_hz · τ above 1",
        )?;
        let gain = finite(GAIN, raw.gain_um_per_vpp)?;
        check(gain != 0.0, GAIN, &gain, "a number other than 0; leave [second_mode] out if there is none")?;
        Ok(Self { omega0, sigma0, gain })
    }

    /// `N/m = gain · 2σ0 · ω0` of this mode, µm/s² per Vpp.
    pub fn force_constant(&self) -> f64 {
        self.gain * 2.0 * self.sigma0 * self.omega0
    }
}
