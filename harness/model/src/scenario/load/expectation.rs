//! Checks that each expectation can fail and has only the options of its metric.

use super::checker::{Checker, TrialContext};
use crate::metrics::Metric;
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::expect::{Aggregation, Expectation, Limit, SIGNALS};
use crate::scenario::raw::{
    DEFAULT_BAND_PERCENT, DEFAULT_CONFIDENCE, DEFAULT_QUANTILE, DEFAULT_SIGNAL, DEFAULT_TOLERANCE_PERCENT, METRIC_KEYS,
    RawExpectation, keys_of,
};
use platebench_plate::Time;
use std::collections::{HashMap, HashSet};

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
        let given = keys_of(raw);
        let has = |key: &str| given.iter().any(|given| given == key);
        let excluded = METRIC_KEYS.iter().filter(|(_, applies)| !applies(metric)).map(|(key, _)| *key);
        let excluded = excluded
            .chain(raw.about.is_none().then_some("tolerance_percent"))
            .chain((raw.over.as_deref() != Some("quantile")).then_some("quantile"));
        if let Some(key) = excluded.into_iter().find(|key| has(key)) {
            return self.error(key, format!("`{key}` does not apply to this expectation of {metric}"));
        }
        self.one_line("name", &name)?;
        let column = raw.signal.as_deref().unwrap_or(DEFAULT_SIGNAL);
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
            confidence: raw.confidence.unwrap_or(DEFAULT_CONFIDENCE),
            aggregation: self.over(raw, metric)?,
            band_percent: raw.band_percent.unwrap_or(DEFAULT_BAND_PERCENT),
            from: raw.from_ms.and_then(Time::from_ms),
            signal,
        })
    }

    fn limit(&self, raw: &RawExpectation, metric: Metric, tolerance_percent: f64) -> Result<Limit, Diagnostic> {
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
        self.require(numbers[0] <= numbers[1], name, || "expected [low, high] with low not above high")?;
        let (smallest, largest) = metric.spec().value_range;
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
        match raw.over.as_deref() {
            None => Ok(Aggregation::default_for(metric)),
            Some("each") => Ok(Aggregation::Each),
            Some("mean") => Ok(Aggregation::Mean),
            Some("quantile") => Ok(Aggregation::Quantile(quantile)),
            Some(name) => self.unknown_name("over", "", name, &Aggregation::NAMES),
        }
    }
}
