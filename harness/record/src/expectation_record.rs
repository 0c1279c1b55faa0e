//! Records an expectation and its verdict.

use crate::reason::{self, Reason};
use crate::verdict::{Cause, Verdict};
use platebench_plate::Time;
use platebench_scenario::{Expectation, Limit, Metric};
use serde::{Deserialize, Serialize};

/// An expectation and its verdict.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExpectationRecord {
    /// Unique in the scenario; it does not depend on the limit.
    pub name: String,
    /// The measured quantity.
    pub metric: Metric,
    /// Its verdict.
    pub verdict: Verdict,
    /// The value that decided, see `statistic`; `None` if the deciding trial has no number.
    pub value: Option<f64>,
    /// Kind of the value.
    pub statistic: Statistic,
    /// The required range.
    pub limit: Limit,
    /// [`Statistic::Worst`]: smallest and largest over trials; otherwise bounds at `confidence`.
    pub interval: Option<[f64; 2]>,
    /// Confidence of each bound of the interval, or of the failure rate; `None` if nothing is
    /// random.
    pub confidence: Option<f64>,
    /// What made the verdict inconclusive.
    pub cause: Option<Cause>,
    /// Why it did not pass.
    #[serde(flatten, with = "reason::file_keys")]
    pub reason: Option<Reason>,
    /// The paper's value.
    pub paper: Option<f64>,
    /// Identifier of a requirement.
    pub requirement: Option<String>,
    /// The judged windows, ms; the worst one decides.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub windows_ms: Vec<[f64; 2]>,
    /// Options of the metric.
    #[serde(flatten)]
    pub definition: MetricDefinition,
    /// Statistics of the trials.
    #[serde(default, skip_serializing_if = "Evidence::is_empty")]
    pub evidence: Evidence,
}

/// What the value of an expectation is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Statistic {
    /// The worst trial.
    Worst,
    /// The mean over trials.
    Mean,
    /// A quantile over trials, see [`Evidence::quantile`].
    Quantile,
    /// The standard deviation over trials.
    Deviation,
}

/// The options of a scenario that define a metric, if the metric has them.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct MetricDefinition {
    /// Start of the judged part, ms.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from_ms: Option<f64>,
    /// Half width of the band around the setpoint, percent of the setpoint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub band_percent: Option<f64>,
    /// Column of the trace.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub signal: Option<String>,
}

impl MetricDefinition {
    /// The options of `expectation` that define its metric.
    pub fn of(expectation: &Expectation) -> Self {
        let metric = expectation.metric;
        Self {
            from_ms: expectation.from.filter(|_| metric.has_from()).map(Time::ms),
            band_percent: metric.has_band().then_some(expectation.band_percent),
            signal: metric.has_signal().then(|| expectation.signal.to_owned()),
        }
    }
}

/// How bounds are computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EvidenceMethod {
    /// Student's t, for the mean of normal data.
    T,
    /// Chi-square, for the deviation of normal data.
    ChiSquare,
    /// Resampling, for data that are not normal: the outer ends of BCa and of the studentised
    /// bootstrap.
    Bootstrap,
    /// Ranks of the sample, for quantiles.
    #[serde(rename = "order statistics")]
    OrderStatistics,
    /// Exact binomial bounds, for the share of trials that fail.
    ClopperPearson,
}

/// Statistics of the trials. Only what applies is present.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Evidence {
    /// How the bounds were computed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub method: Option<EvidenceMethod>,
    /// Bounds of the share of trials that break the limit, at the expectation's confidence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub failure_rate: Option<[f64; 2]>,
    /// Which quantile was judged.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quantile: Option<f64>,
    /// Probability, for normal data, to detect that the truth is half or double of the expected
    /// value; the smaller one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub power: Option<f64>,
    /// Number of the planned look that decided, and how many are planned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub look: Option<[u32; 2]>,
    /// All of this as a sentence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub says: Option<String>,
    /// Which observer measured, if not the true motion of the plate is judged.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub observed: Option<String>,
}

impl Evidence {
    /// True if nothing is present.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}
