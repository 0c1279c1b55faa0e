//! Checks that the window of an expectation is inside the trial and contains something to judge.

use super::checker::{Checker, TrialContext};
use crate::metrics::{Metric, WindowRule};
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::fault::Fault;
use crate::scenario::raw::{RawExpectation, RawWindow};
use crate::scenario::window::{ChangingProfile, Window};
use platebench_plate::{Profile, Time};

/// End of the interval in which a controller that stops after `from` must stay at 0 V. A fault with
/// `reconfigure` starts the controller again at its own end.
fn reconfiguration_time(faults: &[Fault], from: Time, duration: Time) -> Time {
    let ends = faults.iter().filter(|fault| fault.reconfigure).filter_map(|fault| fault.until);
    ends.filter(|until| *until > from).fold(duration, Time::min)
}

/// The parts of `window` in which the setpoint is 0 and the controller has had time to follow it.
fn windows_at_setpoint_zero(window: Window, trial: &TrialContext<'_>) -> Vec<Window> {
    let Profile::Hold(points) = trial.setpoint else { return Vec::new() };
    let ends = points.iter().skip(1).map(|point| point.0).chain([trial.duration]);
    let starts = points.iter().enumerate().map(|(index, point)| if index == 0 { Time::ZERO } else { point.0 });
    let levels = starts.zip(ends).zip(points.iter().map(|point| point.1));
    let rests = levels
        .filter(|(_, level)| *level == 0.0)
        .map(|((from, to), _)| Window { from: (from + trial.response_delay).max(window.from), to: to.min(window.to) });
    rests.filter(|rest| rest.from < rest.to).collect()
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
mod tests;
