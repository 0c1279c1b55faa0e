//! Defines the result of a search for margins.

use crate::margins::scenes::{OperatingPoint, Quantity};
use schemars::JsonSchema;
use serde::Serialize;

/// Result of `stability --rig --format json`.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct MarginReport {
    /// Scenario file with the expectations.
    pub scenario: String,
    pub cases: Vec<CaseMargins>,
    /// Laws that the controller does not announce, each with the reason.
    pub not_applicable: Vec<String>,
}

/// A law of a controller at an operating point.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct CaseMargins {
    pub rig: String,
    pub law: String,
    /// True for the bench's laws to which the controller is compared.
    pub is_reference: bool,
    pub point: OperatingPoint,
    /// Judged expectations, by name.
    pub expectations: Vec<String>,
    /// First expectation that does not hold at the operating point.
    pub failing: Option<String>,
    pub settling_ms: Option<f64>,
    pub static_error_percent: Option<f64>,
    /// Absent on rigs that do not count instructions.
    pub instructions_per_step: Option<f64>,
    /// Wall time per control step with bench and line, shortest of the trials with noise.
    pub time_per_step_us: Option<f64>,
    /// Standard deviation of the amplitude over that of the noise of a sensor component.
    pub noise_gain: Option<NoiseGain>,
    pub margins: Vec<Margin>,
    pub trials: u32,
}

#[derive(Debug, Clone, Copy, Serialize, JsonSchema)]
pub struct NoiseGain {
    pub value: f64,
    /// Each end is one-sided at 95 %.
    pub interval: Option<[f64; 2]>,
    pub trials: u32,
}

#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct Margin {
    pub quantity: Quantity,
    /// Every expectation of the scenario holds.
    pub requirement: Edge,
    pub stability: Edge,
    /// Stability limit of the loop analysis for the bench's law.
    pub predicted: Option<f64>,
}

impl Margin {
    /// Measured over predicted stability limit, minus 1.
    pub fn difference_percent(&self) -> Option<f64> {
        Some((self.stability.middle()? / self.predicted? - 1.0) * 100.0)
    }
}

/// Interval that contains a limit.
#[derive(Debug, Clone, Default, PartialEq, Serialize, JsonSchema)]
pub struct Edge {
    /// Last value that holds; absent if the operating point itself fails.
    pub holds_to: Option<f64>,
    /// First value that fails; absent if none of the search fails.
    pub fails_from: Option<f64>,
    /// First expectation that fails at `fails_from`.
    pub failing: Option<String>,
    pub trials: u32,
}

impl Edge {
    pub fn middle(&self) -> Option<f64> {
        Some(f64::midpoint(self.holds_to?, self.fails_from?))
    }
}

impl CaseMargins {
    pub fn margin(&self, quantity: Quantity) -> Option<&Margin> {
        self.margins.iter().find(|margin| margin.quantity == quantity)
    }
}
