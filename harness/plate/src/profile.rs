//! Reads and checks the profiles of a scenario file, and evaluates a setpoint, a temperature offset
//! or a finger force over time.

use crate::input;
use crate::time::Time;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::{PI, TAU};
use std::path::{Path, PathBuf};

/// A profile in a scenario file, unchecked.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(
    untagged,
    expecting = "expected a number or one of { hold = [[t_ms, value], …] }, { linear = [[t_ms, value], …] }, \
                 { sine = { mean, amplitude, frequency_hz } }, { csv = \"FILE\" }"
)]
pub enum RawProfile {
    /// A constant value.
    Number(f64),
    /// One of the shapes.
    Shape(RawShape),
}

/// Shape of a profile.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum RawShape {
    /// Points [`t_ms`, value]; each value holds until the next point.
    Hold(#[schemars(length(min = 1))] Vec<[f64; 2]>),
    /// Points [`t_ms`, value]; linear in between, constant before the first and after the last.
    Linear(#[schemars(length(min = 1))] Vec<[f64; 2]>),
    /// A sine wave.
    Sine(RawSine),
    /// Points from a file with the columns `t_ms` and `value`, read as `linear`.
    Csv(PathBuf),
}

/// `mean + amplitude · sin(2π frequency_hz t + phase_deg)`
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawSine {
    /// Mean, in the unit of the profile.
    pub mean: f64,
    /// Amplitude, in the unit of the profile.
    pub amplitude: f64,
    /// Frequency in plate time, Hz.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub frequency_hz: f64,
    /// Phase at the start, degrees.
    #[serde(default)]
    pub phase_deg: f64,
}

#[derive(Debug, thiserror::Error)]
pub enum ProfileError {
    #[error("the profile has no points, expected at least one [t_ms, value]")]
    Empty,
    #[error("point {index}: {value} is not a finite number")]
    NotFinite { index: usize, value: f64 },
    #[error("point {index}: time {t_ms} ms is not between 0 and 9.0e9 ms")]
    Time { index: usize, t_ms: f64 },
    #[error("point {index}: time {t_ms} ms is not after the previous point; times must increase")]
    Unordered { index: usize, t_ms: f64 },
    #[error("a sine requires finite numbers and a frequency_hz above 0")]
    Sine,
    #[error("{}: {source}", path.display())]
    Csv { path: PathBuf, source: csv::Error },
}

impl RawProfile {
    /// True for the number 0, the default of the conditions.
    pub fn is_zero(&self) -> bool {
        matches!(self, Self::Number(0.0))
    }

    pub fn file(&self, folder: &Path) -> Option<PathBuf> {
        match self {
            Self::Shape(RawShape::Csv(path)) => Some(folder.join(path)),
            _ => None,
        }
    }

    pub fn file_name_mut(&mut self) -> Option<&mut PathBuf> {
        match self {
            Self::Shape(RawShape::Csv(path)) => Some(path),
            _ => None,
        }
    }

    /// A CSV path is relative to `folder`. Fails at the first invalid point.
    pub fn check(&self, folder: &Path) -> Result<Profile, ProfileError> {
        match self {
            Self::Number(value) => points(&[[0.0, *value]]).map(Profile::Hold),
            Self::Shape(RawShape::Hold(raw)) => points(raw).map(Profile::Hold),
            Self::Shape(RawShape::Linear(raw)) => points(raw).map(Profile::Linear),
            Self::Shape(RawShape::Csv(path)) => points(&read_points(&folder.join(path))?).map(Profile::Linear),
            Self::Shape(RawShape::Sine(raw)) => {
                let numbers = [raw.mean, raw.amplitude, raw.frequency_hz, raw.phase_deg];
                if !numbers.iter().all(|number| number.is_finite()) || raw.frequency_hz <= 0.0 {
                    return Err(ProfileError::Sine);
                }
                Ok(Profile::Sine {
                    mean: raw.mean,
                    amplitude: raw.amplitude,
                    omega: TAU * raw.frequency_hz,
                    phase: raw.phase_deg.to_radians(),
                })
            }
        }
    }
}

fn points(raw: &[[f64; 2]]) -> Result<Vec<(Time, f64)>, ProfileError> {
    let mut points: Vec<(Time, f64)> = Vec::with_capacity(raw.len());
    for (index, &[t_ms, value]) in (1..).zip(raw) {
        if !value.is_finite() {
            return Err(ProfileError::NotFinite { index, value });
        }
        let time = Time::from_ms(t_ms).ok_or(ProfileError::Time { index, t_ms })?;
        if points.last().is_some_and(|(before, _)| *before >= time) {
            return Err(ProfileError::Unordered { index, t_ms });
        }
        points.push((time, value));
    }
    if points.is_empty() { Err(ProfileError::Empty) } else { Ok(points) }
}

fn read_points(path: &Path) -> Result<Vec<[f64; 2]>, ProfileError> {
    #[derive(Deserialize)]
    struct Row {
        t_ms: f64,
        value: f64,
    }
    let with_path = |source| ProfileError::Csv { path: path.to_owned(), source };
    let content = input::read(path).map_err(|error| with_path(error.into()))?;
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(&content[..]);
    reader.deserialize::<Row>().map(|row| row.map(|row| [row.t_ms, row.value]).map_err(with_path)).collect()
}

#[derive(Debug, Clone, PartialEq)]
pub enum Profile {
    /// Each value holds until the next point. Before the first point the first value holds.
    Hold(Vec<(Time, f64)>),
    /// Linear between the points, constant before the first and after the last.
    Linear(Vec<(Time, f64)>),
    /// `mean + amplitude sin(omega t + phase)`
    Sine {
        mean: f64,
        amplitude: f64,
        /// rad/s; `phase` is in rad.
        omega: f64,
        phase: f64,
    },
}

impl Profile {
    pub fn constant(value: f64) -> Self {
        Self::Hold(vec![(Time::ZERO, value)])
    }

    /// A [`Self::Hold`] has the new value at the time of its point.
    pub fn at(&self, time: Time) -> f64 {
        let [value] = self.at_each([time]);
        value
    }

    /// Values at increasing `times`. The profile must have no point after the first one up to the
    /// last one.
    pub(crate) fn at_each<const N: usize>(&self, times: [Time; N]) -> [f64; N] {
        match self {
            Self::Hold(points) => {
                let last = count_until(points, times[0]).saturating_sub(1);
                [points.get(last).map_or(0.0, |(_, value)| *value); N]
            }
            Self::Linear(points) => {
                let passed = count_until(points, times[0]);
                match (passed.checked_sub(1).and_then(|before| points.get(before)), points.get(passed)) {
                    (Some((t0, v0)), Some((t1, v1))) => times.map(|time| {
                        let share = (time - *t0).seconds() / (*t1 - *t0).seconds();
                        v0 + (v1 - v0) * share
                    }),
                    (Some((_, value)), None) | (None, Some((_, value))) => [*value; N],
                    (None, None) => [0.0; N],
                }
            }
            Self::Sine { mean, amplitude, omega, phase } => {
                times.map(|time| mean + amplitude * (omega * time.seconds() + phase).sin())
            }
        }
    }

    pub fn next_point_after(&self, time: Time) -> Option<Time> {
        match self {
            Self::Hold(points) | Self::Linear(points) => points.get(count_until(points, time)).map(|(point, _)| *point),
            Self::Sine { .. } => None,
        }
    }

    /// Upper bound on |slope| between `from` and the next point, in units per second.
    pub fn max_slope_after(&self, from: Time) -> f64 {
        match self {
            Self::Hold(_) => 0.0,
            Self::Linear(_) => self
                .next_point_after(from)
                .map_or(0.0, |next| ((self.at(next) - self.at(from)) / (next - from).seconds()).abs()),
            Self::Sine { amplitude, omega, .. } => (amplitude * omega).abs(),
        }
    }

    /// Angular frequency of a sine in rad/s; 0 for other profiles.
    pub fn angular_frequency(&self) -> f64 {
        match self {
            Self::Sine { amplitude, omega, .. } if *amplitude != 0.0 => *omega,
            _ => 0.0,
        }
    }

    /// First nanosecond after `after` at which the profile passes `value`; `None` if it does not
    /// pass it before the next point.
    pub fn next_crossing(&self, value: f64, after: Time) -> Option<Time> {
        match self {
            Self::Hold(_) => None,
            Self::Linear(points) => {
                let passed = count_until(points, after);
                let (from, before) = *points.get(passed.checked_sub(1)?)?;
                let (to, behind) = *points.get(passed)?;
                let share = (value - before) / (behind - before);
                let nanos = (share * (to - from).as_nanos() as f64).ceil();
                let time = from + Time::from_nanos(nanos as u64);
                (share > 0.0 && share < 1.0 && time > after).then_some(time)
            }
            Self::Sine { mean, amplitude, omega, phase } => {
                let angle = ((value - mean) / amplitude).asin();
                // Angles of the rising and the falling passage; NaN if the sine does not reach
                // `value`.
                let passages = [angle, PI - angle].map(|angle| {
                    let turns = ((omega * after.seconds() + phase - angle) / TAU).floor();
                    let instants = [turns, turns + 1.0, turns + 2.0].map(|turns| (angle + turns * TAU - phase) / omega);
                    let nanos = instants.map(|seconds| (seconds * 1e9).ceil());
                    nanos.into_iter().find(|nanos| *nanos > after.as_nanos() as f64)
                });
                passages.into_iter().flatten().min_by(f64::total_cmp).map(|nanos| Time::from_nanos(nanos as u64))
            }
        }
    }

    pub fn range(&self) -> (f64, f64) {
        match self {
            Self::Hold(points) | Self::Linear(points) => {
                points.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), (_, value)| {
                    (low.min(*value), high.max(*value))
                })
            }
            Self::Sine { mean, amplitude, .. } => (mean - amplitude.abs(), mean + amplitude.abs()),
        }
    }
}

/// Number of points up to `time`.
fn count_until(points: &[(Time, f64)], time: Time) -> usize {
    points.partition_point(|(point, _)| *point <= time)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rstest::rstest;

    #[derive(Deserialize)]
    struct Document {
        p: RawProfile,
    }

    fn read(text: &str) -> Result<Profile, ProfileError> {
        toml::from_str::<Document>(&format!("p = {text}")).unwrap().p.check(Path::new("."))
    }

    fn ms(value: f64) -> Time {
        Time::from_ms(value).unwrap()
    }

    #[test]
    fn a_hold_profile_jumps_at_its_points() {
        let profile = read("{ hold = [[1.0, 0.0], [2.0, 5.0]] }").unwrap();
        for (t, value) in [(0.0, 0.0), (1.999_999, 0.0), (2.0, 5.0), (99.0, 5.0)] {
            assert_eq!(profile.at(ms(t)), value, "at {t} ms");
        }
        assert_eq!(profile.next_point_after(ms(1.0)), Some(ms(2.0)));
        assert_eq!(profile.next_point_after(ms(2.0)), None);
        assert_eq!(profile.max_slope_after(ms(0.0)), 0.0);
    }

    #[test]
    fn a_linear_profile_is_constant_outside_its_points() {
        let profile = read("{ linear = [[20.0, 0.0], [120.0, 1.0]] }").unwrap();
        for (t, value) in [(0.0, 0.0), (20.0, 0.0), (70.0, 0.5), (120.0, 1.0), (130.0, 1.0)] {
            assert_eq!(profile.at(ms(t)), value, "at {t} ms");
        }
        for (t, slope) in [(0.0, 0.0), (20.0, 10.0), (119.0, 10.0), (120.0, 0.0)] {
            assert!((profile.max_slope_after(ms(t)) - slope).abs() < 1e-9, "at {t} ms");
        }
    }

    #[test]
    fn a_sine_starts_at_its_phase() {
        let profile = read("{ sine = { mean = 1.0, amplitude = 0.5, frequency_hz = 2.0, phase_deg = 90.0 } }").unwrap();
        assert!((profile.at(Time::ZERO) - 1.5).abs() < 1e-15);
        assert!((profile.at(ms(250.0)) - 0.5).abs() < 1e-12);
        assert_eq!(profile.range(), (0.5, 1.5));
        let slope = 0.5 * TAU * 2.0;
        assert!((profile.max_slope_after(Time::ZERO) - slope).abs() < 1e-12);
        assert_eq!(profile.angular_frequency(), TAU * 2.0);
    }

    #[rstest]
    #[case::sine("{ sine = { mean = 1.0, amplitude = 0.5, frequency_hz = 123.0, phase_deg = 40.0 } }")]
    #[case::sine_upside_down("{ sine = { mean = 1.0, amplitude = -0.5, frequency_hz = 123.0, phase_deg = -400.0 } }")]
    #[case::line("{ linear = [[0.0, 0.6], [5.0, 1.4], [9.0, 0.7], [20.0, 1.3], [30.0, 1.3]] }")]
    fn finds_every_passage(#[case] text: &str, #[values(0.7001, 1.0, 1.25)] value: f64) {
        let profile = read(text).unwrap();
        let above = |nanos: u64| profile.at(Time::from_nanos(nanos)) >= value;
        let changes: Vec<u64> = (0..30_000).map(|us| 1_000 * us).filter(|ns| above(*ns) != above(ns + 1_000)).collect();
        let mut found = Vec::new();
        let mut now = Time::ZERO;
        while now < ms(30.0) {
            let point = profile.next_point_after(now).unwrap_or(ms(30.0)).min(ms(30.0));
            let passage = profile.next_crossing(value, now).filter(|passage| *passage < point);
            found.extend(passage);
            now = passage.unwrap_or(point);
        }
        assert!(changes.len() >= 3, "{changes:?}");
        assert_eq!(found.len(), changes.len(), "{found:?} {changes:?}");
        for (passage, change) in found.iter().zip(&changes) {
            let nanos = passage.as_nanos();
            assert!((*change..=change + 1_001).contains(&nanos), "{passage}: {change}");
            assert_ne!(above(nanos - 2), above(nanos + 1), "{passage}");
        }
    }

    #[test]
    fn finds_no_passage_of_a_value_that_is_not_passed() {
        for text in [
            "{ sine = { mean = 1.0, amplitude = 0.5, frequency_hz = 2.0 } }",
            "1.5",
            "{ linear = [[0.0, 0.0], [9.0, 1.5]] }",
        ] {
            assert_eq!(read(text).unwrap().next_crossing(1.6, Time::ZERO), None, "{text}");
        }
        let line = read("{ linear = [[2.0, 0.0], [12.0, 10.0], [13.0, 10.0]] }").unwrap();
        assert_eq!(line.next_crossing(1.0, Time::ZERO), None);
        assert_eq!(line.next_crossing(1.0, ms(2.0)), Some(ms(3.0)));
        assert_eq!(line.next_crossing(1.0, ms(3.0)), None);
        for value in [0.0, 10.0] {
            assert_eq!(line.next_crossing(value, ms(2.0)), None);
            assert_eq!(line.next_crossing(value, ms(12.5)), None);
        }
    }

    #[rstest]
    #[case("{ hold = [[1.0, 0.3], [2.0, 5.0]] }")]
    #[case("{ linear = [[1.0, 0.3], [2.0, 0.7], [3.0, -0.1]] }")]
    #[case("{ sine = { mean = 1.0, amplitude = 0.5, frequency_hz = 123.0 } }")]
    fn values_at_several_times_equal_those_at_each(#[case] text: &str, #[values(0.0, 1.0, 2.0, 3.0)] from: f64) {
        let profile = read(text).unwrap();
        let times = [from, from + 0.5, from + 0.999_999].map(ms);
        assert_eq!(profile.at_each(times), times.map(|time| profile.at(time)));
    }

    #[rstest]
    #[case("{ hold = [] }", "no points")]
    #[case("nan", "point 1: NaN is not a finite number")]
    #[case("{ hold = [[0.0, 1.0], [-1.0, 2.0]] }", "point 2: time -1 ms")]
    #[case("{ linear = [[0.0, 1.0], [0.0, 2.0]] }", "point 2: time 0 ms is not after the previous point")]
    #[case("{ linear = [[5.0, 1.0], [4.0, 2.0]] }", "point 2: time 4 ms is not after the previous point")]
    #[case("{ hold = [[inf, 1.0]] }", "point 1: time inf ms")]
    #[case("{ sine = { mean = 1.0, amplitude = 0.5, frequency_hz = 0.0 } }", "frequency_hz above 0")]
    #[case("{ csv = \"no-such-file.csv\" }", "no-such-file.csv")]
    fn refuses_invalid_points(#[case] text: &str, #[case] message: &str) {
        let error = read(text).unwrap_err().to_string();
        assert!(error.contains(message), "{error}");
    }

    #[rstest]
    #[case("{ ramp = [[0.0, 1.0]] }")]
    #[case("\"2.0\"")]
    #[case("{ hold = [[0.0]] }")]
    fn lists_the_shapes_if_the_shape_is_unknown(#[case] text: &str) {
        let error = toml::from_str::<Document>(&format!("p = {text}")).err().unwrap().to_string();
        assert!(error.contains("expected a number or one of"), "{error}");
    }

    proptest! {
        #[test]
        fn a_line_stays_within_its_range(
            steps in proptest::collection::vec((1_u32..1_000_000, -5.0..5.0), 1..20), t in 0_u64..40_000_000_000,
        ) {
            let mut at = 0.0;
            let points: Vec<_> = steps
                .iter()
                .map(|(step, value)| {
                    at += f64::from(*step) / 1e3;
                    [at, *value]
                })
                .collect();
            let profile = RawProfile::Shape(RawShape::Linear(points)).check(Path::new(".")).unwrap();
            let (low, high) = profile.range();
            let value = profile.at(Time::from_nanos(t));
            prop_assert!(low - 1e-12 <= value && value <= high + 1e-12);
        }

        #[test]
        fn a_hold_only_changes_at_its_points(
            steps in proptest::collection::vec((1_u32..1_000, -5.0..5.0), 1..20), t in 0_u64..20_000,
        ) {
            let mut at = 0.0;
            let points: Vec<_> = steps.iter().map(|(step, value)| { at += f64::from(*step); [at, *value] }).collect();
            let profile = RawProfile::Shape(RawShape::Hold(points)).check(Path::new(".")).unwrap();
            let from = Time::from_nanos(t * 1_000_000);
            if let Some(next) = profile.next_point_after(from) {
                prop_assert_eq!(profile.at(from), profile.at(Time::from_nanos(next.as_nanos() - 1)));
            }
        }
    }
}
