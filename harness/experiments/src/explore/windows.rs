//! Divides a trial into changes and the quiet windows after them.

use crate::explore::scene::SceneTrial;

/// Interval in which inputs change. Start and end of a step are equal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Change {
    pub(crate) from_us: u32,
    pub(crate) to_us: u32,
    pub(crate) setpoint: bool,
    pub(crate) force: bool,
    pub(crate) temperature: bool,
}

/// A change, and the time without changes after it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Window {
    pub(crate) change: Change,
    pub(crate) until_us: u32,
}

impl Window {
    pub(crate) const fn quiet_us(&self) -> u32 {
        self.until_us.saturating_sub(self.change.to_us)
    }
}

fn changes(trial: &SceneTrial) -> Vec<Change> {
    let change = |[from_us, to_us]: [u32; 2], setpoint, force, temperature| Change {
        from_us,
        to_us: to_us.min(trial.duration_us),
        setpoint,
        force,
        temperature,
    };
    // The plate starts at rest, so the setpoint at the start is a step.
    let before = std::iter::once(0).chain(trial.setpoint.iter().map(|(_, level)| *level));
    let moved = trial.setpoint.iter().zip(before).filter(|((_, level), before)| level != before);
    let setpoints = moved.map(|((at, _), _)| change([*at; 2], true, false, false));
    let forces = trial.force.moves().into_iter().map(|ends| change(ends, false, true, false));
    let temperatures = trial.temperature.moves().into_iter().map(|ends| change(ends, false, false, true));
    let mut all: Vec<Change> = setpoints.chain(forces).chain(temperatures).collect();
    all.sort_by_key(|change| (change.from_us, change.to_us));
    let mut merged: Vec<Change> = Vec::with_capacity(all.len());
    for next in all {
        match merged.last_mut() {
            Some(last) if next.from_us <= last.to_us => {
                last.to_us = last.to_us.max(next.to_us);
                last.setpoint |= next.setpoint;
                last.force |= next.force;
                last.temperature |= next.temperature;
            }
            _ => merged.push(next),
        }
    }
    merged
}

pub(crate) fn windows(trial: &SceneTrial) -> Vec<Window> {
    let changes = changes(trial);
    let ends = changes.iter().skip(1).map(|next| next.from_us).chain([trial.duration_us]);
    changes.iter().zip(ends).map(|(change, until_us)| Window { change: *change, until_us }).collect()
}
