//! Judges trials, from traces to verdicts (`docs/verdicts.md`).
//!
//! A verdict depends only on scenario, stored traces and stored telemetry, not on a clock or on the
//! order of execution.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

mod divergence;
pub mod exclusion;
mod feasibility;
pub mod golden;
mod judge;
pub mod metrics;
mod peaks;
pub mod replay;
pub mod statistics;
mod symptoms;
mod trial;
pub mod tube;
pub mod uncertainty;

pub use divergence::divergence_time_s;
pub use judge::{Judgement, SequentialDecision, judge, judge_at_time_limit, judge_sequentially};
pub use metrics::Measure;
pub use peaks::missed_between_rows;
pub use trial::{TrialMeasures, measure, trial_record};
