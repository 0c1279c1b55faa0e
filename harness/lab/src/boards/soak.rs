//! Plays scenarios in rotation for hours (soak test). Each round has new seeds, and the record has
//! a bounded size.

use crate::boards::state::BoardOutcome;
use platebench_document::{Block, Document, Table};
use platebench_engine::plan::LinkFactory;
use platebench_engine::{CancelToken, RigSession, RunError, RunHooks, RunPlan, rejudge, run};
use platebench_model::record::{
    FileLock, FolderError, RigRecord, RunFolder, RunRecord, Verdict, combine_runs, utc_timestamp,
};
use platebench_model::scenario::Scenario;
use platebench_model::trace::{
    AtPath as _, FileError, OutputFolder, missing_folders, read_text_file, remove_empty_folders,
};
use platebench_report::console;
use platebench_rig::SafeEnd;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io;
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

const RUNS: &str = "runs";
const MAX_KEPT_FAILURES: usize = 20;

pub struct SoakConfig {
    pub plan: RunPlan,
    pub board: String,
    pub duration: Duration,
    pub fail_fast: bool,
}

#[derive(Debug)]
pub struct SoakResult {
    pub record: SoakRecord,
    pub board: BoardOutcome,
    pub error: Option<RunError>,
}

/// Writes `soak.json` after each run. Keeps the newest run and the first 20 runs that did not pass.
/// All runs share one session, so that a controller keeps its history from one run to the next.
pub fn soak(
    config: &SoakConfig,
    out: &Path,
    connect: &LinkFactory<'_>,
    cancel: &CancelToken,
) -> Result<SoakResult, RunError> {
    let created = missing_folders(out);
    let output = OutputFolder::create(out).map_err(FolderError::from)?;
    let lock = FileLock::exclusive(out).map_err(FolderError::from)?;
    let _lock = lock.ok_or_else(|| FolderError::InUse(out.to_owned()))?;
    if out.join(SOAK_FILE).exists() {
        return Err(FolderError::AlreadyUsed(out.to_owned()).into());
    }
    let mut result = SoakResult {
        record: SoakRecord::new(&config.board, &config.plan.rig),
        board: BoardOutcome::untouched(),
        error: None,
    };
    write(&result.record, &output)?;
    if config.plan.scenarios.is_empty() {
        return Ok(result);
    }
    let session = Mutex::new(None);
    let played = play_rounds(config, &output, connect, cancel, &session, &mut result);
    if played.is_err() && result.record.runs == 0 && output.remove_empty_folder(RUNS).is_ok() {
        // The board was not reached, so the same soak can start again.
        let _ = output.remove_file(SOAK_FILE);
        remove_empty_folders(&created);
    }
    played?;
    let last = session.into_inner().unwrap_or_else(PoisonError::into_inner);
    if last.is_some_and(|session| session.close() != SafeEnd::Confirmed) {
        result.board = BoardOutcome { last_run: result.board.last_run, ..BoardOutcome::unconfirmed() };
        result.record.safe_confirmed = false;
        result.record.set_end(SoakEnd::Unsafe);
        write(&result.record, &output)?;
    }
    Ok(result)
}

fn play_rounds(
    config: &SoakConfig,
    output: &OutputFolder,
    connect: &LinkFactory<'_>,
    cancel: &CancelToken,
    session: &Mutex<Option<RigSession>>,
    result: &mut SoakResult,
) -> Result<(), RunError> {
    let SoakResult { record, board, error: last_error } = result;
    let started = Instant::now();
    let mut disposable: Option<String> = None;
    for (round, scenario) in (0..).flat_map(|round| config.plan.scenarios.iter().map(move |scenario| (round, scenario)))
    {
        let plan = plan_of(&config.plan, scenario, round);
        let name = format!("{RUNS}/{:08}", record.runs);
        // Fails if a link is in the place of the folder.
        let place = output.create_folder(&name).map_err(FolderError::from)?;
        let folder = RunFolder::create(Some(place.path()))?;
        let hooks = RunHooks { cancel: cancel.clone(), kept_session: Some(session), ..RunHooks::default() };
        let played = run(&plan, &folder, connect, hooks);
        *board = BoardOutcome::of_run(played.as_ref(), folder.path());
        let played = played.and_then(|run| record.check_controller(&run.rig).map(|()| run));
        let run = match played {
            Ok(run) => run,
            Err(error) if record.runs == 0 && !cancel.is_cancelled() && folder.remove_if_empty() => return Err(error),
            Err(error) => {
                record.set_end(if cancel.is_cancelled() { SoakEnd::Cancelled } else { SoakEnd::Lost });
                write(record, output)?;
                *last_error = (!cancel.is_cancelled()).then_some(error);
                return Ok(());
            }
        };
        record.add(&run, &name);
        if let Some(old) = disposable.take() {
            output.remove_folder(&old).map_err(FolderError::from)?;
        }
        if run.verdict == Verdict::Pass || record.kept.len() >= MAX_KEPT_FAILURES {
            disposable = Some(name);
        } else {
            record.kept.push(name);
        }
        if let Some(end) = end_after(config, &run, board, started, cancel) {
            record.set_end(end);
        }
        write(record, output)?;
        if record.end.is_some() {
            break;
        }
    }
    Ok(())
}

fn end_after(
    config: &SoakConfig,
    run: &RunRecord,
    board: &BoardOutcome,
    started: Instant,
    cancel: &CancelToken,
) -> Option<SoakEnd> {
    if board.quarantine.is_some() {
        Some(if run.has_lost_controller() { SoakEnd::Lost } else { SoakEnd::Unsafe })
    } else if config.fail_fast && run.verdict == Verdict::Fail {
        Some(SoakEnd::Failed)
    } else if cancel.is_cancelled() {
        Some(SoakEnd::Cancelled)
    } else {
        (started.elapsed() >= config.duration).then_some(SoakEnd::Time)
    }
}

/// Makes a plan of one scenario. Its seeds follow the seeds of the round before.
fn plan_of(plan: &RunPlan, scenario: &Scenario, round: u64) -> RunPlan {
    let trials = u64::from(scenario.trials.max_count.max(scenario.trials.count));
    let seed = scenario.trials.seed.wrapping_add(round.wrapping_mul(trials));
    let mut overrides = plan.overrides.clone();
    overrides.seed = Some(seed);
    let mut scenario = scenario.clone();
    rejudge::apply_overrides(&overrides, &mut scenario);
    RunPlan { scenarios: vec![scenario], overrides, ..plan.clone() }
}

fn write(record: &SoakRecord, output: &OutputFolder) -> Result<(), RunError> {
    Ok(record.write(output).map_err(FolderError::from)?)
}

pub const SOAK_FILE: &str = "soak.json";
const FORMAT: u32 = 1;
const MAX_BYTES: u64 = 1 << 26;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SoakRecord {
    format: u32,
    pub board: String,
    pub rig: String,
    pub started: String,
    pub updated: String,
    /// The most severe verdict of all runs. A pass only after the whole time: while the soak test
    /// runs, and after it was killed, it is inconclusive instead.
    pub verdict: Verdict,
    #[serde(skip)]
    worst: Option<Verdict>,
    /// The controller of all runs; absent before the end of the first run and in records of 0.3.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub controller: Option<RigRecord>,
    /// Absent while the soak test runs, and after it was killed.
    pub end: Option<SoakEnd>,
    pub runs: u64,
    pub safe_confirmed: bool,
    pub scenarios: BTreeMap<String, SoakScenario>,
    pub newest: Option<String>,
    /// Folders of the first runs that did not pass.
    pub kept: Vec<String>,
    /// Folder and reason of the first run that did not pass.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SoakEnd {
    Time,
    Cancelled,
    Failed,
    Lost,
    /// The controller did not confirm 0 V or did not keep it.
    Unsafe,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct SoakScenario {
    pub runs: u64,
    pub trials: u64,
    pub failed: u64,
    pub inconclusive: u64,
    pub metrics: BTreeMap<String, RunningStatistics>,
}

/// Mean and variance by Welford's method (*Technometrics* 4, 1962, pp. 419-420).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunningStatistics {
    pub count: u64,
    pub mean: f64,
    /// Sum of the squared distances from the mean.
    pub squares: f64,
    pub minimum: f64,
    pub maximum: f64,
}

impl RunningStatistics {
    fn of(value: f64) -> Self {
        Self { count: 1, mean: value, squares: 0.0, minimum: value, maximum: value }
    }

    fn add(&mut self, value: f64) {
        self.count += 1;
        let before = value - self.mean;
        self.mean += before / self.count as f64;
        self.squares += before * (value - self.mean);
        (self.minimum, self.maximum) = (self.minimum.min(value), self.maximum.max(value));
    }

    /// Standard deviation with n − 1 in the denominator, or 0 for one value.
    fn deviation(&self) -> f64 {
        if self.count > 1 { (self.squares / (self.count - 1) as f64).sqrt() } else { 0.0 }
    }
}

impl SoakRecord {
    pub(crate) fn new(board: &str, rig: &str) -> Self {
        Self {
            format: FORMAT,
            board: board.to_owned(),
            rig: rig.to_owned(),
            started: utc_timestamp(),
            updated: utc_timestamp(),
            verdict: Verdict::Inconclusive,
            worst: None,
            controller: None,
            end: None,
            runs: 0,
            safe_confirmed: true,
            scenarios: BTreeMap::new(),
            newest: None,
            kept: Vec::new(),
            reason: None,
        }
    }

    pub fn read(folder: &Path) -> io::Result<Self> {
        let mut record: Self = serde_json::from_str(&read_text_file(&folder.join(SOAK_FILE), MAX_BYTES)?)?;
        // 0.3 wrote a pass before the end.
        record.worst = (record.runs > 0).then_some(record.verdict);
        record.update_verdict();
        Ok(record)
    }

    fn update_verdict(&mut self) {
        self.verdict = combine_runs(self.worst, self.end == Some(SoakEnd::Time));
    }

    fn set_end(&mut self, end: SoakEnd) {
        self.end = Some(end);
        self.update_verdict();
    }

    /// Fails if another controller answers than in the runs before.
    fn check_controller(&mut self, rig: &RigRecord) -> Result<(), RunError> {
        let first: &RigRecord = self.controller.get_or_insert_with(|| rig.clone());
        if first.has_same_controller(rig) {
            return Ok(());
        }
        let [found, expected] = [rig, first].map(RigRecord::describe_controller);
        Err(RunError::DifferentController { found, expected })
    }

    pub(crate) fn write(&self, folder: &OutputFolder) -> Result<(), FileError> {
        let text = serde_json::to_string_pretty(self).map_err(io::Error::from).at(&folder.path().join(SOAK_FILE))?;
        folder.write(SOAK_FILE, format!("{text}\n"))
    }

    pub(crate) fn add(&mut self, run: &RunRecord, folder: &str) {
        self.worst = Some(Verdict::combine(self.worst.into_iter().chain([run.verdict])));
        if run.verdict != Verdict::Pass && self.reason.is_none() {
            self.reason = Some(format!("{folder}: {}", console::verdict_reason(run)));
        }
        self.update_verdict();
        self.runs += 1;
        self.updated = utc_timestamp();
        self.safe_confirmed &= run.safe_confirmed == Some(true);
        self.newest = Some(folder.to_owned());
        for played in &run.scenarios {
            let scenario = self.scenarios.entry(played.file.clone()).or_default();
            scenario.runs += 1;
            scenario.trials += played.trials.len() as u64;
            scenario.failed += u64::from(played.verdict == Verdict::Fail);
            scenario.inconclusive += u64::from(played.verdict == Verdict::Inconclusive);
            let counted = played.trials.iter().filter(|trial| trial.cause.is_none());
            for (metric, value) in counted.flat_map(|trial| trial.metrics.iter()) {
                let Some(value) = value else { continue };
                let known = scenario.metrics.entry(metric.to_owned());
                known.and_modify(|known| known.add(value)).or_insert_with(|| RunningStatistics::of(value));
            }
        }
    }

    pub fn document(&self) -> Document {
        let lead = format!(
            "{} runs on {}, {}, from {} to {}: {}. 0 V {} after each run.",
            self.runs,
            self.board,
            self.verdict,
            self.started,
            self.updated,
            self.describe_end(),
            if self.safe_confirmed { "was confirmed" } else { "was not confirmed" },
        );
        let kept = self.kept.iter().chain(&self.newest).map(|run| Block::File(format!("{run}/run.json")));
        let reason =
            self.reason.iter().map(|reason| Block::paragraph(format!("First run that did not pass: {reason}.")));
        let blocks = reason.chain([Block::Table(self.table())]).chain(kept).collect();
        Document { lead, ..Document::new(format!("Soak of {}", self.board), blocks) }
    }

    pub fn describe_end(&self) -> &'static str {
        self.end.map_or("not ended", |end| match end {
            SoakEnd::Time => "ended after its time",
            SoakEnd::Cancelled => "cancelled",
            SoakEnd::Failed => "ended at the first failure",
            SoakEnd::Lost => "ended because the board was lost",
            SoakEnd::Unsafe => "ended because the controller did not confirm 0 V or did not keep it",
        })
    }

    fn table(&self) -> Table {
        let header = ["scenario", "runs", "trials", "failed", "inconclusive", "metric", "mean", "sd", "min", "max"];
        let mut table = Table::new(header);
        for (file, scenario) in &self.scenarios {
            let counts = [scenario.runs, scenario.trials, scenario.failed, scenario.inconclusive];
            let counts: Vec<_> = counts.iter().map(ToString::to_string).collect();
            for (metric, known) in &scenario.metrics {
                let numbers = [known.mean, known.deviation(), known.minimum, known.maximum];
                let numbers = numbers.map(|number| format!("{number:.4}"));
                let start = std::iter::once(file.clone()).chain(counts.clone());
                table.push(start.chain(std::iter::once(metric.clone())).chain(numbers));
            }
        }
        table
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn running_statistics_are_those_of_all_values() {
        let mut known = RunningStatistics::of(1.0);
        for value in [2.0, 3.0, 4.0] {
            known.add(value);
        }
        assert_eq!((known.count, known.mean, known.minimum, known.maximum), (4, 2.5, 1.0, 4.0));
        assert!((known.deviation() - (5.0_f64 / 3.0).sqrt()).abs() < 1e-15);
    }
}
