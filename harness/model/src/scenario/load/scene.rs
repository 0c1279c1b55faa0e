//! Checks what scenarios and the scenes between trials have in common: controller and profiles.

use super::checker::{Checker, Diagnostics};
use crate::scenario::definition::{Controller, InputFile, Scenario, Spread};
use crate::scenario::raw::{MAX_BETWEEN, RawBetween, RawController, RawProfiles};
use platebench_plate::{ConditionProfiles, Plate, Profile, RawProfile, Tier, Time};
use std::path::Path;

pub(super) struct SceneSource<'a> {
    pub(super) duration_ms: f64,
    pub(super) controller: &'a RawController,
    pub(super) profile: &'a RawProfiles,
}

/// Checked parts of a scene. A part with an error is `None`.
pub(super) struct Scene {
    pub(super) controller: Option<Controller>,
    pub(super) duration: Option<Time>,
    pub(super) setpoint: Option<Profile>,
    pub(super) conditions: Option<ConditionProfiles>,
}

impl Checker<'_> {
    pub(super) fn scene(
        &self,
        folder: &Path,
        source: &SceneSource<'_>,
        plate: Option<&Plate>,
        spread: Spread,
        inputs: &mut Vec<InputFile>,
        faults: &mut Diagnostics,
    ) -> Scene {
        let SceneSource { duration_ms, controller: raw, profile: profiles } = *source;
        let design_plate = raw.design_plate.as_ref().map(|file| (file, "controller.design_plate"));
        let design_plate = design_plate.map(|(file, key)| self.plate(key, &folder.join(file), inputs, faults));
        let is_complete = design_plate.as_ref().is_none_or(Option::is_some);
        let controller = self.controller(raw, plate, design_plate.flatten(), faults).filter(|_| is_complete);
        let duration = faults.record_error(self.time_from_ms("duration_ms", duration_ms));
        if let (Some(controller), Some(duration)) = (&controller, duration) {
            faults.record_error(self.require(duration >= controller.period, "duration_ms", || {
                format!("{duration_ms} ms, expected at least one control period of {}", controller.period)
            }));
            faults.record_error(self.require(controller.loop_delay < duration, "controller.loop_delay_ms", || {
                format!(
                    "{}, expected less than the scenario's duration of {duration}: no command would act",
                    controller.loop_delay
                )
            }));
        }
        let mut profile = |key: &str, raw: &RawProfile| faults.record_error(self.profile(folder, key, raw, inputs));
        let setpoint = profile("profile.setpoint_um", &profiles.setpoint_um);
        let temperature_offset_k = profile("profile.temperature_offset_k", &profiles.temperature_offset_k);
        let finger_force_n = profile("profile.finger_force_n", &profiles.finger_force_n);
        if let Some(setpoint) = &setpoint {
            faults.record_error(self.check_setpoints(folder, profiles, setpoint));
        }
        let conditions = temperature_offset_k.zip(finger_force_n);
        let conditions = conditions
            .map(|(temperature_offset_k, finger_force_n)| ConditionProfiles { temperature_offset_k, finger_force_n });
        if let (Some(plate), Some(conditions)) = (plate, &conditions) {
            faults.record_error(self.check_conditions(folder, profiles, plate, conditions, &spread));
        }
        Scene { controller, duration, setpoint, conditions }
    }

    /// The scenes take the trials and the spacing of trace rows from `scenario`.
    pub(super) fn scenes_between(
        &self,
        folder: &Path,
        raw: &[RawBetween],
        scenario: &Scenario,
        inputs: &mut Vec<InputFile>,
        faults: &mut Diagnostics,
    ) -> Vec<Scenario> {
        faults.record_error(self.require(raw.len() <= MAX_BETWEEN, "between", || {
            format!("{} scenes, expected at most {MAX_BETWEEN}", raw.len())
        }));
        let mut between = |(index, raw): (usize, &RawBetween)| {
            let checker = self.table(&format!("between.{index}"));
            let plate = match &raw.plate {
                Some(file) => checker.plate("plate", &folder.join(file), inputs, faults)?,
                None => scenario.plate.clone(),
            };
            let source =
                SceneSource { duration_ms: raw.duration_ms, controller: &raw.controller, profile: &raw.profile };
            let scene = checker.scene(folder, &source, Some(&plate), scenario.trials.spread, inputs, faults);
            Some(Scenario {
                file: format!("{}, between.{index}", scenario.file),
                controller: scene.controller?,
                duration: scene.duration?,
                setpoint: scene.setpoint?,
                conditions: scene.conditions?,
                tier: if raw.plate.is_some() { Tier::exact_for(&plate) } else { scenario.tier },
                plate,
                expectations: Vec::new(),
                faults: Vec::new(),
                chip_faults: Vec::new(),
                ..scenario.clone()
            })
        };
        raw.iter().enumerate().take(MAX_BETWEEN).filter_map(&mut between).collect()
    }
}
