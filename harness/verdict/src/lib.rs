//! From traces to verdicts.
//!
//! * [`metrics`]: numbers of one trial, off its trace alone.
//! * [`divergence`]: whether the loop converged at all.
//! * [`feasibility`]: whether any controller could have met a demand.
//! * [`statistics`]: intervals for what only many trials can tell.
//! * [`mod@judge`]: expectation to verdict.
//! * [`real_plate`]: what a trial on a real plate is worth, of which nobody knows more than its controller tells.
//! * [`tube`], [`golden`]: whether a response still looks as it did when it was accepted.
//! * [`record`]: what a run leaves behind in `run.json`.
//!
//! The definitions for users stand in `docs/verdicts.md`. A verdict depends on the scenario, the stored traces and
//! what the rig told beside them, and on nothing else: no clock, no order of execution.

pub mod divergence;
pub mod feasibility;
pub mod golden;
pub mod judge;
pub mod metrics;
pub mod real_plate;
pub mod record;
pub mod statistics;
pub mod tube;

pub use judge::{Decision, Judgement, TrialMeasures, judge, measure, sequential};
pub use metrics::Measure;
pub use record::{
    Cause, Definition, Evidence, ExpectationRecord, RunRecord, ScenarioRecord, Telemetry, TrialRecord, Verdict,
};
