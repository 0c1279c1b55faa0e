//! The same gains on plates that are not quite the one they were designed for.

use crate::closed_loop::AnalysisError;
use crate::tuning::design::{Demand, Design};
use crate::tuning::transient::Transient;
use crate::tuning::{StepFigures, boundary, left};
use platebench_plate::{Plate, Tier};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Uniform};
use serde::Serialize;

/// How far a plate may be from the one that was identified, and how many are drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Of K1, percent to either side.
    pub gain_percent: f64,
    /// Of τ, percent to either side.
    pub time_constant_percent: f64,
    /// Plates that are drawn evenly from between the corners.
    pub samples: u32,
    /// What they are drawn from.
    pub seed: u64,
}

/// One plate: what it is, and what the gains do there.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Other {
    /// K1 against the plate file's.
    pub gain_percent: f64,
    /// τ against the plate file's.
    pub time_constant_percent: f64,
    /// Normal force of a finger, N.
    pub force_n: f64,
    /// |W| within the drive limit.
    pub plate: StepFigures,
    /// Both loops, each with the other closed: the smaller one.
    pub gain_margin: Option<f64>,
    /// Likewise, degrees.
    pub phase_margin_deg: Option<f64>,
    /// What the delay may grow by, ms: 0 or less where it is unstable already, `None` where it is stable as far as was looked.
    pub delay_margin_ms: Option<f64>,
}

/// The worst of several plates. `None` where one of them does not settle, and for margins where none has a bound.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Worst {
    /// How many plates.
    pub plates: usize,
    /// How many of them meet the demand.
    pub meeting: usize,
    /// Longest 5 % settling time.
    pub settling_ms: Option<f64>,
    /// Largest overshoot.
    pub overshoot_percent: f64,
    /// Smallest factor by which the gain may rise.
    pub gain_margin: Option<f64>,
    /// Smallest, degrees.
    pub phase_margin_deg: Option<f64>,
    /// Smallest, ms.
    pub delay_margin_ms: Option<f64>,
}

/// What the gains do elsewhere.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Sensitivity {
    /// Corners and edges of the spread.
    pub corners: Vec<Other>,
    /// The worst of them.
    pub worst_corner: Worst,
    /// The worst of those that were drawn; `None` where none were.
    pub worst_sample: Option<Worst>,
    /// The plate file's plate without the finger that was designed for, or under 2 N where none was.
    pub other_finger: Other,
}

/// A finger that nobody designed for, N (Fig. 16).
const FINGER: f64 = 2.0;

/// The design on all of them.
///
/// # Errors
/// [`AnalysisError`] of any of the loops.
pub fn sensitivity(demand: &Demand<'_>, design: &Design, spread: &Spread) -> Result<Sensitivity, AnalysisError> {
    let Spread { gain_percent, time_constant_percent, samples, seed } = *spread;
    let shares = [-1.0, 0.0, 1.0];
    let pairs = shares.into_iter().flat_map(|gain| shares.map(|tau| [gain, tau]));
    let at = |[gain, tau]: [f64; 2]| other(demand, design, [gain * gain_percent, tau * time_constant_percent]);
    let corners = pairs.filter(|pair| *pair != [0.0; 2]).map(at).collect::<Result<Vec<_>, _>>()?;
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    // Both ends are numbers, the first below the second.
    let even = Uniform::new_inclusive(-1.0, 1.0).map_err(|_| AnalysisError::NotFinite)?;
    let drawn = (0..samples).map(|_| at([even.sample(&mut random), even.sample(&mut random)]));
    let drawn = drawn.collect::<Result<Vec<_>, _>>()?;
    let force_n = if demand.force_n > 0.0 { 0.0 } else { FINGER };
    Ok(Sensitivity {
        worst_corner: worst(demand, &corners),
        worst_sample: (!drawn.is_empty()).then(|| worst(demand, &drawn)),
        corners,
        other_finger: other(&Demand { force_n, ..*demand }, design, [0.0; 2])?,
    })
}

/// The design on one plate.
fn other(demand: &Demand<'_>, design: &Design, [gain, tau]: [f64; 2]) -> Result<Other, AnalysisError> {
    let nominal = demand.plate;
    let factor = |percent: f64| 1.0 + percent / 100.0;
    let plate = Plate { gain: nominal.gain * factor(gain), sigma0: nominal.sigma0 / factor(tau), ..nominal.clone() };
    let transient: Transient = design.step(demand, &plate, demand.force_n);
    let margins = design.closed(demand, &plate, Tier::Modal, [true; 2])?.margins();
    Ok(Other {
        gain_percent: gain,
        time_constant_percent: tau,
        force_n: demand.force_n,
        plate: transient.into(),
        gain_margin: margins.gain,
        phase_margin_deg: margins.phase_deg,
        delay_margin_ms: left(demand, boundary(demand, &plate, design)?),
    })
}

fn worst(demand: &Demand<'_>, others: &[Other]) -> Worst {
    let settling = || others.iter().map(|other| other.plate.settling_ms);
    let smallest = |of: fn(&Other) -> Option<f64>| others.iter().filter_map(of).reduce(f64::min);
    Worst {
        plates: others.len(),
        meeting: settling().flatten().filter(|ms| *ms <= demand.response * 1e3).count(),
        settling_ms: settling().try_fold(0.0, |longest: f64, ms| Some(longest.max(ms?))),
        overshoot_percent: others.iter().map(|other| other.plate.overshoot_percent).fold(0.0, f64::max),
        gain_margin: smallest(|other| other.gain_margin),
        phase_margin_deg: smallest(|other| other.phase_margin_deg),
        delay_margin_ms: smallest(|other| other.delay_margin_ms),
    }
}
