//! Derives the windows in which an expectation is judged.

use crate::metrics::{Metric, WindowRule};
use platebench_plate::{Profile, Time};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    pub from: Time,
    /// End of the window, exclusive; at most the end of the trial.
    pub to: Time,
}

impl Window {
    pub fn contains(&self, time: Time) -> bool {
        self.from <= time && time < self.to
    }

    /// Default window of a mean.
    #[must_use]
    pub fn last_third(self) -> Self {
        Self { from: self.from + Time::from_nanos((self.to - self.from).as_nanos() / 3 * 2), to: self.to }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::IntoStaticStr)]
#[strum(const_into_str, serialize_all = "lowercase")]
pub enum ChangingProfile {
    Setpoint,
    Force,
    Temperature,
}

impl ChangingProfile {
    pub const ALL: [Self; 3] = [Self::Setpoint, Self::Force, Self::Temperature];

    pub const fn name(self) -> &'static str {
        self.into_str()
    }

    /// True if the metric can be judged after each change of the profile.
    pub const fn applies_to(self, metric: Metric) -> bool {
        match metric.spec().window {
            WindowRule::WholeTrial | WindowRule::FromDisturbance | WindowRule::SetpointZero => false,
            WindowRule::StepResponse => matches!(self, Self::Setpoint),
            WindowRule::Any | WindowRule::Required | WindowRule::ConstantSetpoint => metric.has_over(),
        }
    }
}

#[derive(Debug, Clone)]
pub(crate) struct ProfileChanges {
    /// Instants at which setpoint, force and temperature change, in rising order.
    starts: [Vec<Time>; 3],
    all: Vec<Time>,
    duration: Time,
}

impl ProfileChanges {
    /// The plate starts at rest. Therefore an initial setpoint is a change; an initial force or
    /// temperature is not.
    pub(crate) fn new(setpoint: &Profile, force: &Profile, temperature: &Profile, duration: Time) -> Self {
        let starts = [(setpoint, true), (force, false), (temperature, false)].map(|(profile, from_rest)| {
            let mut starts = change_starts(profile, from_rest);
            starts.retain(|start| *start < duration);
            starts
        });
        let mut all = starts.concat();
        all.sort_unstable();
        all.dedup();
        Self { starts, all, duration }
    }

    pub(crate) fn starts(&self, profile: ChangingProfile) -> &[Time] {
        let [setpoint, force, temperature] = &self.starts;
        match profile {
            ChangingProfile::Setpoint => setpoint,
            ChangingProfile::Force => force,
            ChangingProfile::Temperature => temperature,
        }
    }

    /// Windows from each change of `profile` to the next change of any profile or the end.
    pub(crate) fn windows(&self, profile: ChangingProfile) -> impl Iterator<Item = Window> + '_ {
        self.starts(profile).iter().map(|&from| {
            let next = self.all.get(self.all.partition_point(|start| *start <= from));
            Window { from, to: next.copied().unwrap_or(self.duration) }
        })
    }

    /// Window from the last setpoint change at or before `from` to the next one or the end of the
    /// trial. If no change precedes `from`, the window starts at the first one.
    pub(crate) fn response_window(&self, from: Option<Time>) -> Option<Window> {
        let starts = self.starts(ChangingProfile::Setpoint);
        let passed = from.map_or(0, |from| starts.partition_point(|start| *start <= from));
        let chosen = passed.saturating_sub(1);
        let to = starts.get(chosen + 1).copied().unwrap_or(self.duration);
        starts.get(chosen).map(|&from| Window { from, to })
    }
}

/// Instants at which a change starts. Connected segments of a `linear` profile that are not
/// constant are one change. A sine is one change.
fn change_starts(profile: &Profile, from_rest: bool) -> Vec<Time> {
    let at_start = from_rest && profile.at(Time::ZERO) != 0.0;
    let mut starts = if at_start { vec![Time::ZERO] } else { Vec::new() };
    match profile {
        Profile::Hold(points) => {
            let pairs = points.array_windows();
            starts.extend(pairs.filter(|[before, after]| before.1 != after.1).map(|[_, after]| after.0));
        }
        Profile::Linear(points) => {
            let mut moved = false;
            for [before, after] in points.array_windows() {
                let moves = before.1 != after.1;
                if moves && !moved && starts.last() != Some(&before.0) {
                    starts.push(before.0);
                }
                moved = moves;
            }
        }
        Profile::Sine { amplitude, .. } if *amplitude != 0.0 && !at_start => starts.push(Time::ZERO),
        Profile::Sine { .. } => {}
    }
    starts
}

#[cfg(test)]
mod tests;
