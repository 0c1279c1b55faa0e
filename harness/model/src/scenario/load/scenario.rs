//! Checks a scenario as a whole, with its controller, profiles, trials and scenes between trials.

use super::checker::MAX_DELAY_PERIODS;
use crate::metrics::{Metric, TrialRule};
use crate::scenario::definition::{
    AUTO_MODEL, Controller, InputFile, MAX_TRIALS, Scenario, ScenarioGains, Spread, Trials,
};
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::expect::{Comparison, Expectation};
use crate::scenario::load::checker::{Checker, Diagnostics, TrialContext};
use crate::scenario::load::expectation::expectation_names;
use crate::scenario::load::fault::CheckedFault;
use crate::scenario::matrix::Source;
use crate::scenario::own_law::{OWN_LAW, compares_with_bench_law};
use crate::scenario::raw::{
    DEFAULT_FREQUENCY_RANGE_HZ, DEFAULT_FREQUENCY_SLEW_HZ, DEFAULT_LAW, DEFAULT_PERIOD_MS, MAX_BETWEEN, RawBetween,
    RawController, RawOtherTrials, RawProfiles, RawScenario, RawTrials,
};
use crate::scenario::window::ProfileChanges;
use platebench_plate::{ConditionProfiles, Model, Plate, Profile, RawProfile, Time};
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::path::Path;

const DEFAULT_TRACE_STEP_MS: f64 = 0.05;
/// A longer scenario has one row per control period by default.
const MAX_FINE_TRACE_MS: f64 = 1_000.0;
/// Largest number of rows of a trial. All rows are in memory; 2 million need about 250 MB.
const MAX_ROWS: f64 = 2e6;
const MAX_EXPECTATIONS: usize = 2_000;

impl Checker<'_> {
    pub(super) fn check(&self, raw: RawScenario, file: &str) -> Result<Scenario, Vec<Diagnostic>> {
        let mut problems = Diagnostics::default();
        let scenario = self.scenario(raw, file, &mut problems);
        scenario.filter(|_| problems.0.is_empty()).ok_or(problems.0)
    }

    fn scenario(&self, raw: RawScenario, file: &str, problems: &mut Diagnostics) -> Option<Scenario> {
        let Source { path, text, case } = self.source;
        let folder = path.parent().unwrap_or_else(|| Path::new("."));
        problems.record_error(self.one_line("title", &raw.title));
        if let Some(reason) = &raw.only_if_named {
            problems.record_error(self.one_line("only_if_named", reason));
        }
        let mut inputs = vec![InputFile { path: path.to_owned(), bytes: text.as_bytes().to_vec() }];
        let trials = problems.record_error(self.trials(&raw.trials));
        let spread = raw.trials.spread;
        let plate = self.plate("plate", &folder.join(&raw.plate), &mut inputs, problems);
        let source = SceneSource { duration_ms: raw.duration_ms, controller: &raw.controller, profile: &raw.profile };
        let scene = self.scene(folder, &source, plate.as_ref(), spread, &mut inputs, problems);
        let timing = scene.controller.as_ref().zip(scene.duration);
        let trace_step = timing.and_then(|(controller, duration)| {
            problems.record_error(self.trace_step(raw.trace_step_ms, duration, controller.period))
        });
        problems.record_error(self.require(raw.expect.len() <= MAX_EXPECTATIONS, "expect", || {
            format!("{} [[expect]], expected at most {MAX_EXPECTATIONS}", raw.expect.len())
        }));
        problems.record_error(self.require(
            !raw.expect.is_empty(),
            "expect",
            || "no [[expect]], expected at least one: a scenario that expects nothing cannot fail",
        ));
        let model = raw.model.as_deref().unwrap_or(AUTO_MODEL);
        let model = plate.as_ref().and_then(|plate| problems.record_error(self.model(model, plate)));
        let expected_exit = problems.record_error(self.expected_exit(raw.expected_exit));
        let SceneParts { controller, duration, setpoint, conditions } = scene;
        let (Some(controller), Some(duration), Some(setpoint), Some(conditions)) =
            (controller, duration, setpoint, conditions)
        else {
            return None;
        };
        let count = problems.0.len();
        let table = |list: &str, index: usize| self.table(&format!("{list}.{index}"));
        let mut planned =
            (0..).zip(&raw.fault).map(|(index, raw)| table("fault", index).fault(raw, duration, controller.period));
        let (mut line_faults, mut chip_faults) = (Vec::new(), Vec::new());
        for fault in problems.record_errors(&mut planned) {
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
        let expected = problems.record_errors(&mut expected);
        problems.record_error(self.check_names(&raw.expect, &expected));
        if problems.0.len() > count {
            return None;
        }
        let mut scenario = Scenario {
            file: file.to_owned(),
            case: case.map(str::to_owned),
            title: raw.title,
            source: raw.source,
            tags: raw.tags,
            model: model?,
            only_if_named: raw.only_if_named,
            expected_exit: expected_exit?,
            timeout_s: raw.timeout_s,
            expectations: expected,
            not_applicable: Vec::new(),
            requirement_texts: BTreeMap::new(),
            faults: line_faults,
            chip_faults,
            between: Vec::new(),
            other_trials: None,
            messages: raw.message,
            conditions,
            inputs: Vec::new(),
            plate: plate?,
            duration,
            trace_step: trace_step?,
            controller,
            setpoint,
            trials: trials?,
        };
        problems.record_error(self.check_trial_differences(&scenario));
        let is_compared = scenario.expects(Metric::ProtocolDifferences);
        problems.record_error(self.check_messages(&scenario.messages, is_compared));
        problems.record_error(self.check_own_law(&scenario));
        scenario.between = self.scenes_between(folder, &raw.between, &scenario, &mut inputs, problems);
        let model = raw.model.as_deref().unwrap_or(AUTO_MODEL);
        let others = raw.other_trials.as_ref();
        scenario.other_trials = others
            .and_then(|raw| self.other_trials(folder, (raw, model), &scenario, &mut inputs, problems))
            .map(Box::new);
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

    fn model(&self, name: &str, plate: &Plate) -> Result<Model, Diagnostic> {
        if let Some(model) = Scenario::model_for(name, plate) {
            return match Scenario::omitted_effect(model, plate) {
                None => Ok(model),
                Some(message) => self.error("model", message),
            };
        }
        self.unknown_name("model", "unknown model ", name, &Scenario::models())
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

    fn check_own_law(&self, scenario: &Scenario) -> Result<(), Diagnostic> {
        let compares = |expectation: &Expectation| compares_with_bench_law(expectation.metric);
        let Some(index) = scenario.expectations.iter().position(compares).filter(|_| scenario.has_own_law()) else {
            return Ok(());
        };
        self.error(
            &format!("expect.{index}.metric"),
            format!("it compares with a law of the bench, expected another metric, or another law than `{OWN_LAW}`"),
        )
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

pub(super) struct SceneSource<'a> {
    pub(super) duration_ms: f64,
    pub(super) controller: &'a RawController,
    pub(super) profile: &'a RawProfiles,
}

/// Checked parts of a scene. A part with an error is `None`.
pub(super) struct SceneParts {
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
        problems: &mut Diagnostics,
    ) -> SceneParts {
        let SceneSource { duration_ms, controller: raw, profile: profiles } = *source;
        let design_plate = raw.design_plate.as_ref().map(|file| (file, "controller.design_plate"));
        let design_plate = design_plate.map(|(file, key)| self.plate(key, &folder.join(file), inputs, problems));
        let is_complete = design_plate.as_ref().is_none_or(Option::is_some);
        let controller = self.controller(raw, plate, design_plate.flatten(), problems).filter(|_| is_complete);
        let duration = problems.record_error(self.time_from_ms("duration_ms", duration_ms));
        if let (Some(controller), Some(duration)) = (&controller, duration) {
            problems.record_error(self.require(duration >= controller.period, "duration_ms", || {
                format!("{duration_ms} ms, expected at least one control period of {}", controller.period)
            }));
            problems.record_error(self.require(controller.loop_delay < duration, "controller.loop_delay_ms", || {
                format!(
                    "{}, expected less than the scenario's duration of {duration}: no command would act",
                    controller.loop_delay
                )
            }));
        }
        let length = duration.unwrap_or(Time::ZERO);
        let mut profile =
            |key: &str, raw: &RawProfile| problems.record_error(self.profile(folder, key, raw, length, inputs));
        let setpoint = profile("profile.setpoint_um", &profiles.setpoint_um);
        let temperature_offset_k = profile("profile.temperature_offset_k", &profiles.temperature_offset_k);
        let finger_force_n = profile("profile.finger_force_n", &profiles.finger_force_n);
        if let Some(setpoint) = &setpoint {
            problems.record_error(self.check_setpoints((folder, inputs), profiles, setpoint));
        }
        let conditions = temperature_offset_k.zip(finger_force_n);
        let conditions = conditions
            .map(|(temperature_offset_k, finger_force_n)| ConditionProfiles { temperature_offset_k, finger_force_n });
        if let (Some(plate), Some(conditions)) = (plate, &conditions) {
            problems.record_error(self.check_conditions((folder, inputs), profiles, plate, conditions, &spread));
        }
        SceneParts { controller, duration, setpoint, conditions }
    }

    /// The scene takes everything but plate, controller and profiles from `scenario`.
    fn other_trials(
        &self,
        folder: &Path,
        (raw, model): (&RawOtherTrials, &str),
        scenario: &Scenario,
        inputs: &mut Vec<InputFile>,
        problems: &mut Diagnostics,
    ) -> Option<Scenario> {
        const TABLE: &str = "other_trials";
        let compares = scenario.expects(Metric::TrialDifference);
        problems.record_error(self.require(compares, TABLE, || {
            let metric = Metric::TrialDifference;
            format!("no expectation of {metric}, expected at least one: nothing compares these trials with the first")
        }));
        let checker = self.table(TABLE);
        let plate = match &raw.plate {
            Some(file) => checker.plate("plate", &folder.join(file), inputs, problems)?,
            None => scenario.plate.clone(),
        };
        let duration_ms = scenario.duration.ms();
        let source = SceneSource { duration_ms, controller: &raw.controller, profile: &raw.profile };
        let scene = checker.scene(folder, &source, Some(&plate), scenario.trials.spread, inputs, problems);
        let model = problems.record_error(self.model(model, &plate))?;
        let controller = scene.controller?;
        let later = problems.record_error(checker.time_from_ms("later_ms", raw.later_ms))?;
        let [period, duration] = [controller.period, scenario.duration].map(Time::as_nanos);
        let rest = Time::from_nanos(duration - (duration - 1) / period * period);
        problems.record_error(checker.require(later <= rest, "later_ms", || {
            format!("{later}, expected at most {rest}, the time from the last control instant to the end of the trial")
        }));
        let comparison = Comparison { amplitude_factor: raw.amplitude_factor, later };
        let expectations = scenario.expectations.iter();
        Some(Scenario {
            expectations: expectations.map(|expectation| Expectation { comparison, ..expectation.clone() }).collect(),
            controller,
            setpoint: scene.setpoint?,
            conditions: scene.conditions?,
            model,
            plate,
            ..scenario.clone()
        })
    }

    /// The scenes take the trials and the spacing of trace rows from `scenario`.
    pub(super) fn scenes_between(
        &self,
        folder: &Path,
        raw: &[RawBetween],
        scenario: &Scenario,
        inputs: &mut Vec<InputFile>,
        problems: &mut Diagnostics,
    ) -> Vec<Scenario> {
        problems.record_error(self.require(raw.len() <= MAX_BETWEEN, "between", || {
            format!("{} scenes, expected at most {MAX_BETWEEN}", raw.len())
        }));
        let mut between = |(index, raw): (usize, &RawBetween)| {
            let checker = self.table(&format!("between.{index}"));
            let plate = match &raw.plate {
                Some(file) => checker.plate("plate", &folder.join(file), inputs, problems)?,
                None => scenario.plate.clone(),
            };
            let source =
                SceneSource { duration_ms: raw.duration_ms, controller: &raw.controller, profile: &raw.profile };
            let scene = checker.scene(folder, &source, Some(&plate), scenario.trials.spread, inputs, problems);
            Some(Scenario {
                file: format!("{}, between.{index}", scenario.file),
                controller: scene.controller?,
                duration: scene.duration?,
                setpoint: scene.setpoint?,
                conditions: scene.conditions?,
                model: if raw.plate.is_some() { Model::exact_for(&plate) } else { scenario.model },
                plate,
                expectations: Vec::new(),
                faults: Vec::new(),
                chip_faults: Vec::new(),
                messages: Vec::new(),
                ..scenario.clone()
            })
        };
        raw.iter().enumerate().take(MAX_BETWEEN).filter_map(&mut between).collect()
    }
}

impl Checker<'_> {
    pub(super) fn controller(
        &self,
        raw: &RawController,
        plate: Option<&Plate>,
        design_plate: Option<Plate>,
        problems: &mut Diagnostics,
    ) -> Option<Controller> {
        let period = problems.record_error(self.period(raw));
        let delays = period.and_then(|period| {
            let loop_delay = problems.record_error(self.loop_delay(raw, period));
            loop_delay.zip(problems.record_error(self.design_delay(raw, period)))
        });
        let start_frequency_hz = plate
            .map(|plate| design_plate.as_ref().unwrap_or(plate))
            .and_then(|plate| problems.record_error(self.start_frequency(raw, plate)));
        let optional = |key: &str, value: Option<f64>| value.map(|value| self.f32_range(key, value)).transpose();
        let key = "controller.frequency_range_hz";
        let range = problems.record_error(optional(key, raw.frequency_range_hz));
        let slew = problems.record_error(optional("controller.frequency_slew_hz", raw.frequency_slew_hz));
        if let (Some(Some(range)), Some(start_frequency_hz)) = (range, start_frequency_hz) {
            problems.record_error(self.require(range < start_frequency_hz, key, || {
                format!("{range} Hz, expected less than the start frequency of {start_frequency_hz:.1} Hz")
            }));
        }
        let law = raw.law.clone().unwrap_or_else(|| DEFAULT_LAW.to_owned());
        let is_named = !law.trim().is_empty();
        problems.record_error(self.require(is_named, "controller.law", || "an empty name, expected a control law"));
        let response_time_ms = problems.record_error(optional("controller.response_time_ms", raw.response_time_ms));
        let gains = problems.record_error(raw.gains.map(|gains| self.gains(gains)).transpose());
        let ([loop_delay, loop_delay_jitter], design_delay) = delays?;
        Some(Controller {
            law,
            period: period?,
            start_frequency_hz: start_frequency_hz?,
            loop_delay,
            loop_delay_jitter,
            design_delay,
            response_time_ms: response_time_ms?,
            frequency_range_hz: range?.unwrap_or(DEFAULT_FREQUENCY_RANGE_HZ),
            frequency_slew_hz: slew?.unwrap_or(DEFAULT_FREQUENCY_SLEW_HZ),
            gains: gains?,
            design_plate,
            insertion: None,
        })
    }

    fn period(&self, raw: &RawController) -> Result<Time, Diagnostic> {
        let period_ms = raw.period_ms.unwrap_or(DEFAULT_PERIOD_MS);
        let key = "controller.period_ms";
        let period = self.time_from_ms(key, period_ms)?;
        self.require(period.as_nanos() > 0 && period.as_nanos().is_multiple_of(1_000), key, || {
            format!("{period_ms} ms, expected whole microseconds: the wire carries no finer period")
        })?;
        Ok(period)
    }

    fn loop_delay(&self, raw: &RawController, period: Time) -> Result<[Time; 2], Diagnostic> {
        let key = "controller.loop_delay_ms";
        let loop_delay = self.time_from_ms(key, raw.loop_delay_ms)?;
        self.require(loop_delay <= period.times(MAX_DELAY_PERIODS), key, || {
            format!("{} ms, expected at most {MAX_DELAY_PERIODS} control periods", raw.loop_delay_ms)
        })?;
        let key = "controller.loop_delay_jitter_ms";
        let jitter = self.time_from_ms(key, raw.loop_delay_jitter_ms)?;
        self.require(loop_delay + jitter <= period.times(MAX_DELAY_PERIODS), key, || {
            let jitter = raw.loop_delay_jitter_ms;
            format!("{jitter} ms, expected at most {MAX_DELAY_PERIODS} control periods together with loop_delay_ms")
        })?;
        Ok([loop_delay, jitter])
    }

    fn design_delay(&self, raw: &RawController, period: Time) -> Result<Time, Diagnostic> {
        let key = "controller.design_delay_ms";
        let design_delay = self.time_from_ms(key, raw.design_delay_ms)?;
        self.require(design_delay <= period, key, || {
            format!("{} ms, expected at most one control period of {period}", raw.design_delay_ms)
        })?;
        self.require(design_delay.as_nanos().is_multiple_of(1_000), key, || {
            format!("{} ms, expected whole microseconds: the wire carries no finer delay", raw.design_delay_ms)
        })?;
        Ok(design_delay)
    }

    fn start_frequency(&self, raw: &RawController, plate: &Plate) -> Result<f64, Diagnostic> {
        let resonance_hz = plate.omega0 / TAU;
        let key = "controller.start_frequency_hz";
        let start_frequency_hz = raw.start_frequency_hz.unwrap_or(resonance_hz);
        let share = start_frequency_hz / resonance_hz;
        self.require((0.5..=1.5).contains(&share), key, || {
            format!(
                "{start_frequency_hz} Hz, expected between 0.5 and 1.5 times the plate's resonance of \
                 {resonance_hz:.1} Hz"
            )
        })?;
        Ok(start_frequency_hz)
    }

    fn gains(&self, gains: ScenarioGains) -> Result<ScenarioGains, Diagnostic> {
        for (name, value) in [
            ("amplitude_kp", gains.amplitude_kp),
            ("amplitude_ki", gains.amplitude_ki),
            ("frequency_kp", gains.frequency_kp),
            ("frequency_ki", gains.frequency_ki),
        ] {
            let key = format!("controller.gains.{name}");
            self.f32_range(&key, value)?;
        }
        Ok(gains)
    }
}
