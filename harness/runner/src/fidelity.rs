//! Measures the error of each plate model on a scenario against the carrier model, in lockstep on the hosted rig.

use crate::trial::{self, TrialSpec};
use platebench_plate::Tier;
use platebench_rig::{CancelToken, FaultInjector, HostedLink, RigError, Session};
use platebench_scenario::{Metric, Scenario};
use platebench_trace::Row;
use platebench_wire::LawId;

/// The error of a model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TierDeviation {
    /// The model.
    pub tier: Tier,
    /// Largest |ΔW|/setpoint over the rows that expectations use.
    pub in_windows: f64,
    /// Largest |ΔW|/setpoint over all rows.
    pub overall: f64,
    /// Instants that both traces have.
    pub row_count: usize,
}

/// Why a model could not be played.
#[derive(Debug, thiserror::Error)]
pub enum FidelityError {
    /// No law has this name.
    #[error("unknown law `{0}`")]
    Law(String),
    /// The controller failed.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The trial was cancelled.
    #[error("the trial was cancelled")]
    Cancelled,
}

/// Plays the first trial on every model, cheapest first, and compares each with the carrier's trace.
///
/// # Errors
/// [`FidelityError`]. A controller that is lost within the trial is not an error.
pub fn tier_deviations(scenario: &Scenario, cancel: &CancelToken) -> Result<Vec<TierDeviation>, FidelityError> {
    let exact = rows(scenario, Tier::Carrier, cancel)?;
    let of_tier = |tier: Tier| {
        let rows = if tier == Tier::Carrier { exact.clone() } else { rows(scenario, tier, cancel)? };
        let (watched, _) = max_deviation(&exact, &rows, &|row| is_judged(scenario, row));
        let (anywhere, compared) = max_deviation(&exact, &rows, &|_| true);
        Ok(TierDeviation { tier, in_windows: watched, overall: anywhere, row_count: compared })
    };
    Tier::ALL.into_iter().map(of_tier).collect()
}

/// The trace of the first trial on `tier`.
///
/// # Errors
/// As for [`tier_deviations`].
pub fn rows(scenario: &Scenario, tier: Tier, cancel: &CancelToken) -> Result<Vec<Row>, FidelityError> {
    let scenario = Scenario { tier, ..scenario.clone() };
    let law = &scenario.controller.law;
    let law = LawId::from_name(law).ok_or_else(|| FidelityError::Law(law.clone()))?;
    let mut session = Session::open(FaultInjector::new(HostedLink::new()))?;
    let spec = TrialSpec { scenario: &scenario, law, index: 0, wire_time: false, own_clock: false };
    let played = trial::play(&mut session, &spec, cancel, None).ok_or(FidelityError::Cancelled)?;
    match played.link_error {
        Some(refused @ RigError::ConfigurationRejected(_)) => Err(refused.into()),
        _ => Ok(played.trace_rows),
    }
}

/// True if an expectation uses the row at this time.
fn is_judged(scenario: &Scenario, row: &Row) -> bool {
    scenario.expectations.iter().any(|expectation| match expectation.metric {
        Metric::StaticError | Metric::Repeatability => {
            let windows = &mut expectation.windows.iter();
            windows.any(|window| (window.from.seconds()..=window.to.seconds()).contains(&row.t_s))
        }
        Metric::FinalAmplitude | Metric::QuadratureRatio | Metric::FrequencyError => {
            row.t_s >= scenario.duration.seconds()
        }
        _ => expectation.from.is_none_or(|from| row.t_s >= from.seconds()),
    })
}

/// The largest |ΔW| over the common instants that `uses` accepts, relative to the smallest positive setpoint, and the
/// number of these instants. Both traces are in order of time.
pub fn max_deviation(left: &[Row], right: &[Row], uses: &dyn Fn(&Row) -> bool) -> (f64, usize) {
    let positive = left.iter().map(|row| row.setpoint_um).filter(|setpoint| *setpoint > 0.0);
    let scale = positive.fold(f64::INFINITY, f64::min);
    let (mut worst, mut at, mut compared) = (0.0_f64, 0, 0);
    for row in left.iter().filter(|row| uses(row)) {
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
