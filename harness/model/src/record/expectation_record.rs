//! Records an expectation and its verdict.

use crate::metrics::{Metric, SignalPoint};
use crate::record::reason::{self, Reason};
use crate::record::verdict::{Cause, Verdict};
use crate::scenario::{Expectation, Limit};
use platebench_plate::Time;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ExpectationRecord {
    /// Unique name of the expectation in the scenario. It does not depend on the limit.
    pub name: String,
    pub metric: Metric,
    pub verdict: Verdict,
    /// Value of `statistic`; `null` if the deciding trial has no number.
    pub value: Option<f64>,
    pub statistic: Statistic,
    pub limit: Limit,
    /// Distance of `value` to the limit, divided by the limit's scale, see [`Limit::margin`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub margin: Option<f64>,
    /// Smallest and largest value over trials if `statistic` is `worst`, otherwise the bounds at
    /// `confidence`.
    pub interval: Option<[f64; 2]>,
    /// Confidence of each bound or of the failure rate; `null` if nothing is random.
    pub confidence: Option<f64>,
    pub cause: Option<Cause>,
    #[serde(flatten, with = "reason::file_keys")]
    #[schemars(with = "reason::file_keys::Keys<Reason>")]
    pub reason: Option<Reason>,
    pub paper: Option<f64>,
    pub requirement: Option<String>,
    /// Start and end of each judged window, ms. The worst window decides.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub windows_ms: Vec<[f64; 2]>,
    /// Absent if no trial has a measurement.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub worst: Option<WorstInstant>,
    #[serde(flatten)]
    pub definition: MetricDefinition,
    #[serde(default, skip_serializing_if = "Evidence::is_empty")]
    pub evidence: Evidence,
}

/// Trial, window and instants that decided the value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct WorstInstant {
    pub trial: u32,
    /// Start and end, ms.
    pub window_ms: [f64; 2],
    /// Worst values of the signal that the metric evaluates. Two for a ripple; absent if no instant
    /// decides, as for a count.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub points: Vec<SignalPoint>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Statistic {
    Worst,
    Mean,
    Quantile,
    Deviation,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct MetricDefinition {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from_ms: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub band_percent: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub signal: Option<String>,
}

impl MetricDefinition {
    pub fn of(expectation: &Expectation) -> Self {
        let metric = expectation.metric;
        Self {
            from_ms: expectation.from.filter(|_| metric.has_from_ms()).map(Time::ms),
            band_percent: metric.has_band().then_some(expectation.band_percent),
            signal: metric.has_signal().then(|| expectation.signal.to_owned()),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum EvidenceMethod {
    /// Student's t, for the mean of normal data.
    T,
    /// Chi-square, for the deviation of normal data.
    ChiSquare,
    /// The outer ends of BCa and of the studentised bootstrap, for data that are not normal.
    Bootstrap,
    /// Ranks of the sample, for quantiles.
    #[serde(rename = "order statistics")]
    OrderStatistics,
    /// Exact binomial bounds, for the share of trials that fail.
    ClopperPearson,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Evidence {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub method: Option<EvidenceMethod>,
    /// Bounds of the share of trials that break the limit, at the expectation's confidence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub failure_rate: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quantile: Option<f64>,
    /// Probability of detecting half or double of the expected deviation, for normal data.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub power: Option<f64>,
    /// Number of the look (evaluation of the trials so far) that decided, and number of planned
    /// looks.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub look: Option<[u32; 2]>,
    /// The evidence as a sentence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub says: Option<String>,
    /// Sensor that measured, if the true motion of the plate is not known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub observed: Option<String>,
}

impl Evidence {
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}
