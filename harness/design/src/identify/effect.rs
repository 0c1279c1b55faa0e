//! Defines the second mode and the self-heating that a fit may find.

use crate::identify::estimate::Estimate;
use serde::Serialize;

/// Largest relative standard error of the second mode's gain, or of the shift by self-heating.
/// Noise alone does not reach five standard errors, even as the best of about twenty start points.
const MAX_STRENGTH_ERROR: f64 = 0.2;
const MAX_TIME_CONSTANT_ERROR: f64 = 0.5;

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum EffectFit {
    SecondMode(IdentifiedSecondMode),
    Heating(IdentifiedHeating),
}

impl EffectFit {
    pub(crate) fn is_determined(&self) -> bool {
        let (strength, time_constant) = match self {
            Self::SecondMode(mode) => (&mode.gain_um_per_vpp, &mode.time_constant_s),
            Self::Heating(heating) => (&heating.shift_hz_per_um2, &heating.time_constant_s),
        };
        let is_within = |part: &Estimate, share: f64| part.error < share * part.value.abs();
        is_within(strength, MAX_STRENGTH_ERROR) && is_within(time_constant, MAX_TIME_CONSTANT_ERROR)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct IdentifiedSecondMode {
    pub resonance_hz: Estimate,
    pub time_constant_s: Estimate,
    pub gain_um_per_vpp: Estimate,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct IdentifiedHeating {
    pub shift_hz_per_um2: Estimate,
    pub time_constant_s: Estimate,
}

pub(crate) fn pool_second_modes(effects: &[EffectFit]) -> Option<IdentifiedSecondMode> {
    let [resonance_hz, time_constant_s, gain_um_per_vpp] = pool(effects, |effect| match effect {
        EffectFit::SecondMode(mode) => Some([mode.resonance_hz, mode.time_constant_s, mode.gain_um_per_vpp]),
        EffectFit::Heating(_) => None,
    })?;
    Some(IdentifiedSecondMode { resonance_hz, time_constant_s, gain_um_per_vpp })
}

pub(crate) fn pool_heating(effects: &[EffectFit]) -> Option<IdentifiedHeating> {
    let [shift_hz_per_um2, time_constant_s] = pool(effects, |effect| match effect {
        EffectFit::Heating(heating) => Some([heating.shift_hz_per_um2, heating.time_constant_s]),
        EffectFit::SecondMode(_) => None,
    })?;
    Some(IdentifiedHeating { shift_hz_per_um2, time_constant_s })
}

fn pool<const N: usize>(
    effects: &[EffectFit],
    parameters: impl Fn(&EffectFit) -> Option<[Estimate; N]>,
) -> Option<[Estimate; N]> {
    let found: Vec<_> = effects.iter().filter_map(parameters).collect();
    let pooled = |index: usize| Estimate::pool(&found.iter().map(|each| each[index]).collect::<Vec<_>>());
    (0..N).map(pooled).collect::<Option<Vec<_>>>()?.try_into().ok()
}
