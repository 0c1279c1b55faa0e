//! Changes one machine instruction at a time and checks whether the scenarios notice. See
//! `docs/mutation.md`.

pub mod mutants;

use crate::firmware_analysis::code_map::CodeMap;
use crate::firmware_analysis::error::FirmwareAnalysisError;
use crate::firmware_analysis::suite::{
    BoardExecutor, ExpectationMargin, FirmwareSuite, SuiteOutcome, new_executor, play,
};
use crate::firmware_analysis::{ReferencePlay, executed_by_all, play_baselines};
use mutants::{CodeMutant, Disassembler, MutantFilter, MutationOperator, all_mutants};
use platebench_document::{Block, Column, Document, Table};
use platebench_engine::workers::in_parallel;
use platebench_engine::{RunError, SafeEnds};
use platebench_model::scenario::Scenario;
use platebench_model::trace::read_text_file;
use platebench_rig::CancelToken;
use platebench_verdict::statistics::clopper_pearson;
use platebench_wire::LawId;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use serde_json::{Map, Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

/// Longest time of a mutant, relative to the time of the unchanged firmware.
const TIMEOUT_FACTOR: u32 = 10;
const MIN_TIMEOUT: Duration = Duration::from_secs(20);
const POLL_INTERVAL: Duration = Duration::from_millis(50);

#[derive(Debug)]
pub struct MutationConfig {
    pub suite: FirmwareSuite,
    pub filter: MutantFilter,
    /// Number of mutants to draw at random. `None` tests all mutants.
    pub sample: Option<usize>,
    /// Stops at this width of the 95 % interval of the score, in percentage points.
    pub until_width: Option<f64>,
    pub seed: u64,
    pub jobs: usize,
    pub cancel: CancelToken,
}

/// Also returns the error that ended the test early, with the results before it.
pub fn measure_mutation(
    config: &MutationConfig,
    on_result: &mut dyn FnMut(&CodeMutantResult),
) -> Result<(MutationReport, Option<FirmwareAnalysisError>), FirmwareAnalysisError> {
    let suite = &config.suite;
    let (symbols, map) = suite.code()?;
    let baselines = play_baselines(suite, &map, config.jobs, &config.cancel)?;
    let executed = executed_by_all(&baselines);
    let mut mutants = all_mutants(&map, &symbols, &Disassembler::new()?, &config.filter, &executed);
    if mutants.is_empty() {
        let wanted = config.filter.functions.iter().chain(&config.filter.files).next();
        return Err(FirmwareAnalysisError::NoMatch(wanted.cloned().unwrap_or_default()));
    }
    let population = mutants.len();
    if config.sample.is_some() || config.until_width.is_some() {
        shuffle(&mut mutants, config.seed);
        mutants.truncate(config.sample.unwrap_or(population));
    }
    let mut order: Vec<usize> = (0..baselines.len()).collect();
    order.sort_by_key(|&index| baselines.get(index).map(|baseline| baseline.duration));
    let (connect, ends) = (|| suite.connect(), SafeEnds::default());
    let executors = (0..config.jobs.max(1)).map(|_| new_executor(&connect, &config.cancel, &ends));
    let runner = MutantRunner { config, map: &map, baselines: &baselines, order: &order };
    let mut results: Vec<CodeMutantResult> = Vec::new();
    let work = |executor: &mut BoardExecutor<'_>, mutant: &CodeMutant| runner.run(executor, mutant);
    let outcome = in_parallel(executors, &mutants, work, |result| {
        on_result(&result);
        results.push(result);
        let score = Score::of(results.iter().map(|result| &result.status));
        !config.until_width.is_some_and(|width| score.is_narrower_than(width))
    });
    let scenarios = suite.scenarios.iter().map(|(scenario, _)| scenario.file.clone()).collect();
    match outcome.err() {
        Some(error) if results.is_empty() => Err(error),
        error => Ok((MutationReport { results, population, scenarios }, error)),
    }
}

/// Algorithm of Fisher and Yates.
fn shuffle(mutants: &mut [CodeMutant], seed: u64) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    for last in (1..mutants.len()).rev() {
        mutants.swap(last, (random.next_u64() % (last as u64 + 1)) as usize);
    }
}

struct MutantRunner<'a> {
    config: &'a MutationConfig,
    map: &'a CodeMap,
    baselines: &'a [ReferencePlay],
    /// Indices of the scenarios, fastest first.
    order: &'a [usize],
}

impl MutantRunner<'_> {
    fn run(
        &self,
        executor: &mut BoardExecutor<'_>,
        mutant: &CodeMutant,
    ) -> Result<CodeMutantResult, FirmwareAnalysisError> {
        let start = Instant::now();
        let leader = self.map.leader_of(mutant.instruction);
        let covers = |baseline: &ReferencePlay| !baseline.fails && baseline.executed.contains_key(&leader);
        let covering: Vec<usize> =
            self.order.iter().copied().filter(|&index| self.baselines.get(index).is_some_and(covers)).collect();
        let status =
            if covering.is_empty() { MutantStatus::NoCoverage } else { self.play(executor, mutant, &covering)? };
        let file = |&index: &usize| Some(self.config.suite.scenarios.get(index)?.0.file.clone());
        let covered_by = covering.iter().filter_map(file).collect();
        Ok(CodeMutantResult { mutant: mutant.clone(), status, covered_by, duration: start.elapsed() })
    }

    fn play(
        &self,
        executor: &mut BoardExecutor<'_>,
        mutant: &CodeMutant,
        covering: &[usize],
    ) -> Result<MutantStatus, FirmwareAnalysisError> {
        executor.session()?.link_mut().inner_mut().patch(mutant.address, &mutant.bytes);
        let status = self.play_until_detected(executor, covering)?;
        executor.session()?.link_mut().inner_mut().patch(mutant.address, &mutant.original);
        if matches!(status, MutantStatus::RuntimeError { .. }) {
            // The emulator is in an unknown state, so the next mutant gets a new one.
            executor.close();
        }
        Ok(status)
    }

    fn play_until_detected(
        &self,
        executor: &mut BoardExecutor<'_>,
        covering: &[usize],
    ) -> Result<MutantStatus, FirmwareAnalysisError> {
        let mut closest: Option<ExpectationMargin> = None;
        let mut same_commands = true;
        for &index in covering {
            let (Some((scenario, law)), Some(baseline)) =
                (self.config.suite.scenarios.get(index), self.baselines.get(index))
            else {
                continue;
            };
            let limit = (baseline.duration * TIMEOUT_FACTOR).max(MIN_TIMEOUT);
            let played = play_within(limit, &self.config.cancel, executor, scenario, *law);
            if self.config.cancel.is_cancelled() {
                return Err(RunError::Cancelled.into());
            }
            let by = scenario.file.clone();
            let Some(outcome) = played? else { return Ok(MutantStatus::Timeout { by }) };
            let SuiteOutcome { detection, closest_margin, commands, .. } = outcome;
            same_commands &= commands == baseline.commands;
            match detection {
                Some(detection) if detection.emulator_failed => {
                    return Ok(MutantStatus::RuntimeError { by, reason: detection.reason });
                }
                Some(detection) => return Ok(MutantStatus::Killed { by, reason: detection.reason }),
                None => {}
            }
            closest =
                closest.into_iter().chain(closest_margin).min_by(|one, other| one.margin.total_cmp(&other.margin));
        }
        Ok(MutantStatus::Survived { closest, same_commands })
    }
}

/// `None` if the time limit or `cancel` ended the scenario.
fn play_within(
    limit: Duration,
    cancel: &CancelToken,
    executor: &mut BoardExecutor<'_>,
    scenario: &Scenario,
    law: LawId,
) -> Result<Option<SuiteOutcome>, FirmwareAnalysisError> {
    let played = with_deadline(limit, cancel, |token| {
        executor.set_cancel(token);
        play(executor, scenario, law)
    });
    // The cancelled token would also cancel the next connection.
    executor.set_cancel(cancel);
    played
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

/// Each end of the 95 % interval of the score has half of the error probability.
const ONE_SIDED_CONFIDENCE: f64 = 0.975;

#[derive(Debug, Clone, PartialEq, strum::IntoStaticStr)]
#[strum(const_into_str)]
pub enum MutantStatus {
    Killed {
        by: String,
        reason: String,
    },
    Survived {
        closest: Option<ExpectationMargin>,
        /// True if every drive and frequency is that of the unchanged firmware.
        same_commands: bool,
    },
    NoCoverage,
    /// A scenario took much longer than with the unchanged firmware.
    Timeout {
        by: String,
    },
    /// The emulator failed.
    RuntimeError {
        by: String,
        reason: String,
    },
}

impl MutantStatus {
    /// Name of the status in the schema of mutation reports.
    pub const fn name(&self) -> &'static str {
        self.into_str()
    }

    pub const fn is_detected(&self) -> bool {
        matches!(self, Self::Killed { .. } | Self::Timeout { .. })
    }

    const fn is_valid(&self) -> bool {
        !matches!(self, Self::RuntimeError { .. })
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct CodeMutantResult {
    pub mutant: CodeMutant,
    pub status: MutantStatus,
    /// Scenarios that execute the instruction, fastest first.
    pub covered_by: Vec<String>,
    pub duration: Duration,
}

#[derive(Debug, Clone, PartialEq)]
pub struct MutationReport {
    pub results: Vec<CodeMutantResult>,
    /// Number of selected mutants, including those that were not drawn.
    pub population: usize,
    pub scenarios: Vec<String>,
}

/// Detected mutants divided by valid mutants. A mutant that the emulator cannot run is not valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Score {
    pub detected: u32,
    pub valid: u32,
}

impl Score {
    pub fn of<'a>(statuses: impl Iterator<Item = &'a MutantStatus>) -> Self {
        statuses.filter(|status| status.is_valid()).fold(Self { detected: 0, valid: 0 }, |score, status| Self {
            detected: score.detected + u32::from(status.is_detected()),
            valid: score.valid + 1,
        })
    }

    pub fn percent(self) -> f64 {
        if self.valid == 0 { 100.0 } else { f64::from(self.detected) / f64::from(self.valid) * 100.0 }
    }

    pub fn interval(self) -> Option<[f64; 2]> {
        let bounds = clopper_pearson(self.detected, self.valid, ONE_SIDED_CONFIDENCE)?;
        Some(bounds.map(|bound| bound * 100.0))
    }

    pub fn is_narrower_than(self, width: f64) -> bool {
        self.interval().is_some_and(|[low, high]| high - low <= width)
    }
}

impl MutationReport {
    pub fn score(&self) -> Score {
        self.score_if(|_| true)
    }

    pub fn score_of_executed(&self) -> Score {
        self.score_if(|result| result.status != MutantStatus::NoCoverage)
    }

    /// Number of survivors, and of those with the commands of the unchanged firmware.
    pub fn survivors(&self) -> [usize; 2] {
        let same = self.results.iter().filter_map(|result| match result.status {
            MutantStatus::Survived { same_commands, .. } => Some(same_commands),
            _ => None,
        });
        same.fold([0, 0], |[all, unchanged], same| [all + 1, unchanged + usize::from(same)])
    }

    pub fn score_of_control_step(&self) -> Score {
        self.score_if(|result| result.mutant.in_control_step)
    }

    /// Like `score_of_control_step`, without survivors that change no drive and no frequency.
    pub fn score_of_changed_control_step(&self) -> Score {
        let is_same = |status: &MutantStatus| matches!(status, MutantStatus::Survived { same_commands: true, .. });
        self.score_if(|result| result.mutant.in_control_step && !is_same(&result.status))
    }

    fn score_if(&self, is_counted: impl Fn(&CodeMutantResult) -> bool) -> Score {
        Score::of(self.results.iter().filter(|result| is_counted(result)).map(|result| &result.status))
    }
}

/// Largest source file in the report. The image names the files, so they may be anything.
const MAX_SOURCE_BYTES: u64 = 16 << 20;

/// Thresholds of the score in percent. Viewers use them only to choose colours.
const HIGH: u8 = 90;
const LOW: u8 = 70;

pub fn mutation_json(report: &MutationReport) -> Value {
    let mut files: BTreeMap<String, Vec<Value>> = BTreeMap::new();
    let ids: BTreeMap<&str, usize> = report.scenarios.iter().map(String::as_str).zip(0..).collect();
    for (number, result) in report.results.iter().enumerate() {
        let file = result.mutant.line.as_ref().map_or("machine code without lines", |line| &line.file);
        files.entry(file.to_owned()).or_default().push(mutant_json(number, result, &ids));
    }
    let tests: Vec<Value> =
        ids.iter().map(|(name, number)| json!({ "id": number.to_string(), "name": name })).collect();
    let files: Map<String, Value> = files
        .into_iter()
        .map(|(file, mutants)| {
            let (language, source) = (language(&file), source(&file, &mutants));
            (file, json!({ "language": language, "source": source, "mutants": mutants }))
        })
        .collect();
    json!({
        "$schema": "https://git.io/mutation-testing-schema",
        "schemaVersion": "2",
        "thresholds": { "high": HIGH, "low": LOW },
        "framework": { "name": "platebench", "version": env!("CARGO_PKG_VERSION") },
        "files": files,
        "testFiles": { "scenarios": { "tests": tests } },
    })
}

fn mutant_json(number: usize, result: &CodeMutantResult, ids: &BTreeMap<&str, usize>) -> Value {
    let mutant = &result.mutant;
    let line = mutant.line.as_ref().map_or(1, |line| line.line.max(1));
    let id = |name: &String| ids.get(name.as_str()).map(ToString::to_string);
    let mut value = json!({
        "id": number.to_string(),
        "mutatorName": mutant.operator.name(),
        "description":
            format!("{:#010x} in {}: {} -> {}", mutant.instruction, mutant.function, mutant.before, mutant.after),
        "replacement": mutant.after,
        "location": { "start": { "line": line, "column": 1 }, "end": { "line": line, "column": 2 } },
        "status": result.status.name(),
        "coveredBy": result.covered_by.iter().filter_map(id).collect::<Vec<_>>(),
        "duration": result.duration.as_millis() as u64,
    });
    let (by, reason) = match &result.status {
        MutantStatus::Killed { by, reason } | MutantStatus::RuntimeError { by, reason } => {
            (Some(by), Some(reason.clone()))
        }
        MutantStatus::Timeout { by } => (Some(by), None),
        MutantStatus::Survived { same_commands: true, .. } => {
            (None, Some("no drive and no frequency changed".to_owned()))
        }
        MutantStatus::Survived { closest: Some(closest), .. } => {
            let text = format!("closest margin {:.4}: {} {}", closest.margin, closest.scenario, closest.expectation);
            (None, Some(text))
        }
        MutantStatus::Survived { closest: None, .. } | MutantStatus::NoCoverage => (None, None),
    };
    if let Some(by) = by.and_then(id).filter(|_| result.status.is_detected()) {
        value["killedBy"] = json!([by]);
    }
    if let Some(reason) = reason {
        value["statusReason"] = json!(reason);
    }
    value
}

fn language(file: &str) -> &'static str {
    match file.rsplit_once('.').map(|(_, extension)| extension) {
        Some("rs") => "rust",
        Some("c" | "h") => "c",
        Some("cpp" | "cc" | "hpp") => "cpp",
        _ => "armasm",
    }
}

/// Returns empty lines if the file cannot be read here, because viewers place mutants on lines.
fn source(file: &str, mutants: &[Value]) -> String {
    read_text_file(Path::new(file), MAX_SOURCE_BYTES).unwrap_or_else(|_| {
        let lines: BTreeSet<u64> =
            mutants.iter().filter_map(|mutant| mutant["location"]["start"]["line"].as_u64()).collect();
        "\n".repeat(lines.last().copied().unwrap_or(1) as usize)
    })
}

pub fn document(report: &MutationReport) -> Document {
    let mut table = Table::new([
        Column::from("operator"),
        Column::number("detected", ""),
        Column::number("survived", ""),
        Column::number("not run", ""),
        Column::number("score", "%"),
    ]);
    table.extend(MutationOperator::ALL.iter().map(|&operator| {
        let of_operator = || report.results.iter().filter(move |result| result.mutant.operator == operator);
        let statuses = || of_operator().map(|result| &result.status);
        let count =
            |is_counted: fn(&MutantStatus) -> bool| statuses().filter(|status| is_counted(status)).count().to_string();
        let score = Score::of(statuses());
        let survived = count(|status| matches!(status, MutantStatus::Survived { .. }));
        let not_run = count(|status| *status == MutantStatus::NoCoverage);
        let percent = format!("{:.1}", score.percent());
        [operator.name().to_owned(), score.detected.to_string(), survived, not_run, percent]
    }));
    let survivors = report.results.iter().filter(|result| matches!(result.status, MutantStatus::Survived { .. }));
    let failures = report.results.iter().filter_map(|CodeMutantResult { mutant, status, .. }| match status {
        MutantStatus::RuntimeError { reason, .. } => {
            Some(format!("emulator failed: {:#010x} {}: {reason}", mutant.instruction, mutant.after))
        }
        _ => None,
    });
    let survivors: Vec<_> = survivors.map(|result| Block::lines(survivor_lines(result))).collect();
    let [survived, unchanged] = report.survivors();
    let totals = [
        format!("{} of {} mutants", report.results.len(), report.population),
        format!("{survived} survived, {unchanged} of them without a change of any drive or frequency"),
        format!("mutation score: {}", format_score(report.score())),
        format!("of executed mutants: {}", format_score(report.score_of_executed())),
        format!("of mutants in the control step: {}", format_score(report.score_of_control_step())),
        format!(
            "of these, without survivors that change no drive and no frequency: {}",
            format_score(report.score_of_changed_control_step())
        ),
    ];
    let failures: Vec<_> = failures.map(Block::Paragraph).collect();
    let blocks = [vec![Block::Table(table)], survivors, failures, vec![Block::lines(totals)]];
    Document::new("Mutants of the machine code", blocks.concat())
}

fn survivor_lines(CodeMutantResult { mutant, status, covered_by, .. }: &CodeMutantResult) -> [String; 3] {
    let line = mutant.line.as_ref().map_or_else(|| "no line".to_owned(), |line| format!("{}:{}", line.file, line.line));
    let place = if mutant.in_control_step { ", control step" } else { "" };
    let scenarios = format!("    {} scenarios", covered_by.len());
    [
        format!("survived: {:#010x} {line} in {}{place}", mutant.instruction, mutant.function),
        format!("    {}: {} -> {}", mutant.operator, mutant.before, mutant.after),
        match status {
            MutantStatus::Survived { same_commands: true, .. } => {
                format!("{scenarios}; no drive and no frequency changed")
            }
            MutantStatus::Survived { closest: Some(ExpectationMargin { scenario, expectation, margin }), .. } => {
                format!("{scenarios}; closest margin {margin:.3}: {scenario} {expectation}")
            }
            _ => scenarios,
        },
    ]
}

fn format_score(score: Score) -> String {
    let interval = score.interval().map_or_else(String::new, |[low, high]| format!(" (95 %: {low:.1} to {high:.1} %)"));
    format!("{} of {}, {:.1} %{interval}", score.detected, score.valid, score.percent())
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_rig::RigSpec;
    use platebench_test_kit::load_scenario;

    /// After a mutant without an end, the runner connects again to restore the firmware.
    #[test]
    fn a_time_limit_does_not_cancel_the_next_connection() {
        let mut scenario = load_scenario("paper/fig13-closed-loop.toml");
        (scenario.trials.count, scenario.trials.max_count) = (100_000, 100_000);
        let suite = FirmwareSuite::new(&"emulated".parse::<RigSpec>().unwrap(), vec![scenario]).unwrap();
        let (connect, cancel, ends) = (|| suite.connect(), CancelToken::never(), SafeEnds::default());
        let mut executor = new_executor(&connect, &cancel, &ends);
        let (scenario, law) = &suite.scenarios[0];
        let played = play_within(Duration::ZERO, &cancel, &mut executor, scenario, *law).unwrap();
        assert!(played.is_none(), "the limit did not end the scenario");
        assert!(executor.session().is_ok());
    }
}
