//! Defines limits and expectations.

use crate::metrics::{Metric, TrialRule, band_around};
use crate::scenario::window::{ChangingProfile, Window};
use platebench_plate::{Profile, Time};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Limit {
    AtMost(f64),
    AtLeast(f64),
    Within(f64, f64),
    /// Within the tolerance of the expectation around this value.
    About(f64),
}

impl Limit {
    /// Smallest and largest permitted value. Only [`Self::About`] uses `tolerance_percent`.
    pub fn range(self, tolerance_percent: f64) -> (f64, f64) {
        match self {
            Self::AtMost(high) => (f64::NEG_INFINITY, high),
            Self::AtLeast(low) => (low, f64::INFINITY),
            Self::Within(low, high) => (low, high),
            Self::About(value) => {
                let margin = value.abs() * tolerance_percent / 100.0;
                (value - margin, value + margin)
            }
        }
    }

    /// Distance of `value` from the limit, divided by a scale; negative if `value` breaks the
    /// limit. The scale is the limit itself, half of the range, or the tolerance. A scale of 0 is
    /// replaced by 1.
    pub fn margin(self, value: f64, tolerance_percent: f64) -> f64 {
        let over = |distance: f64, scale: f64| distance / if scale == 0.0 { 1.0 } else { scale.abs() };
        let (low, high) = self.range(tolerance_percent);
        match self {
            Self::AtMost(limit) => over(limit - value, limit),
            Self::AtLeast(limit) => over(value - limit, limit),
            Self::Within(..) | Self::About(_) => over((value - low).min(high - value), (high - low) / 2.0),
        }
    }
}

impl fmt::Display for Limit {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::AtMost(high) => write!(formatter, "≤ {high}"),
            Self::AtLeast(low) => write!(formatter, "≥ {low}"),
            Self::Within(low, high) => write!(formatter, "{low} … {high}"),
            Self::About(value) => write!(formatter, "≈ {value}"),
        }
    }
}

/// The statistic over trials that is compared with the limit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Aggregation {
    Each,
    Mean,
    /// Quantile at this share of the trials, for example 0.95.
    Quantile(f64),
    StandardDeviation,
}

impl Aggregation {
    pub const NAMES: [&str; 3] = ["each", "mean", "quantile"];

    pub const fn default_for(metric: Metric) -> Self {
        match metric.spec().trials {
            TrialRule::Deviation => Self::StandardDeviation,
            TrialRule::Mean => Self::Mean,
            TrialRule::Each | TrialRule::FromFirst => Self::Each,
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct Expectation {
    /// Unique name in the scenario. The default is the metric's name. From its second expectation
    /// on, a number follows: `ripple_um 2`.
    pub name: String,
    pub metric: Metric,
    pub limit: Limit,
    /// Tolerance of [`Limit::About`], percent of the value; not used for a standard deviation.
    pub tolerance_percent: f64,
    pub paper: Option<f64>,
    pub requirement: Option<String>,
    pub confidence: f64,
    pub aggregation: Aggregation,
    pub band_percent: f64,
    /// At least one, in rising order. The worst window decides. A mean is taken over each window.
    pub windows: Vec<Window>,
    pub after: Option<ChangingProfile>,
    pub from: Option<Time>,
    pub signal: &'static str,
    /// Empty for metrics without the key `text`.
    pub text: String,
    pub comparison: Comparison,
}

/// How the response of a trial is expected to differ from that of the first trial.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Comparison {
    pub amplitude_factor: f64,
    pub later: Time,
}

impl Comparison {
    pub const EQUAL: Self = Self { amplitude_factor: 1.0, later: Time::ZERO };
}

/// Columns of the trace that an expectation can judge.
pub const SIGNALS: [&str; 5] = ["amplitude_um", "wd_um", "wq_um", "sensed_wd_um", "sensed_wq_um"];

impl Expectation {
    /// Measures the amplitude in `window`; a band is 5 % of the setpoint. The limit is arbitrary.
    pub fn for_window(metric: Metric, window: Window) -> Self {
        Self {
            name: metric.name().to_owned(),
            windows: vec![window],
            after: None,
            metric,
            limit: Limit::AtMost(0.0),
            tolerance_percent: 0.0,
            paper: None,
            requirement: None,
            confidence: 0.95,
            aggregation: Aggregation::default_for(metric),
            band_percent: 5.0,
            from: None,
            signal: SIGNALS[0],
            text: String::new(),
            comparison: Comparison::EQUAL,
        }
    }

    pub fn range(&self) -> (f64, f64) {
        self.limit.range(self.tolerance_percent)
    }

    /// Margin as in [`Limit::margin`]. `None` if a standard deviation is compared with
    /// [`Limit::About`], because that is a statistical test without a tolerance.
    pub fn margin(&self, value: f64) -> Option<f64> {
        let is_agreement = self.aggregation == Aggregation::StandardDeviation && matches!(self.limit, Limit::About(_));
        (!is_agreement).then(|| self.limit.margin(value, self.tolerance_percent))
    }

    pub fn holds(&self, value: f64) -> bool {
        let (low, high) = self.range();
        (low..=high).contains(&value)
    }

    /// Lower and upper edge of the band. Both belong to the band.
    pub fn band(&self, setpoint: f64) -> (f64, f64) {
        band_around(setpoint, self.band_percent)
    }

    /// The values of the signal, µm, that keep the upper limit of an overshoot or a peak deviation
    /// in `window`. `now` is the setpoint, `profile` gives the setpoint at the ends of the window.
    /// `None` for other metrics and without an upper limit.
    pub fn limit_band(&self, profile: &Profile, window: &Window, now: f64) -> Option<(f64, f64)> {
        let (_, highest) = self.range();
        if !highest.is_finite() {
            return None;
        }
        match self.metric {
            Metric::PeakDeviation if now > 0.0 => Some(band_around(now, highest)),
            Metric::Overshoot => {
                let before =
                    |time: Time| time.as_nanos().checked_sub(1).map_or(0.0, |at| profile.at(Time::from_nanos(at)));
                let setpoint = before(window.to);
                let step = setpoint - before(window.from);
                let limit = setpoint + step * highest / 100.0;
                Some(if step < 0.0 { (limit, f64::INFINITY) } else { (f64::NEG_INFINITY, limit) })
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case(Limit::AtMost(2.0), 1.5, 0.25)]
    #[case(Limit::AtMost(2.0), 3.0, -0.5)]
    #[case(Limit::AtMost(-2.0), -3.0, 0.5)]
    #[case(Limit::AtMost(0.0), 0.5, -0.5)]
    #[case(Limit::AtLeast(2.0), 3.0, 0.5)]
    #[case(Limit::AtLeast(0.0), 3.0, 3.0)]
    #[case(Limit::Within(1.0, 3.0), 2.0, 1.0)]
    #[case(Limit::Within(1.0, 3.0), 2.5, 0.5)]
    #[case(Limit::Within(1.0, 3.0), 0.5, -0.5)]
    #[case(Limit::Within(2.0, 2.0), 5.0, -3.0)]
    #[case(Limit::About(10.0), 10.5, 0.5)]
    #[case(Limit::About(10.0), 12.0, -1.0)]
    #[case(Limit::About(0.0), 2.0, -2.0)]
    fn a_margin_is_the_distance_over_the_scale(#[case] limit: Limit, #[case] value: f64, #[case] expected: f64) {
        assert!((limit.margin(value, 10.0) - expected).abs() < 1e-12, "{}", limit.margin(value, 10.0));
    }
}
