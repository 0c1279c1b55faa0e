//! What a scenario may expect: limits that can be failed, options that mean something, windows within the trial.

use super::{Checker, Play, quoted};
use crate::diagnostic::{Diagnostic, suggestion};
use crate::expect::{Expectation, Limit, Metric, Over, SIGNALS, Window};
use crate::fault::Fault;
use crate::raw::{RawExpectation, RawWindow};
use platebench_plate::{Profile, Time};

const DEFAULT_CONFIDENCE: f64 = 0.95;
const DEFAULT_BAND_PERCENT: f64 = 5.0;
const DEFAULT_TOLERANCE_PERCENT: f64 = 5.0;
const DEFAULT_QUANTILE: f64 = 0.95;

/// Until when a controller that stops after `from` has to stay at 0 V: to the end, or until the bench configures it anew.
fn reconfigured(faults: &[Fault], from: Time, duration: Time) -> Time {
    let ends = faults.iter().filter(|fault| fault.reconfigure).filter_map(|fault| fault.until);
    ends.filter(|until| *until > from).fold(duration, Time::min)
}

impl Checker<'_> {
    pub(super) fn expectation(
        &self,
        index: usize,
        raw: &RawExpectation,
        Play { duration, setpoint, faults }: Play<'_>,
    ) -> Result<Expectation, Diagnostic> {
        let key = |name: &str| format!("expect.{index}.{name}");
        let Some(metric) = Metric::from_name(&raw.metric) else {
            let known = quoted(Metric::ALL.map(Metric::name));
            let hint = suggestion(&raw.metric, Metric::ALL.map(Metric::name));
            return self
                .refuse(&key("metric"), format!("unknown metric `{}`, expected one of {known}{hint}", raw.metric));
        };
        for (name, given, used) in [
            ("band_percent", raw.band_percent.is_some(), metric.has_band()),
            ("from_ms", raw.from_ms.is_some(), metric.has_from()),
            ("window_ms", raw.window_ms.is_some(), metric.has_window()),
            ("signal", raw.signal.is_some(), metric.has_signal()),
            (
                "tolerance_percent",
                raw.tolerance_percent.is_some(),
                raw.about.is_some() && metric != Metric::Repeatability,
            ),
            ("over", raw.over.is_some(), metric != Metric::Repeatability),
            ("quantile", raw.quantile.is_some(), raw.over.as_deref() == Some("quantile")),
        ] {
            self.require(used || !given, &key(name), || {
                format!("`{name}` means nothing to this expectation of {metric}")
            })?;
        }
        self.require(raw.paper.is_none_or(f64::is_finite), &key("paper"), || "expected a finite number".to_owned())?;
        let band_percent = raw.band_percent.unwrap_or(DEFAULT_BAND_PERCENT);
        self.require(band_percent > 0.0 && band_percent < 100.0, &key("band_percent"), || {
            format!("{band_percent} %, expected above 0 and below 100")
        })?;
        let confidence = raw.confidence.unwrap_or(DEFAULT_CONFIDENCE);
        self.require((0.5..1.0).contains(&confidence), &key("confidence"), || {
            format!("{confidence}, expected 0.5 or more and below 1")
        })?;
        let from = raw.from_ms.map(|ms| self.span(&key("from_ms"), ms)).transpose()?;
        self.require(from.is_none_or(|from| from < duration), &key("from_ms"), || {
            format!("{} ms, expected before the scenario's end at {duration}", raw.from_ms.unwrap_or_default())
        })?;
        let needs_from = matches!(metric, Metric::RecoveryTime | Metric::ShutdownTime);
        self.require(from.is_some() || !needs_from, &key("from_ms"), || {
            format!("{metric} without `from_ms`, expected the instant of the disturbance")
        })?;
        let name = raw.signal.as_deref().unwrap_or("amplitude_um");
        let Some(signal) = SIGNALS.into_iter().find(|signal| *signal == name) else {
            let (known, hint) = (quoted(SIGNALS), suggestion(name, SIGNALS));
            return self.refuse(&key("signal"), format!("unknown signal `{name}`, expected one of {known}{hint}"));
        };
        let window = self.window(&key("window_ms"), raw.window_ms, duration)?;
        if metric.has_window() {
            self.steady_window(&key("window_ms"), window, setpoint)?;
        }
        let window = match from {
            Some(from) if metric == Metric::ShutdownTime => Window { from, to: reconfigured(faults, from, duration) },
            _ => window,
        };
        Ok(Expectation {
            metric,
            limit: self.limit(&key, raw, metric)?,
            paper: raw.paper,
            requirement: raw.requirement.clone(),
            confidence,
            over: self.over(&key, raw, metric)?,
            band_percent,
            from,
            window,
            signal,
        })
    }

    fn limit(&self, key: &impl Fn(&str) -> String, raw: &RawExpectation, metric: Metric) -> Result<Limit, Diagnostic> {
        let tolerance_percent = raw.tolerance_percent.unwrap_or(DEFAULT_TOLERANCE_PERCENT);
        self.require(tolerance_percent.is_finite() && tolerance_percent > 0.0, &key("tolerance_percent"), || {
            format!("{tolerance_percent} %, expected a finite number above 0")
        })?;
        let given = [
            ("at_most", raw.at_most.map(Limit::AtMost)),
            ("at_least", raw.at_least.map(Limit::AtLeast)),
            ("within", raw.within.map(|[low, high]| Limit::Within(low, high))),
            ("about", raw.about.map(|value| Limit::About { value, tolerance_percent })),
        ];
        let mut limits = given.into_iter().filter_map(|(name, limit)| limit.map(|limit| (name, limit)));
        let (name, limit) = match (limits.next(), limits.next()) {
            (Some(only), None) => only,
            (first, second) => {
                let at = second.or(first).map_or("at_most", |(name, _)| name);
                return self.refuse(&key(at), "expected exactly one of `at_most`, `at_least`, `within`, `about`");
            }
        };
        let numbers = match limit {
            Limit::AtMost(value) | Limit::AtLeast(value) | Limit::About { value, .. } => [value, value],
            Limit::Within(low, high) => [low, high],
        };
        self.require(numbers.iter().all(|value| value.is_finite()), &key(name), || {
            "expected finite numbers".to_owned()
        })?;
        self.require(numbers[0] <= numbers[1], &key(name), || {
            "expected [low, high] with low not above high".to_owned()
        })?;
        // A tolerance in percent of 0 is 0, and so is half of it and double.
        let about_nothing = matches!(limit, Limit::About { value, .. } if value <= 0.0);
        self.require(!about_nothing, &key(name), || "expected a value above 0 to agree with".to_owned())?;
        let (smallest, largest) = metric.possible();
        let (low, high) = limit.range();
        let always = || match largest {
            f64::INFINITY => format!("{metric} is always {smallest} or more"),
            _ => format!("{metric} is always from {smallest} to {largest}"),
        };
        self.require(low <= largest && smallest <= high, &key(name), || {
            format!("{}: this can never be met", always())
        })?;
        self.require(smallest < low || high < largest, &key(name), || format!("{}: this can never fail", always()))?;
        Ok(limit)
    }

    fn over(&self, key: &impl Fn(&str) -> String, raw: &RawExpectation, metric: Metric) -> Result<Over, Diagnostic> {
        let quantile = raw.quantile.unwrap_or(DEFAULT_QUANTILE);
        self.require(quantile > 0.0 && quantile < 1.0, &key("quantile"), || {
            format!("{quantile}, expected above 0 and below 1")
        })?;
        match raw.over.as_deref() {
            None => Ok(Over::default_of(metric)),
            Some("each") => Ok(Over::Each),
            Some("mean") => Ok(Over::Mean),
            Some("quantile") => Ok(Over::Quantile(quantile)),
            Some(name) => {
                let (known, hint) = (quoted(Over::NAMES), suggestion(name, Over::NAMES));
                self.refuse(&key("over"), format!("`{name}`, expected one of {known}{hint}"))
            }
        }
    }

    fn window(&self, key: &str, raw: Option<RawWindow>, duration: Time) -> Result<Window, Diagnostic> {
        let window = match raw {
            None => Window { from: Time::from_nanos(duration.as_nanos() / 3 * 2), to: duration },
            Some(RawWindow::Last(ms)) => {
                let length = self.span(key, self.positive(key, ms)?)?;
                self.require(length <= duration, key, || {
                    format!("a window of {length}, expected at most the scenario's {duration}")
                })?;
                Window { from: duration - length, to: duration }
            }
            Some(RawWindow::Between([from, to])) => Window { from: self.span(key, from)?, to: self.span(key, to)? },
        };
        self.require(window.from < window.to && window.to <= duration, key, || {
            format!(
                "a window from {} to {}, expected a stretch within the scenario's {duration}",
                window.from, window.to
            )
        })?;
        Ok(window)
    }

    /// A mean over a moving setpoint could come out right for a signal that never moved.
    fn steady_window(&self, key: &str, window: Window, setpoint: &Profile) -> Result<(), Diagnostic> {
        let level = setpoint.at(window.from);
        let before_end = Time::from_nanos(window.to.as_nanos() - 1);
        let points =
            std::iter::successors(setpoint.next_point_after(window.from), |point| setpoint.next_point_after(*point));
        let mut inside = points.take_while(|point| *point < window.to).chain([before_end]);
        let swings = matches!(setpoint, Profile::Sine { amplitude, .. } if *amplitude != 0.0);
        self.require(!swings && inside.all(|time| setpoint.at(time) == level), key, || {
            format!("the setpoint moves between {} and {}, expected a window in which it rests", window.from, window.to)
        })?;
        self.require(level > 0.0, key, || {
            format!("the setpoint is 0 between {} and {}, expected one to relate the mean to", window.from, window.to)
        })
    }
}
