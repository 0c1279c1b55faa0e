//! Adds a second bending mode to the plate.
//!
//! The waveform is the sum of both modes, and each obeys equation 1 with its own constants. A step
//! propagates the modes separately (`motion.rs`), so no function of [`ActiveEffect`] is needed.
//!
//! [`ActiveEffect`]: crate::effect::ActiveEffect

use crate::effect::{Effect, HIGHEST_RESONANCE_HZ, PlateError, check, finite, resonance};
use crate::mode::Mode;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `[second_mode]`. A temperature offset and a finger force change its resonance and its damping in
/// the same proportion as those of `[mode]`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawSecondMode {
    /// Resonance at the reference temperature, Hz.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = HIGHEST_RESONANCE_HZ))]
    pub resonance_hz: f64,
    /// Time constant τ = 1/σ of the untouched plate, ms.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub time_constant_ms: f64,
    /// Gain of the untouched plate at this mode's resonance, µm/Vpp; not 0. Negative if the sensor
    /// measures this mode with the opposite sign.
    pub gain_um_per_vpp: f64,
}

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

impl Effect for SecondMode {
    type Table = RawSecondMode;

    fn check(table: &RawSecondMode) -> Result<Self, PlateError> {
        const GAIN: &str = "second_mode.gain_um_per_vpp";
        let keys = ["second_mode.resonance_hz", "second_mode.time_constant_ms"];
        let (omega0, sigma0) = resonance(keys, table.resonance_hz, table.time_constant_ms)?;
        let gain = finite(GAIN, table.gain_um_per_vpp)?;
        check(gain != 0.0, GAIN, &gain, "a number other than 0; leave [second_mode] out if there is none")?;
        Ok(Self { omega0, sigma0, gain })
    }

    fn key(&self) -> Option<&'static str> {
        Some("second_mode")
    }
}

impl SecondMode {
    /// `damping` and `resonance` are σ and ω0 of the first mode relative to their values without
    /// finger at the reference temperature. Both modes change in proportion.
    pub(crate) fn mode(&self, damping: f64, resonance: f64) -> Mode {
        Mode {
            sigma: self.sigma0 * damping,
            omega0: self.omega0 * resonance,
            force_constant: self.force_constant(),
            envelope_constant: self.gain * self.sigma0,
        }
    }

    /// `N/m = gain · 2σ0 · ω0` of this mode, µm/s² per Vpp.
    pub fn force_constant(&self) -> f64 {
        self.gain * 2.0 * self.sigma0 * self.omega0
    }
}
