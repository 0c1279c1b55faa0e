//! Tunes gains for a plate: equation 24 in its readings, their behaviour, feasibility and
//! alternatives.
//!
//! * [`design`]: target and gains.
//! * [`transient`]: |W| on the exact plate.
//! * [`evaluation`]: poles, margins and responses of a design.
//! * [`search`]: the response time to design for, and the fastest design.
//! * [`spread`]: the same gains on other plates.
//! * [`mod@tune`]: the design that meets a target, or why none does.
//! * [`mod@format`]: the result as text.
//! * [`verification`]: the step that verifies gains on a rig.
//!
//! Field names carry their units because they are those of the JSON.

pub mod design;
pub mod evaluation;
pub mod format;
pub mod search;
pub mod spread;
pub mod transient;
pub mod tune;
pub mod verification;

pub use evaluation::{DesignEvaluation, evaluate_design};
pub use tune::{InfeasibilityCause, TuningResult, tune};
