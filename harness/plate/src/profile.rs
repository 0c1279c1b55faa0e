//! Checks the profiles of a scenario file, and evaluates a setpoint, a temperature offset or a finger
//! force over time.

use crate::time::Time;
use schemars::JsonSchema;
use serde::de::value::MapAccessDeserializer;
use serde::de::{Deserializer, Error as _, MapAccess, Visitor};
use serde::{Deserialize, Serialize};
use std::f64::consts::{PI, TAU};
use std::fmt;
use std::path::{Path, PathBuf};

const SHAPES: &str = "one of { hold = [[t_ms, value], …] }, { linear = [[t_ms, value], …] }, \
                      { repeat = { period_ms, hold | linear } }, { square = { low, high, period_ms } }, \
                      { sine = { mean, amplitude, frequency_hz } }, { chirp = { mean, amplitude, from_hz, to_hz } }, \
                      { csv = \"FILE\" }";

/// A profile in a scenario file, unchecked.
#[derive(Debug, Clone, Serialize, JsonSchema)]
#[serde(untagged)]
pub enum RawProfile {
    /// A constant value.
    Number(f64),
    /// One of the shapes.
    Shape(RawShape),
}

/// Unlike a derived reader of an untagged enum, an error has the position of the wrong key or value.
impl<'de> Deserialize<'de> for RawProfile {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(ProfileVisitor)
    }
}

struct ProfileVisitor;

impl<'de> Visitor<'de> for ProfileVisitor {
    type Value = RawProfile;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "a number or {SHAPES}")
    }

    fn visit_f64<E>(self, value: f64) -> Result<RawProfile, E> {
        Ok(RawProfile::Number(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<RawProfile, E> {
        Ok(RawProfile::Number(value as f64))
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<RawProfile, A::Error> {
        let shapes = ShapeKeys::deserialize(MapAccessDeserializer::new(map))?.shapes();
        match <[RawShape; 1]>::try_from(shapes) {
            Ok([shape]) => Ok(RawProfile::Shape(shape)),
            Err(shapes) if shapes.is_empty() => Err(A::Error::custom(format!("missing field: expected {SHAPES}"))),
            Err(_) => Err(A::Error::custom(format!("several shapes, expected {SHAPES}"))),
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ShapeKeys {
    hold: Option<Vec<[f64; 2]>>,
    linear: Option<Vec<[f64; 2]>>,
    repeat: Option<RawRepeat>,
    square: Option<RawSquare>,
    sine: Option<RawSine>,
    chirp: Option<RawChirp>,
    csv: Option<PathBuf>,
}

impl ShapeKeys {
    fn shapes(self) -> Vec<RawShape> {
        let shapes = [
            self.hold.map(RawShape::Hold),
            self.linear.map(RawShape::Linear),
            self.repeat.map(RawShape::Repeat),
            self.square.map(RawShape::Square),
            self.sine.map(RawShape::Sine),
            self.chirp.map(RawShape::Chirp),
            self.csv.map(RawShape::Csv),
        ];
        shapes.into_iter().flatten().collect()
    }
}

/// Shape of a profile.
#[derive(Debug, Clone, Serialize, JsonSchema)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum RawShape {
    /// Points [`t_ms`, value]; each value holds until the next point.
    Hold(#[schemars(length(min = 1))] Vec<[f64; 2]>),
    /// Points [`t_ms`, value]; linear in between, constant before the first and after the last.
    Linear(#[schemars(length(min = 1))] Vec<[f64; 2]>),
    /// Points that repeat with a period.
    Repeat(RawRepeat),
    /// A square wave.
    Square(RawSquare),
    /// A sine wave.
    Sine(RawSine),
    /// A sine wave whose frequency changes linearly from the start to the end of the trial.
    Chirp(RawChirp),
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

/// `mean + amplitude · sin(2π (from_hz t + (to_hz − from_hz) t²/2T) + phase_deg)`, with T the length
/// of the trial.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawChirp {
    /// Mean, in the unit of the profile.
    pub mean: f64,
    /// Amplitude, in the unit of the profile.
    pub amplitude: f64,
    /// Frequency at the start, Hz.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub from_hz: f64,
    /// Frequency at the end of the trial, Hz.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub to_hz: f64,
    /// Phase at the start, degrees.
    #[serde(default)]
    pub phase_deg: f64,
}

/// `high` during the first part of each period from `from_ms` on, otherwise `low`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawSquare {
    /// Value before `from_ms` and in the second part of each period.
    pub low: f64,
    /// Value in the first part of each period.
    pub high: f64,
    /// Period, ms.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub period_ms: f64,
    /// Share of `high` in a period, percent.
    #[serde(default = "half")]
    #[schemars(extend("exclusiveMinimum" = 0, "exclusiveMaximum" = 100))]
    pub duty_percent: f64,
    /// Start of the first period, ms.
    #[serde(default)]
    #[schemars(range(min = 0.0))]
    pub from_ms: f64,
}

fn half() -> f64 {
    50.0
}

/// The points of one period, `hold` or `linear`, at times from the start of the period.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawRepeat {
    /// Period, ms.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub period_ms: f64,
    /// Start of the first period, ms.
    #[serde(default)]
    #[schemars(range(min = 0.0))]
    pub from_ms: f64,
    /// Number of periods. Default: until the end of the trial.
    #[schemars(range(min = 1))]
    pub count: Option<i64>,
    /// Points [`t_ms`, value]; each value holds until the next point. The last value holds before
    /// `from_ms`.
    #[schemars(length(min = 1))]
    pub hold: Option<Vec<[f64; 2]>>,
    /// Points [`t_ms`, value]; linear in between, also to the first point of the next period.
    #[schemars(length(min = 1))]
    pub linear: Option<Vec<[f64; 2]>>,
}

/// Largest number of points of a repeated profile, as many as rows of a trace.
const MAX_REPEATED_POINTS: u64 = 2_000_000;

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
    #[error("a chirp requires finite numbers, and from_hz and to_hz above 0")]
    Chirp,
    #[error("a repeated profile requires one of `hold` and `linear`")]
    Pattern,
    #[error("a period of {period_ms} ms, expected one longer than {last_ms} ms, the last point of the profile")]
    Period { period_ms: f64, last_ms: f64 },
    #[error("a square wave requires finite numbers, and both parts of a period of at least 1 ns")]
    Square,
    #[error("a period of {period_ms} ms gives {points} points in the trial, expected at most {MAX_REPEATED_POINTS}")]
    Repeated { period_ms: f64, points: u64 },
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

    /// `file_points` are the points of a CSV profile; other profiles do not use them. Repeated points
    /// and a chirp end with the trial, after `duration`. Fails at the first invalid point.
    pub fn check(&self, file_points: &[[f64; 2]], duration: Time) -> Result<Profile, ProfileError> {
        match self {
            Self::Number(value) => points(&[[0.0, *value]]).map(Profile::Hold),
            Self::Shape(RawShape::Hold(raw)) => points(raw).map(Profile::Hold),
            Self::Shape(RawShape::Linear(raw)) => points(raw).map(Profile::Linear),
            Self::Shape(RawShape::Csv(_)) => points(file_points).map(Profile::Linear),
            Self::Shape(RawShape::Sine(raw)) => {
                let numbers = [raw.mean, raw.amplitude, raw.frequency_hz, raw.phase_deg];
                if !numbers.iter().all(|number| number.is_finite()) || raw.frequency_hz <= 0.0 {
                    return Err(ProfileError::Sine);
                }
                Ok(Profile::sine(raw.mean, raw.amplitude, TAU * raw.frequency_hz, raw.phase_deg.to_radians()))
            }
            Self::Shape(RawShape::Chirp(raw)) => {
                let numbers = [raw.mean, raw.amplitude, raw.from_hz, raw.to_hz, raw.phase_deg];
                let rises = raw.from_hz > 0.0 && raw.to_hz > 0.0;
                if !numbers.iter().all(|number| number.is_finite()) || !rises {
                    return Err(ProfileError::Chirp);
                }
                let sweep = TAU * (raw.to_hz - raw.from_hz) / duration.max(Time::from_nanos(1)).seconds();
                let fastest = TAU * raw.from_hz.max(raw.to_hz);
                Ok(Profile::Sine {
                    mean: raw.mean,
                    amplitude: raw.amplitude,
                    omega: TAU * raw.from_hz,
                    sweep,
                    phase: raw.phase_deg.to_radians(),
                    // With ν the frequency and α the sweep, the derivatives are at most ν, ν² + α,
                    // ν³ + 3αν and ν⁴ + 6αν² + 3α² times the amplitude.
                    bandwidth: (fastest * fastest + 3.0 * sweep.abs()).sqrt(),
                })
            }
            Self::Shape(RawShape::Square(raw)) => raw.check(duration),
            Self::Shape(RawShape::Repeat(raw)) => raw.check(duration),
        }
    }
}

impl RawSquare {
    fn check(&self, duration: Time) -> Result<Profile, ProfileError> {
        let Self { low, high, period_ms, duty_percent, from_ms } = *self;
        let time = |ms| Time::from_ms(ms).ok_or(ProfileError::Square);
        let (from, period) = (time(from_ms)?, time(period_ms)?);
        let fall = time(period_ms * duty_percent / 100.0)?;
        if !low.is_finite() || !high.is_finite() || fall == Time::ZERO || fall >= period {
            return Err(ProfileError::Square);
        }
        let pattern = [(Time::ZERO, high), (fall, low)];
        Ok(Profile::Hold(repeated(&pattern, Some(low), from, period, (period_ms, None), duration)?))
    }
}

impl RawRepeat {
    /// Points of one period.
    pub fn points(&self) -> &[[f64; 2]] {
        self.hold.as_ref().or(self.linear.as_ref()).map_or(&[], Vec::as_slice)
    }

    fn check(&self, duration: Time) -> Result<Profile, ProfileError> {
        let Self { period_ms, from_ms, count, .. } = *self;
        let time = |index, t_ms| Time::from_ms(t_ms).ok_or(ProfileError::Time { index, t_ms });
        let (pattern, is_held) = match (&self.hold, &self.linear) {
            (Some(hold), None) => (points(hold)?, true),
            (None, Some(linear)) => (points(linear)?, false),
            _ => return Err(ProfileError::Pattern),
        };
        let (from, period) = (time(1, from_ms)?, time(1, period_ms)?);
        let (last, value) = pattern.last().copied().ok_or(ProfileError::Empty)?;
        if period <= last {
            return Err(ProfileError::Period { period_ms, last_ms: last.ms() });
        }
        let before = is_held.then_some(value);
        let count = count.and_then(|count| u64::try_from(count).ok());
        let all = repeated(&pattern, before, from, period, (period_ms, count), duration)?;
        Ok(if is_held { Profile::Hold(all) } else { Profile::Linear(all) })
    }
}

/// Points of `pattern` in each period before `duration`, and one more point, so that a line to the
/// next point is complete. `before` is the value until the first point.
fn repeated(
    pattern: &[(Time, f64)],
    before: Option<f64>,
    from: Time,
    period: Time,
    (period_ms, count): (f64, Option<u64>),
    duration: Time,
) -> Result<Vec<(Time, f64)>, ProfileError> {
    let in_trial = duration.since(from).as_nanos() / period.as_nanos().max(1) + 1;
    let periods = count.map_or(in_trial, |count| count.min(in_trial));
    let points = periods.saturating_mul(pattern.len() as u64);
    if points > MAX_REPEATED_POINTS {
        return Err(ProfileError::Repeated { period_ms, points });
    }
    let mut all = Vec::with_capacity(points as usize + 2);
    let is_first = |(offset, _): &(Time, f64)| from + *offset > Time::ZERO;
    all.extend(before.filter(|_| pattern.first().is_some_and(is_first)).map(|value| (Time::ZERO, value)));
    for number in 0..periods {
        let start = from + period.times(number);
        all.extend(pattern.iter().map(|(offset, value)| (start + *offset, *value)));
    }
    if let Some((offset, value)) = pattern.first().filter(|_| count.is_none_or(|count| periods < count)) {
        all.push((from + period.times(periods) + *offset, *value));
    }
    Ok(all)
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

#[derive(Debug, Clone, PartialEq)]
pub enum Profile {
    /// Each value holds until the next point. Before the first point the first value holds.
    Hold(Vec<(Time, f64)>),
    /// Linear between the points, constant before the first and after the last.
    Linear(Vec<(Time, f64)>),
    /// `mean + amplitude sin(omega t + sweep t²/2 + phase)`
    Sine {
        mean: f64,
        amplitude: f64,
        /// Angular frequency at the start, rad/s.
        omega: f64,
        /// Change of the angular frequency, rad/s²; 0 except for a chirp.
        sweep: f64,
        /// rad
        phase: f64,
        /// B in rad/s: the n-th derivative is at most `amplitude · Bⁿ`, up to the fourth.
        bandwidth: f64,
    },
}

impl Profile {
    pub fn constant(value: f64) -> Self {
        Self::Hold(vec![(Time::ZERO, value)])
    }

    /// `mean + amplitude sin(omega t + phase)`; `omega` in rad/s, `phase` in rad.
    pub const fn sine(mean: f64, amplitude: f64, omega: f64, phase: f64) -> Self {
        Self::Sine { mean, amplitude, omega, sweep: 0.0, phase, bandwidth: omega }
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
            Self::Sine { mean, amplitude, omega, sweep, phase, .. } => times.map(|time| {
                let seconds = time.seconds();
                mean + amplitude * ((omega + sweep * seconds / 2.0) * seconds + phase).sin()
            }),
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
            Self::Sine { amplitude, bandwidth, .. } => (amplitude * bandwidth).abs(),
        }
    }

    /// Bandwidth of a sine in rad/s; 0 for other profiles.
    pub fn bandwidth(&self) -> f64 {
        match self {
            Self::Sine { amplitude, bandwidth, .. } if *amplitude != 0.0 => *bandwidth,
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
            Self::Sine { mean, amplitude, omega, sweep, phase, .. } => {
                let seconds = after.seconds();
                let reached = (omega + sweep * seconds / 2.0) * seconds + phase;
                let angle = ((value - mean) / amplitude).asin();
                // Angles of the rising and the falling passage; NaN if the sine does not reach
                // `value`.
                let passages = [angle, PI - angle].map(|angle| {
                    let turns = ((reached - angle) / TAU).floor();
                    let instants = [turns, turns + 1.0, turns + 2.0].map(|turns| {
                        let way = angle + turns * TAU - phase;
                        // Root of `sweep t²/2 + omega t = way`. NaN if a falling chirp ends before.
                        2.0 * way / (omega + (omega * omega + 2.0 * sweep * way).sqrt())
                    });
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
mod tests;
