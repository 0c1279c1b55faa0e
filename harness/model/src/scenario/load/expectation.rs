//! Checks that each expectation can fail, has only the keys of its metric, and has a window inside
//! the trial that contains something to judge.

use crate::metrics::Metric;
use crate::metrics::WindowRule;
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::expect::{Aggregation, Comparison, Expectation, Limit, SIGNALS};
use crate::scenario::fault::Fault;
use crate::scenario::load::checker::{Checker, TrialContext};
use crate::scenario::raw::{
    DEFAULT_BAND_PERCENT, DEFAULT_CONFIDENCE, DEFAULT_QUANTILE, DEFAULT_SIGNAL, DEFAULT_TOLERANCE_PERCENT, METRIC_KEYS,
    RawExpectation, RawWindow,
};
use crate::scenario::window::{ChangingProfile, Window};
use platebench_plate::{Profile, Time};
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
        let applies_to_limits = |key: &str| match key {
            "tolerance_percent" => raw.about.is_some(),
            "quantile" => raw.over.as_deref() == Some("quantile"),
            _ => true,
        };
        let excluded = METRIC_KEYS
            .iter()
            .find(|(key, applies, is_given)| is_given(raw) && !(applies(metric) && applies_to_limits(key)));
        if let Some((key, ..)) = excluded {
            return self.error(key, format!("`{key}` does not apply to this expectation of {metric}"));
        }
        self.one_line("name", &name)?;
        let column = raw.signal.as_deref().unwrap_or(DEFAULT_SIGNAL);
        let signal = self.find_by_name("signal", "unknown signal ", column, SIGNALS.map(|signal| (signal, signal)))?;
        self.require(raw.text.is_some() || !metric.has_text(), "metric", || {
            format!("{metric} without `text`, expected the text that the firmware writes")
        })?;
        if let Some(text) = &raw.text {
            self.one_line("text", text)?;
        }
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
            text: raw.text.clone().unwrap_or_default(),
            comparison: Comparison::EQUAL,
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

/// End of the interval in which a controller that stops after `from` must stay at 0 V. A fault with
/// `reconfigure` starts the controller again at its own end.
fn reconfiguration_time(faults: &[Fault], from: Time, duration: Time) -> Time {
    let ends = faults.iter().filter(|fault| fault.reconfigure).filter_map(|fault| fault.until);
    ends.filter(|until| *until > from).fold(duration, Time::min)
}

/// The parts of `window` in which the setpoint is 0 and the controller has had time to follow it.
fn windows_at_setpoint_zero(window: Window, trial: &TrialContext<'_>) -> Vec<Window> {
    let (points, is_linear) = match trial.setpoint {
        Profile::Hold(points) => (points, false),
        Profile::Linear(points) => (points, true),
        Profile::Sine { .. } => return Vec::new(),
    };
    // Before its first point a profile is constant.
    let start = points.first().map(|point| (Time::ZERO, point.1));
    let points: Vec<_> = start.into_iter().chain(points.iter().skip(usize::from(!is_linear)).copied()).collect();
    let ends = points.iter().skip(1).copied().chain(points.last().map(|point| (trial.duration, point.1)));
    let mut rests: Vec<Window> = Vec::new();
    for (start, end) in points.iter().zip(ends).filter(|(start, end)| start.1 == 0.0 && (!is_linear || end.1 == 0.0)) {
        match rests.last_mut() {
            Some(last) if last.to == start.0 => last.to = end.0,
            _ => rests.push(Window { from: start.0, to: end.0 }),
        }
    }
    let judged =
        |rest: Window| Window { from: (rest.from + trial.response_delay).max(window.from), to: rest.to.min(window.to) };
    rests.into_iter().map(judged).filter(|rest| rest.from < rest.to).collect()
}

impl Checker<'_> {
    pub(super) fn windows(
        &self,
        raw: &RawExpectation,
        metric: Metric,
        trial: &TrialContext<'_>,
    ) -> Result<(Option<ChangingProfile>, Vec<Window>), Diagnostic> {
        let bounded = raw.from_ms.is_some() || raw.until_ms.is_some();
        self.require(
            raw.after.is_none() || !bounded,
            "after",
            || "`after` with `from_ms` or `until_ms`, expected only one of both",
        )?;
        self.require(
            raw.window_ms.is_none() || !(bounded || raw.after.is_some()),
            "window_ms",
            || "`window_ms` with `from_ms`, `until_ms` or `after`, expected only one of both",
        )?;
        let needs_window = metric.spec().window == WindowRule::Required;
        self.require(bounded || raw.after.is_some() || !needs_window, "metric", || {
            format!("{metric} without a window, expected `from_ms`, `until_ms` or `after`")
        })?;
        if let Some(name) = &raw.after {
            let profile = self.changing_profile(name, metric)?;
            let windows = self.windows_after("after", profile, metric, trial)?;
            return Ok((Some(profile), windows));
        }
        let window = self.bounded_window(raw, metric, trial)?;
        if metric.spec().window == WindowRule::SetpointZero {
            let windows = windows_at_setpoint_zero(window, trial);
            self.require(!windows.is_empty(), "metric", || {
                format!("the setpoint is never 0 for longer than {}, expected a longer time at 0", trial.response_delay)
            })?;
            return Ok((None, windows));
        }
        Ok((None, vec![window]))
    }

    fn changing_profile(&self, name: &str, metric: Metric) -> Result<ChangingProfile, Diagnostic> {
        let all = ChangingProfile::ALL.map(|profile| (profile.name(), profile));
        let profile = self.find_by_name("after", "unknown profile ", name, all)?;
        self.require(profile.applies_to(metric), "after", || {
            format!("`after = \"{name}\"` does not apply to {metric}")
        })?;
        Ok(profile)
    }

    fn windows_after(
        &self,
        key: &str,
        profile: ChangingProfile,
        metric: Metric,
        trial: &TrialContext<'_>,
    ) -> Result<Vec<Window>, Diagnostic> {
        let name = profile.name();
        self.require(!trial.changes.starts(profile).is_empty(), key, || {
            format!("the {name} never changes in the trial, expected a profile that changes")
        })?;
        let before_end = |window: &Window| Time::from_nanos(window.to.as_nanos() - 1);
        let mut windows: Vec<Window> = trial.changes.windows(profile).collect();
        if metric.spec().needs_setpoint {
            windows.retain(|window| trial.setpoint.at(before_end(window)) != 0.0);
        }
        self.require(!windows.is_empty(), key, || {
            format!("the setpoint is 0 after every change of the {name}, expected one above 0")
        })?;
        if metric.has_window_ms() {
            for window in &mut windows {
                *window = window.last_third();
            }
            for window in &windows {
                self.steady_window(key, *window, metric, trial.setpoint)?;
            }
        }
        Ok(windows)
    }

    fn bounded_window(
        &self,
        raw: &RawExpectation,
        metric: Metric,
        trial: &TrialContext<'_>,
    ) -> Result<Window, Diagnostic> {
        let duration = trial.duration;
        let time = |name: &str, ms: Option<f64>| ms.map(|ms| self.time_from_ms(name, ms)).transpose();
        let (from, until) = (time("from_ms", raw.from_ms)?, time("until_ms", raw.until_ms)?);
        self.require(from.is_none_or(|from| from < duration), "from_ms", || {
            format!("{} ms, expected before the scenario's end at {duration}", raw.from_ms.unwrap_or_default())
        })?;
        let start = from.unwrap_or(Time::ZERO);
        self.require(until.is_none_or(|until| start < until && until <= duration), "until_ms", || {
            format!(
                "{} ms, expected after {start} and at most the scenario's end at {duration}",
                raw.until_ms.unwrap_or_default()
            )
        })?;
        let bounded = from.is_some() || until.is_some();
        let mut window = Window { from: start, to: until.unwrap_or(duration) };
        if metric.spec().window == WindowRule::StepResponse {
            // If the setpoint has no step, the verdict reports that there is nothing to measure.
            let response = trial.changes.response_window(from).unwrap_or(window);
            window = Window { from: response.from, to: until.unwrap_or(response.to) };
            self.require(window.from < window.to, "until_ms", || {
                format!("the window ends at {}, expected after the setpoint step at {}", window.to, window.from)
            })?;
        } else if metric.spec().window == WindowRule::FromDisturbance {
            self.require(from.is_some(), "from_ms", || {
                format!("{metric} without `from_ms`, expected the instant of the disturbance")
            })?;
            window.to = window.to.min(reconfiguration_time(trial.faults, start, duration));
        } else if metric.has_window_ms() {
            let key = if bounded { "from_ms" } else { "window_ms" };
            if !bounded {
                window = self.mean_window(key, raw.window_ms, duration)?;
            }
            self.steady_window(key, window, metric, trial.setpoint)?;
        }
        Ok(window)
    }

    fn mean_window(&self, key: &str, raw: Option<RawWindow>, duration: Time) -> Result<Window, Diagnostic> {
        let window = match raw {
            None => Window { from: Time::ZERO, to: duration }.last_third(),
            Some(RawWindow::Last(ms)) => {
                let length = self.time_from_ms(key, ms)?;
                self.require(length <= duration, key, || {
                    format!("a window of {length}, expected at most the scenario's {duration}")
                })?;
                Window { from: duration - length, to: duration }
            }
            Some(RawWindow::Between([from, to])) => {
                Window { from: self.time_from_ms(key, from)?, to: self.time_from_ms(key, to)? }
            }
        };
        self.require(window.from < window.to && window.to <= duration, key, || {
            format!(
                "a window from {} to {}, expected an interval within the scenario's {duration}",
                window.from, window.to
            )
        })?;
        Ok(window)
    }

    /// Rejects a changing setpoint, because a constant signal could have the same mean.
    fn steady_window(&self, key: &str, window: Window, metric: Metric, setpoint: &Profile) -> Result<(), Diagnostic> {
        let level = setpoint.at(window.from);
        let before_end = Time::from_nanos(window.to.as_nanos() - 1);
        let points =
            std::iter::successors(setpoint.next_point_after(window.from), |point| setpoint.next_point_after(*point));
        let mut inside = points.take_while(|point| *point < window.to).chain([before_end]);
        let swings = matches!(setpoint, Profile::Sine { amplitude, .. } if *amplitude != 0.0);
        self.require(!swings && inside.all(|time| setpoint.at(time) == level), key, || {
            format!(
                "the setpoint changes between {} and {}, expected a window in which it is constant",
                window.from, window.to
            )
        })?;
        self.require(level > 0.0 || !metric.spec().needs_setpoint, key, || {
            format!("the setpoint is 0 between {} and {}, expected one above 0", window.from, window.to)
        })
    }
}

#[cfg(test)]
mod expectation_window_tests;
