//! Measures the margins of a controller as a black box: plays it with an inserted gain, delay,
//! detuning or force, and bisects to the last value at which the requirements hold, and to the last
//! one at which the loop is stable.

pub mod report;
pub mod result;
pub mod scenes;

use crate::law_loops::LoopCase;
use crate::loops::{ClosedLoop, LoopError, LoopTiming, delay_boundary};
use platebench_engine::workers::in_parallel;
use platebench_engine::{
    CancelToken, Executor, ExecutorSettings, FirmwareDigest, LinkFactory, MAX_LOSSES, RunError, SafeEnds, TrialResult,
    law, why_not_applicable,
};
use platebench_model::record::{Cause, Verdict};
use platebench_model::scenario::{Aggregation, Diagnostic, Expectation, Metric, Scenario, Window};
use platebench_plate::{Model, Time};
use platebench_verdict::statistics::mean_bounds;
use platebench_verdict::{Measure, TrialMeasures, judge, measure, metrics};
use platebench_wire::{Identity, LawId};
use result::{CaseMargins, Edge, Margin, NoiseGain};
use scenes::{Criterion, OperatingPoint, Quantity, insertion_time, is_stable, noise_scene, steady_scene, vibration};
use std::time::Instant;

/// Largest number of trials of a search. With twelve searches, a step and the trials with noise, an
/// operating point needs at most 300.
const MAX_SEARCH_TRIALS: u64 = 24;
const NOISE_TRIALS: u64 = 5;
/// Further seeds at both ends of the interval of a search, if the plate is noisy.
const RETESTS: u64 = 3;
const MAX_PREDICTED_PERIODS: f64 = 12.0;

#[derive(Debug, thiserror::Error)]
pub enum MarginError {
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Files(Vec<Diagnostic>),
    #[error(transparent)]
    Run(#[from] RunError),
    #[error(transparent)]
    Analysis(#[from] LoopError),
    #[error(
        "{file}: the expectation {name} is about several trials, expected expectations of each trial; a campaign \
         judges several"
    )]
    SeveralTrials { file: String, name: String },
    #[error("{file}: no expectation has a requirement that begins with {class}")]
    NoRequirement { file: String, class: String },
    #[error("{0}")]
    NotApplicable(String),
    #[error("a trial does not count: {reason}")]
    Undecided { cause: Cause, reason: String },
}

pub struct MarginConfig<'a> {
    pub rig: String,
    pub is_reference: bool,
    /// Laws at operating points.
    pub cases: &'a [Scenario],
    pub quantities: &'a [Quantity],
    pub own_clock: bool,
    pub jobs: usize,
    pub cancel: &'a CancelToken,
}

/// Keeps the expectations whose requirement begins with `class`, and judges each trial alone.
pub fn select_requirements(scenario: &mut Scenario, class: Option<&str>) -> Result<(), MarginError> {
    let file = || scenario.file.clone();
    if let Some(class) = class {
        let is_selected = |found: &Expectation| found.requirement.as_deref().is_some_and(|id| id.starts_with(class));
        if !scenario.expectations.iter().any(is_selected) {
            return Err(MarginError::NoRequirement { file: file(), class: class.to_owned() });
        }
        scenario.expectations.retain(is_selected);
    }
    for expectation in &mut scenario.expectations {
        if matches!(expectation.aggregation, Aggregation::StandardDeviation) {
            return Err(MarginError::SeveralTrials { file: scenario.file.clone(), name: expectation.name.clone() });
        }
        // A value is played once.
        expectation.aggregation = Aggregation::Each;
    }
    Ok(())
}

/// Connects, and returns the controller's identity.
pub fn identify(connect: &LinkFactory<'_>, ends: &SafeEnds, cancel: &CancelToken) -> Result<Identity, MarginError> {
    let mut executor = Executor::new(connect, ExecutorSettings::lockstep(cancel), ends);
    Ok(*executor.session()?.identity())
}

/// Measures the cases that apply to the controller. Also returns why others do not apply.
/// `on_progress` gets the number of ended searches and of all.
pub fn measure_margins(
    config: &MarginConfig<'_>,
    connect: &LinkFactory<'_>,
    ends: &SafeEnds,
    on_progress: &mut dyn FnMut(usize, usize),
) -> Result<(Vec<CaseMargins>, Vec<String>), MarginError> {
    let firmware = FirmwareDigest::of_rig(&config.rig);
    let settings = ExecutorSettings {
        own_clock: config.own_clock,
        firmware: Some(&firmware),
        max_losses: Some(MAX_LOSSES),
        ..ExecutorSettings::lockstep(config.cancel)
    };
    let mut first = Executor::new(connect, settings.clone(), ends);
    let (cases, skipped) = applicable_cases(config, &mut first)?;
    let tasks: Vec<Task<'_>> = cases.iter().flat_map(|case| Task::of_case(case, config.quantities)).collect();
    let further = (1..config.jobs).map(|_| Executor::new(connect, settings.clone(), ends));
    let executors = std::iter::once(first).chain(further);
    let mut results = Vec::with_capacity(tasks.len());
    in_parallel(executors, &tasks, TaskResult::play, |result| {
        results.push(result);
        on_progress(results.len(), tasks.len());
        true
    })?;
    if config.cancel.is_cancelled() || results.len() < tasks.len() {
        return Err(RunError::Cancelled.into());
    }
    let parts = results.chunks((tasks.len() / cases.len().max(1)).max(1));
    let measured = cases.iter().zip(parts).map(|(case, parts)| case_margins(config, case, parts));
    Ok((measured.collect::<Result<_, _>>()?, skipped))
}

fn applicable_cases<'a>(
    config: &MarginConfig<'a>,
    executor: &mut Executor<'_>,
) -> Result<(Vec<&'a Scenario>, Vec<String>), MarginError> {
    let (mut cases, mut skipped) = (Vec::new(), Vec::new());
    for case in config.cases {
        let law = law(case).map_err(|problem| MarginError::Files(vec![problem]))?;
        match why_not_applicable(case, law, true, executor.session()?) {
            Err(problem) => return Err(MarginError::Files(vec![*problem])),
            Ok(None) => cases.push(case),
            Ok(Some(reason)) if skipped.contains(&reason) => {}
            Ok(Some(reason)) => skipped.push(reason),
        }
    }
    Ok((cases, skipped))
}

#[derive(Debug, Clone, Copy)]
enum Task<'a> {
    Search(&'a Scenario, Quantity, Criterion),
    Nominal(&'a Scenario),
    Noise(&'a Scenario),
}

impl<'a> Task<'a> {
    fn of_case(case: &'a Scenario, quantities: &'a [Quantity]) -> impl Iterator<Item = Self> {
        let both = |quantity| [Criterion::Requirement, Criterion::Stability].map(|by| Self::Search(case, quantity, by));
        [Self::Nominal(case), Self::Noise(case)].into_iter().chain(quantities.iter().copied().flat_map(both))
    }
}

enum TaskResult {
    Edge(Edge),
    Nominal { failing: Option<String>, settling_ms: Option<f64>, static_error: Option<f64>, instructions: Option<f64> },
    Noise { gain: Option<NoiseGain>, time_per_step_us: Option<f64> },
}

impl TaskResult {
    fn play(executor: &mut Executor<'_>, task: &Task<'_>) -> Result<Self, MarginError> {
        match *task {
            Task::Search(case, quantity, criterion) => {
                Search { executor, case, quantity, criterion }.edge().map(Self::Edge)
            }
            Task::Nominal(case) => nominal(executor, case),
            Task::Noise(case) => noise_gain(executor, case),
        }
    }
}

struct Search<'a, 'b> {
    executor: &'a mut Executor<'b>,
    case: &'a Scenario,
    quantity: Quantity,
    criterion: Criterion,
}

/// A played value, whether it holds, and the first failing expectation.
type Test = (f64, bool, Option<String>);

impl Search<'_, '_> {
    fn edge(mut self) -> Result<Edge, MarginError> {
        let (mut tests, identity): (Vec<Test>, f64) = (Vec::new(), self.quantity.identity());
        let scan = std::iter::once(identity).chain(self.quantity.scan(self.case));
        for value in scan {
            if !self.test(value, 0, &mut tests)? {
                break;
            }
        }
        let is_noisy = self.case.plate.noise_um_rms > 0.0;
        let most = MAX_SEARCH_TRIALS - if is_noisy { 2 * RETESTS } else { 0 };
        while let (Some(low), Some(high)) = ends(&tests)
            && high - low > self.quantity.resolution(self.case, high)
            && (tests.len() as u64) < most
        {
            self.test(f64::midpoint(low, high), 0, &mut tests)?;
        }
        if is_noisy {
            let (low, high) = ends(&tests);
            for value in low.into_iter().chain(high) {
                for seed in 1..=RETESTS {
                    self.test(value, seed, &mut tests)?;
                }
            }
        }
        let (low, high) = ends(&tests);
        let point = OperatingPoint::of(self.case);
        let absolute = |value: f64| self.quantity.absolute(&point, value);
        let failing = tests.iter().find(|(value, holds, _)| Some(*value) == high && !holds);
        Ok(Edge {
            holds_to: low.map(absolute),
            fails_from: high.map(absolute),
            failing: failing.and_then(|(_, _, name)| name.clone()),
            trials: tests.len() as u32,
        })
    }

    fn test(&mut self, value: f64, seed: u64, tests: &mut Vec<Test>) -> Result<bool, MarginError> {
        let mut scene;
        match self.criterion {
            Criterion::Requirement => {
                scene = self.case.clone();
                self.quantity.apply(&mut scene, value, Time::ZERO);
            }
            Criterion::Stability => {
                let mut changed = self.case.clone();
                self.quantity.apply(&mut changed, value, insertion_time(self.case));
                scene = steady_scene(&changed);
            }
        }
        scene.trials.seed = scene.trials.seed.wrapping_add(seed);
        let (played, measures) = play(self.executor, &scene)?;
        let (holds, failing) = match self.criterion {
            Criterion::Requirement => {
                let failing = first_failing(&scene, measures);
                (failing.is_none(), failing)
            }
            Criterion::Stability => {
                let ended = played.link_error.is_some() || measures.ended.is_some() || measures.stopped.is_some();
                (!ended && is_stable(&scene, &played.trace_rows), None)
            }
        };
        tests.push((value, holds, failing));
        Ok(holds)
    }
}

/// Largest value up to which every test holds, and smallest value from which on every test fails.
fn ends(tests: &[Test]) -> (Option<f64>, Option<f64>) {
    let of = |held: bool| tests.iter().filter(move |test| test.1 == held).map(|test| test.0);
    let low = of(true).filter(|value| of(false).all(|failed| failed > *value)).reduce(f64::max);
    let high = of(false).filter(|value| of(true).all(|held| held < *value)).reduce(f64::min);
    (low, high)
}

fn play(executor: &mut Executor<'_>, scene: &Scenario) -> Result<(TrialResult, TrialMeasures), MarginError> {
    let law = law(scene).map_err(|problem| MarginError::Files(vec![problem]))?;
    let played = executor.play(scene, law, 0, None)?.ok_or(RunError::Cancelled)?;
    let measures = measure(scene, 0, &played.trace_rows, &played.telemetry);
    match &measures.exclusion {
        Some(found) if matches!(found.cause(), Cause::Rig | Cause::Bench) => {
            Err(MarginError::Undecided { cause: found.cause(), reason: found.to_string() })
        }
        _ => Ok((played, measures)),
    }
}

fn first_failing(scene: &Scenario, measures: TrialMeasures) -> Option<String> {
    let judgement = judge(scene, &[measures]);
    judgement.expectations.into_iter().find(|found| found.verdict != Verdict::Pass).map(|found| found.name)
}

fn nominal(executor: &mut Executor<'_>, case: &Scenario) -> Result<TaskResult, MarginError> {
    let (played, measures) = play(executor, case)?;
    let first_step = case.setpoint.next_point_after(Time::ZERO).unwrap_or(Time::ZERO);
    let value = |metric: Metric, from: Time| {
        let window = Window { from, to: case.duration };
        let window = if metric == Metric::StaticError { window.last_third() } else { window };
        let expectation = Expectation::for_window(metric, window);
        match metrics::measure(&expectation, &played.trace_rows, &played.telemetry) {
            Measure::Value(value) => Some(value),
            _ => None,
        }
    };
    Ok(TaskResult::Nominal {
        settling_ms: value(Metric::SettlingTime, first_step),
        static_error: value(Metric::StaticError, Time::ZERO).map(f64::abs),
        instructions: played.telemetry.instructions_mean,
        failing: first_failing(case, measures),
    })
}

fn noise_gain(executor: &mut Executor<'_>, case: &Scenario) -> Result<TaskResult, MarginError> {
    let (mut gains, mut fastest) = (Vec::new(), f64::INFINITY);
    for seed in 0..NOISE_TRIALS {
        let scene = noise_scene(case, seed);
        let started = Instant::now();
        let (played, _) = play(executor, &scene)?;
        let steps = scene.duration.seconds() / scene.controller.period.seconds();
        fastest = fastest.min(started.elapsed().as_secs_f64() * 1e6 / steps);
        let settled = vibration(&played.trace_rows, insertion_time(&scene), scene.duration);
        let settled: Vec<f64> = settled.iter().map(|w| w.norm()).collect();
        let mean = settled.iter().sum::<f64>() / settled.len() as f64;
        let variance = settled.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / settled.len() as f64;
        if played.link_error.is_none() {
            gains.push(variance.sqrt() / scene.plate.noise_um_rms);
        }
    }
    let count = gains.len();
    let gain = (count > 0).then(|| NoiseGain {
        value: gains.iter().sum::<f64>() / count as f64,
        interval: mean_bounds(&gains, 0.95).map(|(interval, _)| interval),
        trials: count as u32,
    });
    Ok(TaskResult::Noise { gain, time_per_step_us: (count > 0).then_some(fastest) })
}

fn case_margins(config: &MarginConfig<'_>, case: &Scenario, parts: &[TaskResult]) -> Result<CaseMargins, MarginError> {
    let mut result = CaseMargins {
        rig: config.rig.clone(),
        law: case.controller.law.clone(),
        is_reference: config.is_reference,
        point: OperatingPoint::of(case),
        expectations: case.expectations.iter().map(|expectation| expectation.name.clone()).collect(),
        failing: None,
        settling_ms: None,
        static_error_percent: None,
        instructions_per_step: None,
        time_per_step_us: None,
        noise_gain: None,
        margins: Vec::new(),
        trials: 0,
    };
    let mut edges = Vec::new();
    for part in parts {
        match part {
            TaskResult::Edge(edge) => {
                result.trials += edge.trials;
                edges.push(edge.clone());
            }
            TaskResult::Nominal { failing, settling_ms, static_error, instructions } => {
                result.trials += 1;
                result.failing.clone_from(failing);
                (result.settling_ms, result.static_error_percent) = (*settling_ms, *static_error);
                result.instructions_per_step = *instructions;
            }
            TaskResult::Noise { gain, time_per_step_us } => {
                result.trials += NOISE_TRIALS as u32;
                (result.noise_gain, result.time_per_step_us) = (*gain, *time_per_step_us);
            }
        }
    }
    let predicted = predicted_limits(case)?;
    let (pairs, _) = edges.as_chunks();
    for (&quantity, [requirement, stability]) in config.quantities.iter().zip(pairs) {
        let predicted = predicted.iter().find(|(known, _)| *known == quantity).map(|(_, limit)| *limit);
        let (requirement, stability) = (requirement.clone(), stability.clone());
        result.margins.push(Margin { quantity, requirement, stability, predicted });
    }
    Ok(result)
}

/// Stability limits of the bench's law, as far as the loop analysis has them.
fn predicted_limits(case: &Scenario) -> Result<Vec<(Quantity, f64)>, MarginError> {
    let known = LawId::from_name(&case.controller.law).and_then(|law| LoopCase::of_scenario(case, law));
    let Some((plant, controller)) = known.and_then(|known| known.linearise(Model::Modal)) else {
        return Ok(Vec::new());
    };
    let period = case.controller.period.seconds();
    let timing = LoopTiming { period, delay: case.controller.loop_delay.seconds() };
    let boundary = delay_boundary(&plant, &controller, period, MAX_PREDICTED_PERIODS * period)?;
    let closed = ClosedLoop::new(plant, controller, timing)?;
    let limits = [
        (Quantity::DriveGain, closed.loop_margins(0).gain),
        (Quantity::FrequencyGain, closed.loop_margins(1).gain),
        (Quantity::Delay, boundary.seconds().map(|seconds| (seconds - timing.delay) / period)),
    ];
    Ok(limits.into_iter().filter_map(|(quantity, limit)| Some((quantity, limit?))).collect())
}
