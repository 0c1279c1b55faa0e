//! Analyses the firmware on the emulated rig: which machine code the scenarios execute, by source
//! line and function. See `docs/coverage.md`.

pub mod code_map;
pub mod error;
mod line_tables;
pub mod suite;

use line_tables::check_line_tables;
use platebench_document::{Block, Column, Document, Table};
use platebench_engine::workers::in_parallel;
use platebench_engine::{RunError, SafeEnds};
use platebench_model::record::Verdict;
use platebench_model::scenario::Scenario;
use platebench_rig::{CancelToken, Symbols};
use platebench_wire::LawId;
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::fmt::{self, Write};
use std::time::{Duration, Instant};
use suite::{BoardExecutor, SuiteOutcome, new_executor, play};

pub use code_map::CodeMap;
pub use error::FirmwareAnalysisError;
pub use suite::FirmwareSuite;

#[derive(Debug)]
pub struct CoverageConfig {
    pub suite: FirmwareSuite,
    pub jobs: usize,
    /// Parts of paths of source files. If empty, all of the firmware's own files are selected.
    pub only: Vec<String>,
    pub cancel: CancelToken,
}

#[derive(Debug, Default, PartialEq, Eq)]
pub struct CodeCoverage {
    pub files: BTreeMap<String, FileCoverage>,
    /// Instructions of all functions in flash, including those without debug information.
    pub instructions: Ratio,
}

#[derive(Debug, Default, PartialEq, Eq)]
pub struct FileCoverage {
    pub lines: BTreeMap<u32, LineCoverage>,
    pub functions: BTreeMap<String, FunctionCoverage>,
}

#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub struct LineCoverage {
    pub executed: bool,
    /// True if a function that ran in a control step contains the line.
    pub on_control_path: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FunctionCoverage {
    /// First line with code.
    pub line: u32,
    pub executed: bool,
    /// True if one of its instructions ran while the firmware answered a sample.
    pub in_control_step: bool,
}

#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub struct Ratio {
    pub executed: usize,
    pub total: usize,
}

impl Ratio {
    pub fn percent(self) -> f64 {
        if self.total == 0 { 100.0 } else { self.executed as f64 / self.total as f64 * 100.0 }
    }
}

impl FromIterator<bool> for Ratio {
    fn from_iter<I: IntoIterator<Item = bool>>(executed: I) -> Self {
        executed.into_iter().fold(Self::default(), |ratio, executed| Self {
            executed: ratio.executed + usize::from(executed),
            total: ratio.total + 1,
        })
    }
}

impl FileCoverage {
    pub fn line_ratio(&self) -> Ratio {
        self.lines.values().map(|line| line.executed).collect()
    }

    pub fn function_ratio(&self) -> Ratio {
        self.functions.values().map(|function| function.executed).collect()
    }
}

impl CodeCoverage {
    pub fn line_ratio(&self) -> Ratio {
        self.files.values().flat_map(|file| file.lines.values()).map(|line| line.executed).collect()
    }

    /// `executed` maps the first instruction of each basic block that ran to whether it ran in a
    /// control step.
    fn new(map: &CodeMap, symbols: &Symbols, executed: &BTreeMap<u32, bool>, only: &[String]) -> Self {
        let mut coverage = Self::default();
        let mut places = Vec::new();
        for &address in map.instructions.keys() {
            let state = executed.get(&map.leader_of(address)).copied();
            coverage.instructions.total += 1;
            coverage.instructions.executed += usize::from(state.is_some());
            for frame in symbols.frames(address) {
                let Some(line) = frame.line else { continue };
                let file = coverage.files.entry(line.file.clone()).or_default();
                let function = file.functions.entry(frame.function.clone()).or_insert(FunctionCoverage {
                    line: line.line,
                    executed: false,
                    in_control_step: false,
                });
                function.line = function.line.min(line.line);
                function.executed |= state.is_some();
                function.in_control_step |= state == Some(true);
                places.push((line, frame.function, state.is_some()));
            }
        }
        for (place, function, executed) in places {
            let Some(file) = coverage.files.get_mut(&place.file) else { continue };
            let in_step = file.functions.get(&function).is_some_and(|function| function.in_control_step);
            let line = file.lines.entry(place.line).or_default();
            line.executed |= executed;
            line.on_control_path |= in_step;
        }
        coverage.select(only);
        coverage
    }

    fn select(&mut self, only: &[String]) {
        if !only.is_empty() {
            return self.files.retain(|file, _| only.iter().any(|part| file.contains(part)));
        }
        self.files.retain(|file, _| !is_standard_library(file) && !is_package(file));
    }
}

/// Folders of Rust's standard library, of newlib, picolibc and libgcc.
const STANDARD_LIBRARIES: [&str; 9] = [
    "/rustc/",
    "library/core/",
    "library/alloc/",
    "library/compiler-builtins/",
    "/newlib/libc/",
    "/newlib/libm/",
    "/libgloss/",
    "/picolibc",
    "/libgcc/",
];

pub(crate) fn is_standard_library(file: &str) -> bool {
    STANDARD_LIBRARIES.iter().any(|part| file.contains(part))
}

/// True for a file of a package that Cargo downloaded: a folder of its path has a name and a version.
fn is_package(file: &str) -> bool {
    let is_versioned = |folder: &str| {
        let version = folder.rsplit_once('-').map(|(_, version)| version.split('.').collect::<Vec<_>>());
        version.is_some_and(|parts| parts.len() == 3 && parts.iter().all(|part| part.parse::<u32>().is_ok()))
    };
    file.contains("/.cargo/") || file.split('/').rev().skip(1).any(is_versioned)
}

pub fn measure_coverage(config: &CoverageConfig) -> Result<CodeCoverage, FirmwareAnalysisError> {
    let (symbols, map) = config.suite.code()?;
    check_line_tables(&map, &symbols, !config.only.is_empty())?;
    let baselines = play_baselines(&config.suite, &map, config.jobs, &config.cancel)?;
    let coverage = CodeCoverage::new(&map, &symbols, &executed_by_all(&baselines), &config.only);
    match config.only.iter().find(|_| coverage.files.is_empty()) {
        Some(only) => Err(FirmwareAnalysisError::NoMatch(only.clone())),
        None => Ok(coverage),
    }
}

/// Result of a scenario with the unchanged firmware.
pub(crate) struct ReferencePlay {
    /// Executed blocks, as in [`platebench_rig::EmulatedLink::executed_instructions`].
    pub(crate) executed: BTreeMap<u32, bool>,
    pub(crate) duration: Duration,
    pub(crate) commands: u64,
    /// True if the scenario fails as expected without a mutant. It then cannot detect a mutant.
    pub(crate) fails: bool,
}

pub(crate) fn play_baselines(
    suite: &FirmwareSuite,
    map: &CodeMap,
    jobs: usize,
    cancel: &CancelToken,
) -> Result<Vec<ReferencePlay>, FirmwareAnalysisError> {
    // The longest scenarios come first, so that no worker ends long after the others.
    let mut order: Vec<(usize, &(Scenario, LawId))> = suite.scenarios.iter().enumerate().collect();
    order.sort_by_key(|(_, (scenario, _))| Reverse(scenario.duration.as_nanos() * u64::from(scenario.trials.count)));
    let (connect, ends) = (|| suite.connect(), SafeEnds::default());
    let executors = (0..jobs.max(1)).map(|_| new_executor(&connect, cancel, &ends));
    let work = |executor: &mut BoardExecutor<'_>, (number, (scenario, law)): &(usize, &(Scenario, LawId))| {
        executor.session()?.link_mut().inner_mut().record_execution(&map.leaders);
        let start = Instant::now();
        let outcome = play(executor, scenario, *law)?.ok_or(RunError::Cancelled)?;
        check_baseline(scenario, &outcome)?;
        let executed = executor.session()?.link_mut().inner_mut().executed_instructions().clone();
        let (commands, fails) = (outcome.commands, outcome.detection.is_some());
        Ok::<_, FirmwareAnalysisError>((
            *number,
            ReferencePlay { executed, duration: start.elapsed(), commands, fails },
        ))
    };
    let mut baselines = BTreeMap::new();
    in_parallel(executors, &order, work, |(number, baseline)| {
        baselines.insert(number, baseline);
        true
    })?;
    Ok(baselines.into_values().collect())
}

pub(crate) fn executed_by_all(baselines: &[ReferencePlay]) -> BTreeMap<u32, bool> {
    let mut executed = BTreeMap::new();
    for (&address, &in_step) in baselines.iter().flat_map(|baseline| &baseline.executed) {
        *executed.entry(address).or_default() |= in_step;
    }
    executed
}

fn check_baseline(scenario: &Scenario, outcome: &SuiteOutcome) -> Result<(), FirmwareAnalysisError> {
    match &outcome.detection {
        Some(detection) if detection.is_unconfirmed => Err(FirmwareAnalysisError::NotSafe),
        Some(detection) if outcome.verdict == Verdict::Fail && scenario.expected_exit.is_none_or(|exit| exit == 0) => {
            Err(FirmwareAnalysisError::FailingScenario {
                file: scenario.file.clone(),
                reason: detection.reason.clone(),
            })
        }
        _ => Ok(()),
    }
}

pub fn document(coverage: &CodeCoverage) -> Document {
    let count = |ratio: Ratio| format!("{}/{}", ratio.executed, ratio.total);
    let columns = [Column::number("lines", "%"), Column::number("lines", ""), Column::number("functions", "")];
    let mut table = Table::new(columns.into_iter().chain(["file".into()]));
    table.extend(coverage.files.iter().map(|(path, file)| {
        let lines = file.line_ratio();
        [format!("{:.1}", lines.percent()), count(lines), count(file.function_ratio()), path.clone()]
    }));
    let missing = coverage.files.iter().filter_map(|(path, file)| {
        let missing = file.lines.iter().filter(|(_, line)| line.on_control_path && !line.executed);
        let missing: Vec<u32> = missing.map(|(&line, _)| line).collect();
        (!missing.is_empty()).then(|| format!("  {path}: {}", ranges(&missing)))
    });
    let mut missing: Vec<String> = missing.collect();
    if missing.is_empty() {
        missing.push("  none".to_owned());
    }
    let (lines, instructions) = (coverage.line_ratio(), coverage.instructions);
    let total = |ratio: Ratio| format!("{} of {}, {:.1} %", ratio.executed, ratio.total, ratio.percent());
    let totals = format!("lines: {}; instructions of the image: {}", total(lines), total(instructions));
    Document::new(
        "Executed lines of the firmware",
        vec![
            Block::Table(table),
            Block::heading("Lines of the control path that never ran:"),
            Block::lines(missing),
            Block::paragraph(totals),
        ],
    )
}

/// Formats line numbers as `3, 7-9`.
fn ranges(lines: &[u32]) -> String {
    let mut ranges: Vec<(u32, u32)> = Vec::new();
    for &line in lines {
        match ranges.last_mut() {
            Some((_, last)) if *last + 1 == line => *last = line,
            _ => ranges.push((line, line)),
        }
    }
    let range = |(first, last)| if first == last { format!("{first}") } else { format!("{first}-{last}") };
    ranges.into_iter().map(range).collect::<Vec<_>>().join(", ")
}

pub fn lcov_tracefile(coverage: &CodeCoverage) -> String {
    let mut text = String::new();
    let _ = write_tracefile(&mut text, coverage);
    text
}

fn write_tracefile(text: &mut String, coverage: &CodeCoverage) -> fmt::Result {
    for (path, file) in &coverage.files {
        writeln!(text, "TN:\nSF:{path}")?;
        for (name, function) in &file.functions {
            writeln!(text, "FN:{},{name}", function.line)?;
        }
        for (name, function) in &file.functions {
            writeln!(text, "FNDA:{},{name}", u8::from(function.executed))?;
        }
        let functions = file.function_ratio();
        writeln!(text, "FNF:{}\nFNH:{}", functions.total, functions.executed)?;
        for (line, state) in &file.lines {
            writeln!(text, "DA:{line},{}", u8::from(state.executed))?;
        }
        let lines = file.line_ratio();
        writeln!(text, "LF:{}\nLH:{}\nend_of_record", lines.total, lines.executed)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::firmware_analysis::suite::hash_commands;
    use platebench_engine::{Clock, RunHooks, RunPlan, run};
    use platebench_model::record::{Overrides, RunFolder};
    use platebench_model::trace::read_trace;
    use platebench_rig::RigSpec;
    use platebench_test_kit::load_scenario;
    use std::hash::{DefaultHasher, Hasher};

    /// Coverage and mutation both start with the baselines.
    #[test]
    fn baselines_have_the_commands_of_run() {
        let mut scenario = load_scenario("paper/fig13-closed-loop.toml");
        (scenario.trials.count, scenario.trials.max_count) = (2, 2);
        let rig: RigSpec = "emulated".parse().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let folder = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
        let clock = Clock::Lockstep { wire_time: false };
        let plan = RunPlan::new(&rig, clock, 1, vec![scenario.clone()], Overrides::default());
        let record = run(&plan, &folder, &|| rig.connect(), RunHooks::default()).unwrap();
        let mut commands = DefaultHasher::new();
        for trial in &record.scenarios[0].trials {
            hash_commands(&read_trace(&folder.path().join(&trial.trace)).unwrap(), &mut commands);
        }
        let suite = FirmwareSuite::new(&rig, vec![scenario]).unwrap();
        let (_, map) = suite.code().unwrap();
        let baselines = play_baselines(&suite, &map, 1, &CancelToken::never()).unwrap();
        assert_eq!(record.scenarios[0].trials.len(), 2);
        assert_eq!(baselines.iter().map(|baseline| baseline.commands).collect::<Vec<_>>(), [commands.finish()]);
    }

    #[test]
    fn joins_successive_lines() {
        assert_eq!(ranges(&[3, 7, 8, 9, 11]), "3, 7-9, 11");
        assert_eq!(ranges(&[]), "");
    }
}
