//! Checks that each expectation can fail and has only the options of its metric.

use super::checker::{Checker, TrialContext};
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::expect::{Aggregation, Expectation, Limit, Metric, SIGNALS};
use crate::scenario::raw::RawExpectation;
use platebench_plate::Time;
use std::collections::{HashMap, HashSet};

const DEFAULT_CONFIDENCE: f64 = 0.95;
const DEFAULT_BAND_PERCENT: f64 = 5.0;
const DEFAULT_TOLERANCE_PERCENT: f64 = 5.0;
const DEFAULT_QUANTILE: f64 = 0.95;

pub(super) fn expectation_names(raw: &[RawExpectation]) -> Vec<String> {
    let mut counts = HashMap::<String, usize>::new();
    let name = |expect: &RawExpectation| {
        let RawExpectation { name, metric, .. } = expect;
        if let Some(name) = name {
            return name.clone();
        }
        let count = counts.entry(metric.clone()).or_default();
        *count += 1;
        if *count == 1 { metric.clone() } else { format!("{metric} {count}") }
    };
    raw.iter().map(name).collect()
}

impl Checker<'_> {
    pub(super) fn check_names(&self, raw: &[RawExpectation], expectations: &[Expectation]) -> Result<(), Diagnostic> {
        let mut known = HashSet::new();
        let twice = expectations.iter().position(|expectation| !known.insert(&expectation.name));
        let Some((twice, name)) = twice.and_then(|twice| Some((twice, &expectations.get(twice)?.name))) else {
            return Ok(());
        };
        // A default name cannot be changed, so the error points at the explicit one.
        let explicit = |(_, expect): &(usize, &RawExpectation)| expect.name.as_ref() == Some(name);
        let index = raw.iter().enumerate().filter(explicit).map(|(index, _)| index).next_back().unwrap_or(twice);
        self.error(
            &format!("expect.{index}.name"),
            format!("another expectation has the name `{name}`, expected a unique name"),
        )
    }

    pub(super) fn expectation(
        &self,
        raw: &RawExpectation,
        name: String,
        trial: &TrialContext<'_>,
    ) -> Result<Expectation, Diagnostic> {
        let Some(metric) = Metric::from_name(&raw.metric) else {
            return self.unknown_name("metric", "unknown metric ", &raw.metric, Metric::NAMES);
        };
        let options = [
            ("band_percent", raw.band_percent.is_some(), metric.has_band()),
            ("from_ms", raw.from_ms.is_some(), metric.has_from_ms()),
            ("until_ms", raw.until_ms.is_some(), metric.has_from_ms()),
            ("window_ms", raw.window_ms.is_some(), metric.has_window_ms()),
            ("signal", raw.signal.is_some(), metric.has_signal()),
            ("tolerance_percent", raw.tolerance_percent.is_some(), raw.about.is_some() && metric.has_over()),
            ("over", raw.over.is_some(), metric.has_over()),
            ("quantile", raw.quantile.is_some(), raw.over.as_deref() == Some("quantile")),
        ];
        self.check_options(&format!("this expectation of {metric}"), &options)?;
        self.require(raw.paper.is_none_or(f64::is_finite), "paper", || "expected a finite number")?;
        let band_percent = raw.band_percent.unwrap_or(DEFAULT_BAND_PERCENT);
        self.require(band_percent > 0.0 && band_percent < 100.0, "band_percent", || {
            format!("{band_percent} %, expected above 0 and below 100")
        })?;
        let confidence = raw.confidence.unwrap_or(DEFAULT_CONFIDENCE);
        self.require((0.5..1.0).contains(&confidence), "confidence", || {
            format!("{confidence}, expected 0.5 or more and below 1")
        })?;
        self.one_line("name", &name)?;
        let column = raw.signal.as_deref().unwrap_or("amplitude_um");
        let signal = self.find_by_name("signal", "unknown signal ", column, SIGNALS.map(|signal| (signal, signal)))?;
        let (after, windows) = self.windows(raw, metric, trial)?;
        let tolerance_percent = raw.tolerance_percent.unwrap_or(DEFAULT_TOLERANCE_PERCENT);
        Ok(Expectation {
            name,
            windows,
            after,
            metric,
            limit: self.limit(raw, metric, tolerance_percent)?,
            tolerance_percent,
            paper: raw.paper,
            requirement: raw.requirement.clone(),
            confidence,
            aggregation: self.over(raw, metric)?,
            band_percent,
            from: raw.from_ms.and_then(Time::from_ms),
            signal,
        })
    }

    fn limit(&self, raw: &RawExpectation, metric: Metric, tolerance_percent: f64) -> Result<Limit, Diagnostic> {
        self.require(tolerance_percent.is_finite() && tolerance_percent > 0.0, "tolerance_percent", || {
            format!("{tolerance_percent} %, expected a finite number above 0")
        })?;
        let given = [
            ("at_most", raw.at_most.map(Limit::AtMost)),
            ("at_least", raw.at_least.map(Limit::AtLeast)),
            ("within", raw.within.map(|[low, high]| Limit::Within(low, high))),
            ("about", raw.about.map(Limit::About)),
        ];
        let mut limits = given.into_iter().filter_map(|(name, limit)| limit.map(|limit| (name, limit)));
        let (name, limit) = match (limits.next(), limits.next()) {
            (Some(only), None) => only,
            (first, second) => {
                let at = second.or(first).map_or("at_most", |(name, _)| name);
                return self.error(at, "expected exactly one of `at_most`, `at_least`, `within`, `about`");
            }
        };
        let numbers = match limit {
            Limit::AtMost(value) | Limit::AtLeast(value) | Limit::About(value) => [value, value],
            Limit::Within(low, high) => [low, high],
        };
        self.require(numbers.iter().all(|value| value.is_finite()), name, || "expected finite numbers")?;
        self.require(numbers[0] <= numbers[1], name, || "expected [low, high] with low not above high")?;
        let about_nothing = matches!(limit, Limit::About(value) if value <= 0.0);
        self.require(!about_nothing, name, || "expected a value above 0: the tolerance is a percentage of it")?;
        let (smallest, largest) = metric.value_range();
        let (low, high) = limit.range(tolerance_percent);
        let always = || match largest {
            f64::INFINITY => format!("{metric} is always {smallest} or more"),
            _ => format!("{metric} is always from {smallest} to {largest}"),
        };
        self.require(low <= largest && smallest <= high, name, || format!("{}: this can never be met", always()))?;
        self.require(smallest < low || high < largest, name, || format!("{}: this can never fail", always()))?;
        Ok(limit)
    }

    fn over(&self, raw: &RawExpectation, metric: Metric) -> Result<Aggregation, Diagnostic> {
        let quantile = raw.quantile.unwrap_or(DEFAULT_QUANTILE);
        self.require(quantile > 0.0 && quantile < 1.0, "quantile", || {
            format!("{quantile}, expected above 0 and below 1")
        })?;
        match raw.over.as_deref() {
            None => Ok(Aggregation::default_for(metric)),
            Some("each") => Ok(Aggregation::Each),
            Some("mean") => Ok(Aggregation::Mean),
            Some("quantile") => Ok(Aggregation::Quantile(quantile)),
            Some(name) => self.unknown_name("over", "", name, &Aggregation::NAMES),
        }
    }
}
