//! Checks a scenario as a whole, with its trials and its spacing of rows.

use super::checker::{Checker, Diagnostics, TrialContext};
use super::expectation::expectation_names;
use super::fault::CheckedFault;
use super::scene::{Scene, SceneSource};
use crate::metrics::TrialRule;
use crate::scenario::definition::{AUTO_MODEL, InputFile, MAX_TRIALS, Scenario, Trials};
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::raw::{RawScenario, RawTrials};
use crate::scenario::window::ProfileChanges;
use platebench_plate::{Plate, Tier, Time};
use std::collections::BTreeMap;
use std::path::Path;

const DEFAULT_TRACE_STEP_MS: f64 = 0.05;
/// A longer scenario has one row per control period by default.
const MAX_FINE_TRACE_MS: f64 = 1_000.0;
/// Largest number of rows of a trial. All rows are in memory; 2 million need about 250 MB.
const MAX_ROWS: f64 = 2e6;
const MAX_EXPECTATIONS: usize = 2_000;

impl Checker<'_> {
    pub(super) fn check(&self, raw: RawScenario, file: &str) -> Result<Scenario, Vec<Diagnostic>> {
        let mut faults = Diagnostics::default();
        let scenario = self.scenario(raw, file, &mut faults);
        scenario.filter(|_| faults.0.is_empty()).ok_or(faults.0)
    }

    fn scenario(&self, raw: RawScenario, file: &str, faults: &mut Diagnostics) -> Option<Scenario> {
        let folder = self.path.parent().unwrap_or_else(|| Path::new("."));
        faults.record_error(self.one_line("title", &raw.title));
        if let Some(reason) = &raw.only_if_named {
            faults.record_error(self.one_line("only_if_named", reason));
        }
        let mut inputs = vec![InputFile { path: self.path.to_owned(), bytes: self.text.as_bytes().to_vec() }];
        let trials = faults.record_error(self.trials(&raw.trials));
        let spread = raw.trials.spread;
        let plate = self.plate("plate", &folder.join(&raw.plate), &mut inputs, faults);
        let source = SceneSource { duration_ms: raw.duration_ms, controller: &raw.controller, profile: &raw.profile };
        let scene = self.scene(folder, &source, plate.as_ref(), spread, &mut inputs, faults);
        let timing = scene.controller.as_ref().zip(scene.duration);
        let trace_step = timing.and_then(|(controller, duration)| {
            faults.record_error(self.trace_step(raw.trace_step_ms, duration, controller.period))
        });
        faults.record_error(self.require(raw.expect.len() <= MAX_EXPECTATIONS, "expect", || {
            format!("{} [[expect]], expected at most {MAX_EXPECTATIONS}", raw.expect.len())
        }));
        faults.record_error(self.require(
            !raw.expect.is_empty(),
            "expect",
            || "no [[expect]], expected at least one: a scenario that expects nothing cannot fail",
        ));
        let model = raw.model.as_deref().unwrap_or(AUTO_MODEL);
        let tier = plate.as_ref().and_then(|plate| faults.record_error(self.tier(model, plate)));
        let expected_exit = faults.record_error(self.expected_exit(raw.expected_exit));
        let Scene { controller, duration, setpoint, conditions } = scene;
        let (Some(controller), Some(duration), Some(setpoint), Some(conditions)) =
            (controller, duration, setpoint, conditions)
        else {
            return None;
        };
        let count = faults.0.len();
        let table = |list: &str, index: usize| self.table(&format!("{list}.{index}"));
        let mut planned =
            (0..).zip(&raw.fault).map(|(index, raw)| table("fault", index).fault(raw, duration, controller.period));
        let (mut line_faults, mut chip_faults) = (Vec::new(), Vec::new());
        for fault in faults.record_errors(&mut planned) {
            match fault {
                CheckedFault::Line(fault) => line_faults.push(fault),
                CheckedFault::Chip(fault) => chip_faults.push(fault),
            }
        }
        let changes =
            ProfileChanges::new(&setpoint, &conditions.finger_force_n, &conditions.temperature_offset_k, duration);
        let response_delay = controller.period + controller.loop_delay + controller.loop_delay_jitter;
        let trial = TrialContext { duration, response_delay, setpoint: &setpoint, changes, faults: &line_faults };
        let names = expectation_names(&raw.expect);
        let mut expected = (0..)
            .zip(raw.expect.iter().zip(names))
            .map(|(index, (expect, name))| table("expect", index).expectation(expect, name, &trial));
        let expected = faults.record_errors(&mut expected);
        faults.record_error(self.check_names(&raw.expect, &expected));
        if faults.0.len() > count {
            return None;
        }
        let mut scenario = Scenario {
            file: file.to_owned(),
            title: raw.title,
            source: raw.source,
            tags: raw.tags,
            tier: tier?,
            only_if_named: raw.only_if_named,
            expected_exit: expected_exit?,
            expectations: expected,
            requirement_texts: BTreeMap::new(),
            faults: line_faults,
            chip_faults,
            between: Vec::new(),
            conditions,
            inputs: Vec::new(),
            plate: plate?,
            duration,
            trace_step: trace_step?,
            controller,
            setpoint,
            trials: trials?,
        };
        faults.record_error(self.check_trial_differences(&scenario));
        scenario.between = self.scenes_between(folder, &raw.between, &scenario, &mut inputs, faults);
        Some(Scenario { inputs, ..scenario })
    }

    fn trace_step(&self, raw: Option<f64>, duration: Time, period: Time) -> Result<Time, Diagnostic> {
        let key = "trace_step_ms";
        let step = match raw {
            Some(ms) => self.time_from_ms(key, ms)?,
            None if duration.ms() > MAX_FINE_TRACE_MS => period,
            None => self.time_from_ms(key, DEFAULT_TRACE_STEP_MS)?,
        };
        // The trace also has a row at every control instant.
        let spacing = step.min(period);
        let rows = duration.seconds() / spacing.seconds();
        let key = if raw.is_some() && step <= period { key } else { "duration_ms" };
        self.require(rows <= MAX_ROWS, key, || {
            format!("a row every {spacing} over {duration} is {rows:.0} rows, expected at most {MAX_ROWS:.0}")
        })?;
        Ok(step)
    }

    fn tier(&self, model: &str, plate: &Plate) -> Result<Tier, Diagnostic> {
        if let Some(tier) = Scenario::tier_for(model, plate) {
            return match Scenario::omitted_effect(tier, plate) {
                None => Ok(tier),
                Some(message) => self.error("model", message),
            };
        }
        self.unknown_name("model", "unknown model ", model, &Scenario::models())
    }

    fn expected_exit(&self, raw: Option<i64>) -> Result<Option<u8>, Diagnostic> {
        match raw {
            None => Ok(None),
            Some(code @ (1 | 3 | 5)) => Ok(Some(code as u8)),
            Some(code) => self.error(
                "expected_exit",
                format!(
                    "{code}, expected 1 (something fails), 3 (something is inconclusive) or 5 (the controller is lost)"
                ),
            ),
        }
    }

    fn trials(&self, raw: &RawTrials) -> Result<Trials, Diagnostic> {
        let max_count = raw.max_count.unwrap_or(raw.count);
        self.require(raw.count <= max_count, "trials.max_count", || {
            format!("{max_count} trials, expected count ({}) to {MAX_TRIALS}", raw.count)
        })?;
        Ok(Trials { count: raw.count as u32, max_count: max_count as u32, seed: raw.seed as u64, spread: raw.spread })
    }

    fn check_trial_differences(&self, scenario: &Scenario) -> Result<(), Diagnostic> {
        let mut metrics = scenario.expectations.iter().map(|expectation| expectation.metric);
        let Some(compared) = metrics.find(|metric| metric.spec().trials == TrialRule::FromFirst) else {
            return Ok(());
        };
        self.require(scenario.trials.count > 1, "trials.count", || {
            format!("1 trial, expected at least 2 for {compared}")
        })
    }
}
