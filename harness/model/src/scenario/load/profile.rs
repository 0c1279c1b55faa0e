//! Checks profiles and that the plate has a resonance at all of their values.

use super::checker::{Checker, MAX_QUALITY};
use super::csv_profile::csv_point_error;
use crate::scenario::definition::{InputFile, Spread};
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::raw::RawProfiles;
use platebench_plate::{ConditionProfiles, Conditions, Plate, Profile, ProfileError, RawProfile, RawShape, Time};
use std::f64::consts::TAU;
use std::path::Path;

const MAX_SETPOINT_UM: f64 = 1_000.0;
const ABSOLUTE_ZERO_C: f64 = -273.15;
/// The wire carries the excitation frequency as a `u32` in millihertz.
const MAX_RESONANCE_HZ: f64 = 2.5e6;
const EXPECTED: &str = "expected one of at most 2.5e6 Hz with a quality factor from 0.5 to 1e9";
const SPREAD_SIGMAS: f64 = 5.0;

#[derive(Clone, Copy, PartialEq)]
pub(super) enum PointField {
    Time,
    Value,
    /// Period of a repeated profile.
    Period,
}

impl Checker<'_> {
    pub(super) fn profile(
        &self,
        folder: &Path,
        key: &str,
        raw: &RawProfile,
        duration: Time,
        inputs: &mut Vec<InputFile>,
    ) -> Result<Profile, Diagnostic> {
        let mut file_points = Vec::new();
        if let Some(path) = raw.file(folder) {
            let (file, points) = self.csv_profile(key, &path)?;
            file_points = points;
            inputs.push(file);
        }
        raw.check(&file_points, duration).map_err(|error| self.profile_error((folder, inputs), key, raw, &error))
    }

    fn profile_error(
        &self,
        files: (&Path, &[InputFile]),
        key: &str,
        raw: &RawProfile,
        error: &ProfileError,
    ) -> Diagnostic {
        let (index, part) = match error {
            ProfileError::NotFinite { index, .. } => (*index, PointField::Value),
            ProfileError::Time { index, .. } | ProfileError::Unordered { index, .. } => (*index, PointField::Time),
            ProfileError::Empty | ProfileError::Sine | ProfileError::Chirp | ProfileError::Square => {
                (1, PointField::Value)
            }
            // No point is wrong.
            ProfileError::Pattern => (usize::MAX, PointField::Value),
            ProfileError::Period { .. } | ProfileError::Repeated { .. } => (1, PointField::Period),
        };
        self.point_error(files, key, raw, index, part, error.to_string())
    }

    fn point_error(
        &self,
        (folder, inputs): (&Path, &[InputFile]),
        key: &str,
        raw: &RawProfile,
        index: usize,
        part: PointField,
        message: String,
    ) -> Diagnostic {
        let place = |shape: &str| format!("{key}.{shape}.{}.{}", index - 1, part as usize);
        let key = match raw {
            RawProfile::Number(_) => key.to_owned(),
            RawProfile::Shape(RawShape::Hold(_)) => place("hold"),
            RawProfile::Shape(RawShape::Linear(_)) => place("linear"),
            RawProfile::Shape(RawShape::Repeat(raw)) => {
                let shape = if raw.hold.is_some() { "repeat.hold" } else { "repeat.linear" };
                match part {
                    PointField::Period => format!("{key}.repeat.period_ms"),
                    _ if index > raw.points().len() => format!("{key}.repeat"),
                    _ => place(shape),
                }
            }
            RawProfile::Shape(RawShape::Square(_)) => format!("{key}.square"),
            RawProfile::Shape(RawShape::Sine(_)) => format!("{key}.sine"),
            RawProfile::Shape(RawShape::Chirp(_)) => format!("{key}.chirp"),
            RawProfile::Shape(RawShape::Csv(file)) => {
                let path = folder.join(file);
                return match inputs.iter().rfind(|input| input.path == path) {
                    Some(file) => csv_point_error(file, index, part, message),
                    None => Diagnostic::for_file(&path, message),
                };
            }
        };
        self.diagnostic(&key, message)
    }

    fn require_values(
        &self,
        files: (&Path, &[InputFile]),
        key: &str,
        (raw, profile): (&RawProfile, &Profile),
        good: impl Fn(f64) -> bool,
        message: impl Fn(f64) -> String,
    ) -> Result<(), Diagnostic> {
        let values = match (raw, profile) {
            (RawProfile::Shape(RawShape::Repeat(raw)), _) => raw.points().iter().map(|point| point[1]).collect(),
            (_, Profile::Hold(points) | Profile::Linear(points)) => points.iter().map(|(_, value)| *value).collect(),
            (_, Profile::Sine { .. }) => vec![profile.range().0, profile.range().1],
        };
        match (1..).zip(values).find(|(_, value)| !good(*value)) {
            Some((index, value)) => Err(self.point_error(files, key, raw, index, PointField::Value, message(value))),
            None => Ok(()),
        }
    }

    pub(super) fn check_setpoints(
        &self,
        files: (&Path, &[InputFile]),
        raw: &RawProfiles,
        setpoint: &Profile,
    ) -> Result<(), Diagnostic> {
        self.require_values(
            files,
            "profile.setpoint_um",
            (&raw.setpoint_um, setpoint),
            |value| (0.0..=MAX_SETPOINT_UM).contains(&value),
            |value| format!("a setpoint of {value} µm, expected 0 to {MAX_SETPOINT_UM} µm"),
        )
    }

    pub(super) fn check_conditions(
        &self,
        files: (&Path, &[InputFile]),
        raw: &RawProfiles,
        plate: &Plate,
        scene: &ConditionProfiles,
        spread: &Spread,
    ) -> Result<(), Diagnostic> {
        let force = (&raw.finger_force_n, &scene.finger_force_n);
        let force_key = "profile.finger_force_n";
        self.require_values(
            files,
            force_key,
            force,
            |value| value >= 0.0,
            |value| format!("a force of {value} N, expected 0 or more: a finger cannot pull"),
        )?;
        let temperature = (&raw.temperature_offset_k, &scene.temperature_offset_k);
        let temperature_key = "profile.temperature_offset_k";
        self.require_values(
            files,
            temperature_key,
            temperature,
            |value| plate.reference_temperature_c + value > ABSOLUTE_ZERO_C,
            |value| format!("an offset of {value} K, expected a temperature above {ABSOLUTE_ZERO_C} °C"),
        )?;
        let shortest = 1.0 - SPREAD_SIGMAS * spread.time_constant_percent / 100.0;
        let worst = Plate { sigma0: plate.sigma0 / shortest.max(0.1), ..plate.clone() };
        let exists = |temperature_offset_k: f64, finger_force_n: f64| {
            let conditions = Conditions { temperature_offset_k, finger_force_n };
            let (mode, least) = (worst.mode(&conditions), plate.mode(&conditions).sigma);
            let quality = mode.omega0 / (2.0 * least);
            mode.is_resonant() && quality <= MAX_QUALITY && mode.omega0 <= MAX_RESONANCE_HZ * TAU
        };
        self.require_values(
            files,
            force_key,
            force,
            |value| exists(0.0, value),
            |value| format!("a force of {value} N leaves the plate without a resonance, {EXPECTED}"),
        )?;
        // The damping curve is linear between corners, so corners and extreme forces suffice.
        let (lightest, heaviest) = scene.finger_force_n.range();
        let corners =
            plate.damping_ratio.iter().map(|point| point[0]).filter(|force| (lightest..heaviest).contains(force));
        let forces: Vec<f64> = corners.chain([lightest, heaviest]).collect();
        let margin = SPREAD_SIGMAS * spread.temperature_k;
        self.require_values(
            files,
            temperature_key,
            temperature,
            |value| forces.iter().all(|force| exists(value - margin, *force) && exists(value + margin, *force)),
            |value| {
                format!(
                    "{value} K (± {margin} K of spread) and up to {heaviest} N leave the plate without a resonance, \
                     {EXPECTED}"
                )
            },
        )
    }
}
