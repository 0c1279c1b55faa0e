//! Reads and checks the profiles of a scenario file.

use crate::input;
use crate::profile::Profile;
use crate::time::Time;
use schemars::JsonSchema;
use serde::Deserialize;
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

/// A profile in a scenario file, unchecked.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
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
#[derive(Debug, Clone, Deserialize, JsonSchema)]
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
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawSine {
    /// Mean, in the unit of the profile.
    mean: f64,
    /// Amplitude, in the unit of the profile.
    amplitude: f64,
    /// Frequency in plate time, Hz.
    #[schemars(extend("exclusiveMinimum" = 0))]
    frequency_hz: f64,
    /// Phase at the start, degrees.
    #[serde(default)]
    phase_deg: f64,
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
