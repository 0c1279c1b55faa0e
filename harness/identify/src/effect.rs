//! Defines what a recording may show besides one mode.

use crate::estimate::Estimate;
use serde::Serialize;

/// Largest relative standard error of the second mode's gain, or of the resonance's shift by heating. Noise alone does
/// not give a value of five standard errors, even as the best of some twenty fits with different start points.
const MAX_STRENGTH_ERROR: f64 = 0.2;
const MAX_TIME_CONSTANT_ERROR: f64 = 0.5;

/// What a recording shows besides one mode.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case", tag = "kind")]
pub enum EffectFit {
    SecondMode {
        resonance_hz: Estimate,
        time_constant_s: Estimate,
        gain_um_per_vpp: Estimate,
    },
    Heating {
        /// Shift of the resonance in the steady state, Hz per µm².
        shift_hz_per_um2: Estimate,
        time_constant_s: Estimate,
    },
}

impl EffectFit {
    /// True if the errors are small enough to exclude a chance fit.
    pub(crate) fn is_determined(&self) -> bool {
        let (strength, time_constant) = match self {
            Self::SecondMode { time_constant_s, gain_um_per_vpp, .. } => (gain_um_per_vpp, time_constant_s),
            Self::Heating { shift_hz_per_um2, time_constant_s } => (shift_hz_per_um2, time_constant_s),
        };
        let is_within = |part: &Estimate, share: f64| part.error < share * part.value.abs();
        is_within(strength, MAX_STRENGTH_ERROR) && is_within(time_constant, MAX_TIME_CONSTANT_ERROR)
    }
}

/// The second mode of the plate.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct IdentifiedSecondMode {
    pub resonance_hz: Estimate,
    pub time_constant_s: Estimate,
    pub gain_um_per_vpp: Estimate,
}

/// The thermal node of the plate.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct IdentifiedHeating {
    /// In the steady state.
    pub shift_hz_per_um2: Estimate,
    pub time_constant_s: Estimate,
}

/// Means over the recordings that show a second mode.
pub(crate) fn pool_second_modes(effects: &[EffectFit]) -> Option<IdentifiedSecondMode> {
    let parts = effects.iter().filter_map(|effect| match effect {
        EffectFit::SecondMode { resonance_hz, time_constant_s, gain_um_per_vpp } => {
            Some([*resonance_hz, *time_constant_s, *gain_um_per_vpp])
        }
        EffectFit::Heating { .. } => None,
    });
    let parts: Vec<_> = parts.collect();
    let pooled = |index: usize| Estimate::pool(&parts.iter().map(|part| part[index]).collect::<Vec<_>>());
    Some(IdentifiedSecondMode { resonance_hz: pooled(0)?, time_constant_s: pooled(1)?, gain_um_per_vpp: pooled(2)? })
}

/// Means over the recordings that show self-heating.
pub(crate) fn pool_heating(effects: &[EffectFit]) -> Option<IdentifiedHeating> {
    let parts = effects.iter().filter_map(|effect| match effect {
        EffectFit::Heating { shift_hz_per_um2, time_constant_s } => Some([*shift_hz_per_um2, *time_constant_s]),
        EffectFit::SecondMode { .. } => None,
    });
    let parts: Vec<_> = parts.collect();
    let pooled = |index: usize| Estimate::pool(&parts.iter().map(|part| part[index]).collect::<Vec<_>>());
    Some(IdentifiedHeating { shift_hz_per_um2: pooled(0)?, time_constant_s: pooled(1)? })
}
