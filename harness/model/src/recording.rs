//! Defines a recording: the inputs and the measured W of a plate over time.

use crate::trace::{Flags, Row};
use platebench_plate::{Complex64, Conditions};
use std::f64::consts::TAU;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecordedInput {
    /// Time in s from which the input acts.
    pub t: f64,
    pub vpp: f64,
    /// Excitation frequency, rad/s.
    pub omega: f64,
    pub conditions: Conditions,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecordedSample {
    /// Time of the sample, s.
    pub t: f64,
    /// `Wd + jWq`, µm peak to peak.
    pub w: Complex64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SampleSource {
    /// W as the controller received it, with the sensor's errors.
    Sensed,
    True,
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RecordingError {
    #[error("{0} samples at control instants, expected at least {FEWEST}")]
    TooShort(usize),
    #[error("{0} samples at control instants, expected at most {MOST}; split the recording")]
    TooLong(usize),
    #[error("the drive is 0 V in the whole recording, expected at least one step")]
    NoDrive,
    #[error("sample {0}: its time is not after that of the previous sample; times must increase")]
    NotInOrder(usize),
    #[error(
        "temperature and force have more than {MOST_CONDITIONS} levels, or a level has fewer than {FEWEST_HELD} \
         samples; expected each level to be constant for at least 10 ms"
    )]
    VaryingConditions,
    #[error(
        "the response does not determine gain, time constant and resonance; \
         expected steps of the drive or the frequency, each held for at least 10 ms. Check the units of the columns, \
         and whether wd and wq are exchanged"
    )]
    Undetermined,
}

/// With fewer samples no parameter is determined.
const FEWEST: usize = 8;
/// Largest number of samples, 100 s at 1 kHz.
const MOST: usize = 100_000;
/// Largest number of levels of temperature and force. With more the conditions count as a ramp.
const MOST_CONDITIONS: usize = 64;
/// Smallest number of samples of a level. With fewer the level counts as part of a ramp.
const FEWEST_HELD: usize = 5;
/// Largest spacing of two rows in periods. A larger spacing is a gap.
const LONGEST_SPACING: f64 = 1.5;
const SAME_TEMPERATURE_K: f64 = 0.05;
const SAME_FORCE_N: f64 = 0.02;

#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    pub name: String,
    /// Changes of the inputs in order of time. The first one is not after the first output.
    pub inputs: Vec<RecordedInput>,
    pub outputs: Vec<RecordedSample>,
    pub conditions: Vec<Conditions>,
    pub gaps: Vec<Gap>,
}

/// Interval without rows that is longer than one period and a half. The inputs in it are unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gap {
    /// Times of the rows before and after, s.
    pub from: f64,
    pub to: f64,
    pub missing_rows: usize,
}

impl Recording {
    /// Removes inputs that repeat the previous one, and unifies close temperatures and forces.
    /// `inputs` and `outputs` contain every row, because rows that are further apart are a gap.
    pub fn new(name: String, inputs: Vec<RecordedInput>, outputs: Vec<RecordedSample>) -> Result<Self, RecordingError> {
        if outputs.len() < FEWEST {
            return Err(RecordingError::TooShort(outputs.len()));
        }
        if outputs.len() > MOST {
            return Err(RecordingError::TooLong(outputs.len()));
        }
        if let Some(at) = outputs.array_windows().position(|[before, after]| after.t <= before.t) {
            return Err(RecordingError::NotInOrder(at + 1));
        }
        if inputs.iter().all(|input| input.vpp == 0.0) {
            return Err(RecordingError::NoDrive);
        }
        let mut times: Vec<f64> =
            inputs.iter().map(|input| input.t).chain(outputs.iter().map(|output| output.t)).collect();
        let mut conditions: Vec<Conditions> = Vec::new();
        let mut kept: Vec<RecordedInput> = Vec::new();
        for mut input in inputs {
            let level = conditions.iter().copied().find(|known| are_same_conditions(known, &input.conditions));
            input.conditions = level.unwrap_or(input.conditions);
            if level.is_none() {
                conditions.push(input.conditions);
            }
            if kept.last().is_none_or(|last| RecordedInput { t: input.t, ..*last } != input) {
                kept.push(input);
            }
            if conditions.len() > MOST_CONDITIONS {
                return Err(RecordingError::VaryingConditions);
            }
        }
        let mut whole = Self { name, inputs: kept, outputs, conditions, gaps: Vec::new() };
        times.sort_by(f64::total_cmp);
        whole.gaps = find_gaps(&times, whole.period());
        let acting = whole.inputs_at_samples();
        let count = |level: &Conditions| acting.iter().filter(|input| input.conditions == *level).count();
        let is_varying = whole.conditions.iter().any(|level| count(level) < FEWEST_HELD);
        if is_varying { Err(RecordingError::VaryingConditions) } else { Ok(whole) }
    }

    /// Takes the inputs from every row, and the outputs from control instants whose sample arrived.
    pub fn from_trace(name: String, rows: &[Row], signal: SampleSource) -> Result<Self, RecordingError> {
        let input = |row: &Row| RecordedInput {
            t: row.t_s,
            vpp: row.drive_vpp,
            omega: row.frequency_hz * TAU,
            conditions: Conditions {
                temperature_offset_k: row.temperature_offset_k,
                finger_force_n: row.finger_force_n,
            },
        };
        let arrived = |row: &&Row| row.flags.contains(Flags::CONTROL) && !row.flags.contains(Flags::LINK_LOST);
        let output = |row: &Row| {
            let (wd, wq) = match signal {
                SampleSource::Sensed => (row.sensed_wd_um, row.sensed_wq_um),
                SampleSource::True => (row.wd_um, row.wq_um),
            };
            RecordedSample { t: row.t_s, w: Complex64::new(wd, wq) }
        };
        Self::new(name, rows.iter().map(input).collect(), rows.iter().filter(arrived).map(output).collect())
    }

    /// Median spacing of the outputs, s.
    pub fn period(&self) -> f64 {
        let mut spacings: Vec<f64> = self.outputs.array_windows().map(|[before, after]| after.t - before.t).collect();
        spacings.sort_by(f64::total_cmp);
        spacings.get(spacings.len() / 2).copied().unwrap_or(0.0)
    }

    /// Input that acts from the time of each output on.
    pub fn inputs_at_samples(&self) -> Vec<RecordedInput> {
        let at = |t: f64| self.inputs.partition_point(|input| input.t <= t).saturating_sub(1);
        self.outputs.iter().filter_map(|output| self.inputs.get(at(output.t)).copied()).collect()
    }

    pub fn slice(&self, from: usize, to: usize) -> Result<Self, RecordingError> {
        let outputs = self.outputs.get(from..to).unwrap_or_default().to_vec();
        let (Some(first), Some(last)) = (outputs.first(), outputs.last()) else {
            return Err(RecordingError::TooShort(0));
        };
        let start = self.inputs.partition_point(|input| input.t <= first.t).saturating_sub(1);
        let end = self.inputs.partition_point(|input| input.t < last.t);
        let (from, to) = (first.t, last.t);
        let gaps = self.gaps.iter().filter(|gap| from <= gap.from && gap.to <= to).copied().collect();
        let part = Self::new(self.name.clone(), self.inputs.get(start..end).unwrap_or_default().to_vec(), outputs)?;
        Ok(Self { gaps, ..part })
    }

    /// Samples at the end of gaps in which an input changed at an unknown time.
    pub fn samples_after_unknown_inputs(&self) -> Vec<usize> {
        let place = |t: f64| self.inputs.partition_point(|input| input.t <= t).saturating_sub(1);
        let is_changed = |gap: &&Gap| {
            let (before, after) = (self.inputs.get(place(gap.from)), self.inputs.get(place(gap.to)));
            before.zip(after).is_some_and(|(a, b)| RecordedInput { t: a.t, ..*b } != *a)
        };
        let sample = |gap: &Gap| self.outputs.partition_point(|output| output.t < gap.to);
        self.gaps.iter().filter(is_changed).map(sample).filter(|sample| *sample < self.outputs.len()).collect()
    }
}

fn find_gaps(times: &[f64], period: f64) -> Vec<Gap> {
    let gap = |[from, to]: &[f64; 2]| {
        let periods = (to - from) / period;
        (periods > LONGEST_SPACING).then(|| Gap { from: *from, to: *to, missing_rows: periods.round() as usize - 1 })
    };
    times.array_windows().filter_map(gap).collect()
}

pub(crate) fn are_same_conditions(a: &Conditions, b: &Conditions) -> bool {
    (a.temperature_offset_k - b.temperature_offset_k).abs() <= SAME_TEMPERATURE_K
        && (a.finger_force_n - b.finger_force_n).abs() <= SAME_FORCE_N
}
