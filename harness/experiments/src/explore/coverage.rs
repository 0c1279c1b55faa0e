//! Counts what the scenes cover: value ranges, pairs of changes, histories.

use crate::explore::envelope::Envelope;
use crate::explore::properties::{Change, PropertyWindow, windows};
use crate::explore::scene::{Scene, SceneTrial};
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::BTreeMap;
use std::f64::consts::TAU;

const BINS: usize = 10;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, strum::VariantArray, strum::IntoStaticStr)]
#[strum(const_into_str, serialize_all = "snake_case")]
pub enum ChangeKind {
    Up,
    Down,
    /// The setpoint falls to 0.
    Rest,
    /// The setpoint rises from 0.
    Start,
    /// The setpoint changes at a constant rate.
    Ramp,
    Press,
    Lift,
    Heat,
    Cool,
    Several,
}

impl ChangeKind {
    pub const ALL: &[Self] = <Self as strum::VariantArray>::VARIANTS;

    pub const fn name(self) -> &'static str {
        self.into_str()
    }

    fn of(trial: &SceneTrial, window: &PropertyWindow) -> Self {
        let change = window.change;
        let before = change.from_us.saturating_sub(1);
        let rises = |from: f64, to: f64| to > from;
        let setpoint_before = if change.from_us == 0 { 0.0 } else { trial.setpoint_at(before) };
        let setpoint = trial.setpoint_at(change.to_us);
        match (change.setpoint, change.force, change.temperature) {
            (true, false, false) if change.is_setpoint_ramp() => Self::Ramp,
            (true, false, false) if setpoint == 0.0 => Self::Rest,
            (true, false, false) if setpoint_before == 0.0 => Self::Start,
            (true, false, false) if rises(setpoint_before, setpoint) => Self::Up,
            (true, false, false) => Self::Down,
            (false, true, false) if rises(trial.force_at(before), trial.force_at(change.to_us)) => Self::Press,
            (false, true, false) => Self::Lift,
            (false, false, true) if rises(trial.temperature_at(before), trial.temperature_at(change.to_us)) => {
                Self::Heat
            }
            (false, false, true) => Self::Cool,
            _ => Self::Several,
        }
    }
}

/// How often the values of a quantity were in each tenth of its range.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct RangeCoverage {
    pub quantity: &'static str,
    pub range: [f64; 2],
    pub counts: [u64; BINS],
}

#[derive(Debug, Clone, Default)]
pub struct ExplorationCoverage {
    ranges: BTreeMap<&'static str, RangeCoverage>,
    pairs: BTreeMap<(ChangeKind, ChangeKind), u64>,
    /// Number of scenes by number of earlier trials.
    pub histories: BTreeMap<usize, u64>,
}

impl ExplorationCoverage {
    pub fn ranges(&self) -> impl Iterator<Item = &RangeCoverage> {
        self.ranges.values()
    }

    /// How often `second` followed `first`.
    pub fn pair(&self, first: ChangeKind, second: ChangeKind) -> u64 {
        self.pairs.get(&(first, second)).copied().unwrap_or(0)
    }

    fn value(&mut self, quantity: &'static str, range: [f64; 2], value: f64) {
        let empty = RangeCoverage { quantity, range, counts: [0; BINS] };
        let entry = self.ranges.entry(quantity).or_insert(empty);
        let [low, high] = range;
        let share = if high > low { (value - low) / (high - low) } else { 0.0 };
        let bin = (share * BINS as f64).clamp(0.0, BINS as f64 - 1.0) as usize;
        if let Some(count) = entry.counts.get_mut(bin) {
            *count += 1;
        }
    }

    pub fn add(&mut self, scene: &Scene, envelope: &Envelope) {
        let (trial, range) = (&scene.judged, &envelope.range);
        *self.histories.entry(scene.earlier.len()).or_default() += 1;
        for (_, level) in trial.setpoint.points() {
            self.value("setpoint_um", range.setpoint_um, f64::from(*level) / 1e3);
        }
        for [from, to] in trial.setpoint.points().array_windows().filter(|[from, to]| from.1 != to.1) {
            let height = f64::from(from.1.abs_diff(to.1)) / 1e3;
            self.value("setpoint_change_um", [0.0, range.setpoint_um[1]], height);
        }
        let windows = windows(trial);
        for window in windows.iter().filter(|window| window.change.is_setpoint_ramp()) {
            let Change { from_us, to_us, .. } = window.change;
            let height = (trial.setpoint_at(to_us) - trial.setpoint_at(from_us)).abs();
            let rate = height / (f64::from(to_us - from_us) * 1e-6);
            self.value("setpoint_rate_um_per_s", range.setpoint_rate_um_per_s, rate);
        }
        for window in &windows {
            let at = window.change.to_us;
            self.value("finger_force_n", range.finger_force_n, trial.force_at(at));
            self.value("temperature_offset_k", range.temperature_offset_k, trial.temperature_at(at));
            self.value("quiet_ms", [0.0, range.long_quiet_ms[0]], f64::from(window.quiet_us()) / 1e3);
        }
        let resonance_hz = trial.mode_at(&envelope.plate, 0).omega0 / TAU;
        let detuning = f64::from(trial.start_frequency_tenths) / 10.0 - resonance_hz;
        self.value("start_frequency_offset_hz", range.start_frequency_offset_hz, detuning);
        self.value("drive_limit_vpp", range.drive_limit_vpp, trial.plate.limit_vpp.into());
        self.value("period_ms", range.period_ms, f64::from(trial.period_us) / 1e3);
        let delay = f64::from(trial.delay_us) / f64::from(trial.period_us);
        self.value("loop_delay_periods", range.loop_delay_periods, delay);
        for [first, second] in windows.array_windows() {
            let kinds = (ChangeKind::of(trial, first), ChangeKind::of(trial, second));
            *self.pairs.entry(kinds).or_default() += 1;
        }
    }
}
