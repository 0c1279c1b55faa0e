//! Evaluates a design on plates that differ from the plate of the design.

use crate::loops::closed_loop::AnalysisError;
use crate::tuning::design::{GainDesign, TuningTarget};
use crate::tuning::evaluation::{StepEvaluation, delay_margin_ms, design_delay_boundary};
use platebench_plate::{Plate, Tier};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Uniform};
use serde::Serialize;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlateSpread {
    /// Largest deviation of the plate's gain K1.
    pub gain_percent: f64,
    pub time_constant_percent: f64,
    /// Number of random plates, uniform between the corners.
    pub samples: u32,
    pub seed: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PlateVariant {
    /// Deviation of the gain K1 from the plate file.
    pub gain_percent: f64,
    pub time_constant_percent: f64,
    pub force_n: f64,
    /// Step response with the drive limit.
    pub plate: StepEvaluation,
    /// The smaller gain margin of both loops, each with the other loop closed.
    pub gain_margin: Option<f64>,
    pub phase_margin_deg: Option<f64>,
    pub delay_margin_ms: Option<f64>,
}

/// `settling_ms` is `None` if a plate does not settle. A margin is `None` if no plate limits it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct WorstCase {
    pub plates: usize,
    pub meeting: usize,
    pub settling_ms: Option<f64>,
    pub overshoot_percent: f64,
    pub gain_margin: Option<f64>,
    pub phase_margin_deg: Option<f64>,
    pub delay_margin_ms: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Sensitivity {
    pub corners: Vec<PlateVariant>,
    pub worst_corner: WorstCase,
    pub worst_sample: Option<WorstCase>,
    /// The nominal plate without the design's finger, or under 2 N if the design has no finger.
    /// `None` if the plate file has no `[finger]`, because a force then changes nothing.
    pub other_finger: Option<PlateVariant>,
}

/// Unexpected finger for a design without a finger, N (Fig. 16 of the paper).
const FINGER: f64 = 2.0;

pub fn evaluate_sensitivity(
    target: &TuningTarget<'_>,
    design: &GainDesign,
    spread: &PlateSpread,
) -> Result<Sensitivity, AnalysisError> {
    let PlateSpread { gain_percent, time_constant_percent, samples, seed } = *spread;
    let shares = [-1.0, 0.0, 1.0];
    let pairs = shares.into_iter().flat_map(|gain| shares.map(|tau| [gain, tau]));
    let at =
        |[gain, tau]: [f64; 2]| evaluate_variant(target, design, [gain * gain_percent, tau * time_constant_percent]);
    let corners = pairs.filter(|pair| *pair != [0.0; 2]).map(at).collect::<Result<Vec<_>, _>>()?;
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let even = Uniform::new_inclusive(-1.0, 1.0).map_err(|_| AnalysisError::NotFinite)?;
    let drawn = (0..samples).map(|_| at([even.sample(&mut random), even.sample(&mut random)]));
    let drawn = drawn.collect::<Result<Vec<_>, _>>()?;
    let force_n = if target.force_n > 0.0 { 0.0 } else { FINGER };
    Ok(Sensitivity {
        worst_corner: worst_case(target, &corners),
        worst_sample: (!drawn.is_empty()).then(|| worst_case(target, &drawn)),
        corners,
        other_finger: target
            .plate
            .depends_on_force()
            .then(|| evaluate_variant(&TuningTarget { force_n, ..*target }, design, [0.0; 2]))
            .transpose()?,
    })
}

fn evaluate_variant(
    target: &TuningTarget<'_>,
    design: &GainDesign,
    [gain, tau]: [f64; 2],
) -> Result<PlateVariant, AnalysisError> {
    let nominal = target.plate;
    let factor = |percent: f64| 1.0 + percent / 100.0;
    let plate = Plate { gain: nominal.gain * factor(gain), sigma0: nominal.sigma0 / factor(tau), ..nominal.clone() };
    let margins = design.closed_loop(target, &plate, Tier::Modal, [true; 2])?.margins();
    Ok(PlateVariant {
        gain_percent: gain,
        time_constant_percent: tau,
        force_n: target.force_n,
        plate: design.simulate_step(target, &plate).into(),
        gain_margin: margins.gain,
        phase_margin_deg: margins.phase_deg,
        delay_margin_ms: delay_margin_ms(target, design_delay_boundary(target, &plate, design)?),
    })
}

fn worst_case(target: &TuningTarget<'_>, others: &[PlateVariant]) -> WorstCase {
    let settling = || others.iter().map(|other| other.plate.settling_ms);
    let smallest = |of: fn(&PlateVariant) -> Option<f64>| others.iter().filter_map(of).reduce(f64::min);
    WorstCase {
        plates: others.len(),
        meeting: settling().flatten().filter(|ms| *ms <= target.response * 1e3).count(),
        settling_ms: settling().try_fold(0.0, |longest: f64, ms| Some(longest.max(ms?))),
        overshoot_percent: others.iter().map(|other| other.plate.overshoot_percent).fold(0.0, f64::max),
        gain_margin: smallest(|other| other.gain_margin),
        phase_margin_deg: smallest(|other| other.phase_margin_deg),
        delay_margin_ms: smallest(|other| other.delay_margin_ms),
    }
}
