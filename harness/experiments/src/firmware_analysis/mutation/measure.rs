//! Plays the scenarios that execute a mutant until one of them fails.

use super::candidates::{MutantFilter, all_mutants};
use super::disassembler::Disassembler;
use super::mutant::Mutant;
use super::result::{MutantResult, MutationReport, Score, Status};
use crate::firmware_analysis::code_map::CodeMap;
use crate::firmware_analysis::coverage::{Baseline, executed_by_all, play_baselines};
use crate::firmware_analysis::error::AnalysisError;
use crate::firmware_analysis::suite::{BoardExecutor, Margin, Outcome, Suite, new_executor, play};
use platebench_engine::SafeEnds;
use platebench_engine::parallel::in_parallel;
use platebench_engine::plan::LinkFactory;
use platebench_rig::{CancelToken, EmulatedLink};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

/// Longest time of a mutant, relative to the time of the unchanged firmware.
const TIMEOUT_FACTOR: u32 = 10;
const MIN_TIMEOUT: Duration = Duration::from_secs(20);
const POLL_INTERVAL: Duration = Duration::from_millis(50);

#[derive(Debug)]
pub struct MutationConfig {
    pub suite: Suite,
    pub filter: MutantFilter,
    /// Number of mutants to draw at random. `None` tests all mutants.
    pub sample: Option<usize>,
    /// Stops at this width of the 95 % interval of the score, in percentage points.
    pub until_width: Option<f64>,
    pub seed: u64,
    pub jobs: usize,
    pub cancel: CancelToken,
}

pub fn measure_mutation(
    config: &MutationConfig,
    on_result: &mut dyn FnMut(&MutantResult),
) -> Result<MutationReport, AnalysisError> {
    let suite = &config.suite;
    let (symbols, map) = suite.code()?;
    let baselines = play_baselines(suite, &map, config.jobs, &config.cancel)?;
    let executed = executed_by_all(&baselines);
    let mut mutants = all_mutants(&map, &symbols, &Disassembler::new()?, &config.filter, &executed);
    if mutants.is_empty() {
        let wanted = config.filter.functions.iter().chain(&config.filter.files).next();
        return Err(AnalysisError::NoMatch(wanted.cloned().unwrap_or_default()));
    }
    let population = mutants.len();
    if config.sample.is_some() || config.until_width.is_some() {
        shuffle(&mut mutants, config.seed);
        mutants.truncate(config.sample.unwrap_or(population));
    }
    let mut order: Vec<usize> = (0..baselines.len()).collect();
    order.sort_by_key(|&index| baselines.get(index).map(|baseline| baseline.duration));
    let (connect, ends) = (|| suite.connect(), SafeEnds::default());
    let runner =
        MutantRunner { config, map: &map, baselines: &baselines, order: &order, connect: &connect, ends: &ends };
    let mut results: Vec<MutantResult> = Vec::new();
    let work = |executor: &mut Option<_>, mutant: &Mutant| runner.run(executor, mutant);
    in_parallel(config.jobs, &mutants, work, |result| {
        on_result(&result);
        results.push(result);
        let score = Score::of(results.iter().map(|result| &result.status));
        !config.until_width.is_some_and(|width| score.is_narrower_than(width))
    })?;
    let scenarios = suite.scenarios.iter().map(|(scenario, _)| scenario.file.clone()).collect();
    Ok(MutationReport { results, population, scenarios })
}

/// Algorithm of Fisher and Yates.
fn shuffle(mutants: &mut [Mutant], seed: u64) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    for last in (1..mutants.len()).rev() {
        mutants.swap(last, (random.next_u64() % (last as u64 + 1)) as usize);
    }
}

struct MutantRunner<'a> {
    config: &'a MutationConfig,
    map: &'a CodeMap,
    baselines: &'a [Baseline],
    /// Indices of the scenarios, fastest first.
    order: &'a [usize],
    connect: &'a LinkFactory<'a, EmulatedLink>,
    ends: &'a SafeEnds,
}

impl<'a> MutantRunner<'a> {
    fn run(&self, executor: &mut Option<BoardExecutor<'a>>, mutant: &Mutant) -> Result<MutantResult, AnalysisError> {
        let start = Instant::now();
        let leader = self.map.leader_of(mutant.instruction);
        let covers = |baseline: &Baseline| !baseline.fails && baseline.executed.contains_key(&leader);
        let covering: Vec<usize> =
            self.order.iter().copied().filter(|&index| self.baselines.get(index).is_some_and(covers)).collect();
        let status = if covering.is_empty() { Status::NoCoverage } else { self.play(executor, mutant, &covering)? };
        let file = |&index: &usize| Some(self.config.suite.scenarios.get(index)?.0.file.clone());
        let covered_by = covering.iter().filter_map(file).collect();
        Ok(MutantResult { mutant: mutant.clone(), status, covered_by, duration: start.elapsed() })
    }

    fn play(
        &self,
        executor: &mut Option<BoardExecutor<'a>>,
        mutant: &Mutant,
        covering: &[usize],
    ) -> Result<Status, AnalysisError> {
        let open = executor.get_or_insert_with(|| new_executor(self.connect, &self.config.cancel, self.ends));
        open.session()?.link_mut().inner_mut().patch(mutant.address, &mutant.bytes);
        let status = self.play_until_detected(open, covering)?;
        open.session()?.link_mut().inner_mut().patch(mutant.address, &mutant.original);
        if matches!(status, Status::RuntimeError { .. }) {
            *executor = None;
        }
        Ok(status)
    }

    fn play_until_detected(
        &self,
        executor: &mut BoardExecutor<'_>,
        covering: &[usize],
    ) -> Result<Status, AnalysisError> {
        let mut closest: Option<Margin> = None;
        let mut same_commands = true;
        for &index in covering {
            let (Some((scenario, law)), Some(baseline)) =
                (self.config.suite.scenarios.get(index), self.baselines.get(index))
            else {
                continue;
            };
            let limit = (baseline.duration * TIMEOUT_FACTOR).max(MIN_TIMEOUT);
            let played = with_deadline(limit, &self.config.cancel, |cancel| {
                executor.set_cancel(cancel);
                play(executor, scenario, *law)
            });
            if self.config.cancel.is_cancelled() {
                return Err(AnalysisError::Cancelled);
            }
            let by = scenario.file.clone();
            let Some(outcome) = played? else { return Ok(Status::Timeout { by }) };
            let Outcome { detection, closest_margin, commands, .. } = outcome;
            same_commands &= commands == baseline.commands;
            match detection {
                Some(detection) if detection.emulator_failed => {
                    return Ok(Status::RuntimeError { by, reason: detection.reason });
                }
                Some(detection) => return Ok(Status::Killed { by, reason: detection.reason }),
                None => {}
            }
            closest =
                closest.into_iter().chain(closest_margin).min_by(|one, other| one.margin.total_cmp(&other.margin));
        }
        Ok(Status::Survived { closest, same_commands })
    }
}

/// Cancels `work` after `limit`, or if `cancel` is cancelled.
fn with_deadline<R>(limit: Duration, cancel: &CancelToken, work: impl FnOnce(&CancelToken) -> R) -> R {
    let token = CancelToken::default();
    let (done, ended) = mpsc::channel::<()>();
    thread::scope(|scope| {
        let watched = token.clone();
        scope.spawn(move || {
            let start = Instant::now();
            while ended.recv_timeout(POLL_INTERVAL) == Err(RecvTimeoutError::Timeout) {
                if start.elapsed() > limit || cancel.is_cancelled() {
                    watched.cancel();
                }
            }
        });
        let result = work(&token);
        drop(done);
        result
    })
}
