//! How far each tier of the plate is from the exact one on a scenario, measured: every tier is played, and the traces are held against each other.
//!
//! Neighbours: `platebench_scenario::model` says beforehand how far a tier can be off; this says how far it was. In lockstep, on the hosted rig, without a folder.

use crate::trial::{self, Order, Patience};
use platebench_plate::Tier;
use platebench_rig::{Faulty, Hosted, RigError, Session};
use platebench_scenario::{Metric, Scenario};
use platebench_trace::Row;
use platebench_wire::LawId;

/// How far a tier is from the exact one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TierError {
    /// The tier.
    pub tier: Tier,
    /// Largest |ΔW|/setpoint over the rows that the expectations look at.
    pub watched: f64,
    /// The same over all rows.
    pub anywhere: f64,
    /// Rows that both traces have.
    pub compared: usize,
}

/// Why a tier could not be played.
#[derive(Debug, thiserror::Error)]
pub enum FidelityError {
    /// There is no such law.
    #[error("unknown law `{0}`")]
    Law(String),
    /// The controller cannot be worked with.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The caller's patience was over.
    #[error("the trial was given up")]
    GivenUp,
}

/// Plays the first trial of `scenario` on every tier, cheapest first, and holds each against the carrier's trace.
///
/// # Errors
/// [`FidelityError`]. A controller that is lost within a trial, as some scenarios want it, is none.
pub fn tier_errors(scenario: &Scenario, patience: &impl Patience) -> Result<Vec<TierError>, FidelityError> {
    let exact = rows(scenario, Tier::Carrier, patience)?;
    let of_tier = |tier: Tier| {
        let rows = if tier == Tier::Carrier { exact.clone() } else { rows(scenario, tier, patience)? };
        let (watched, _) = apart(&exact, &rows, &|row| is_watched(scenario, row));
        let (anywhere, compared) = apart(&exact, &rows, &|_| true);
        Ok(TierError { tier, watched, anywhere, compared })
    };
    Tier::ALL.into_iter().map(of_tier).collect()
}

/// The trace of the first trial of `scenario` on `tier`.
///
/// # Errors
/// As [`tier_errors`].
pub fn rows(scenario: &Scenario, tier: Tier, patience: &impl Patience) -> Result<Vec<Row>, FidelityError> {
    let scenario = Scenario { tier, ..scenario.clone() };
    let law = &scenario.controller.law;
    let law = LawId::from_name(law).ok_or_else(|| FidelityError::Law(law.clone()))?;
    let mut session = Session::open(Faulty::new(Hosted::new()))?;
    let order = Order { scenario: &scenario, law, index: 0, wire_time: false, own_clock: false };
    let played = trial::play(&mut session, &order, patience).ok_or(FidelityError::GivenUp)?;
    match played.lost {
        Some(refused @ RigError::Refused(_)) => Err(refused.into()),
        _ => Ok(played.rows),
    }
}

/// Whether an expectation looks at this row, by its time; at all rows of a trial where it says nothing else.
fn is_watched(scenario: &Scenario, row: &Row) -> bool {
    scenario.expectations.iter().any(|expectation| match expectation.metric {
        Metric::StaticError | Metric::Repeatability => {
            (expectation.window.from.seconds()..=expectation.window.to.seconds()).contains(&row.t_s)
        }
        Metric::FinalAmplitude | Metric::QuadratureRatio | Metric::FrequencyError => {
            row.t_s >= scenario.duration.seconds()
        }
        _ => expectation.from.is_none_or(|from| row.t_s >= from.seconds()),
    })
}

/// The largest |ΔW| over the rows that both traces have and `looks` takes, relative to the smallest setpoint above 0; and how many they are. Rows of both rise in time.
pub fn apart(left: &[Row], right: &[Row], looks: &dyn Fn(&Row) -> bool) -> (f64, usize) {
    let positive = left.iter().map(|row| row.setpoint_um).filter(|setpoint| *setpoint > 0.0);
    let scale = positive.fold(f64::INFINITY, f64::min);
    let (mut worst, mut at, mut compared) = (0.0_f64, 0, 0);
    for row in left.iter().filter(|row| looks(row)) {
        while right.get(at).is_some_and(|other| other.t_s < row.t_s) {
            at += 1;
        }
        if let Some(other) = right.get(at).filter(|other| other.t_s == row.t_s) {
            worst = worst.max((row.wd_um - other.wd_um).hypot(row.wq_um - other.wq_um) / scale);
            compared += 1;
        }
    }
    (worst, compared)
}
