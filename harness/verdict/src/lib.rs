//! Judges trials: from traces to verdicts.
//!
//! * [`metrics`]: measures one trial from its trace.
//! * `divergence`: detects a loop that does not converge.
//! * `feasibility`: decides whether any controller could meet a demand.
//! * `exclusion`, [`real_plate`]: decide whether a trial counts.
//! * `trial`: combines these into what verdicts depend on.
//! * [`statistics`]: computes intervals over trials.
//! * `judge`: judges the expectations of a scenario.
//! * [`tube`], [`golden`]: compare a response with the accepted one.
//!
//! `docs/verdicts.md` defines metrics and verdicts for users. A verdict depends on the scenario,
//! the stored traces and the stored telemetry only: neither on a clock nor on the order of
//! execution.

mod bisection;
mod divergence;
mod exclusion;
mod feasibility;
pub mod golden;
mod judge;
pub mod metrics;
pub mod real_plate;
pub mod statistics;
mod trial;
pub mod tube;

pub use divergence::divergence_time_s;
pub use judge::{Judgement, SequentialDecision, judge, judge_sequentially};
pub use metrics::Measure;
pub use trial::{TrialMeasures, measure, trial_record};
