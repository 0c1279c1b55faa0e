//! Plays scenarios in rotation for hours (soak test). Each round has new seeds, and the record has
//! a bounded size.

use crate::boards::run_end::BoardOutcome;
use crate::boards::soak_record::{SOAK_FILE, SoakEnd, SoakRecord};
use platebench_engine::plan::LinkFactory;
use platebench_engine::{CancelToken, RunError, RunHooks, RunPlan, rejudge, run};
use platebench_model::record::{FileLock, FolderError, RunFolder, RunRecord, Verdict};
use platebench_model::scenario::Scenario;
use platebench_model::trace::AtPath as _;
use std::fs;
use std::path::{Path, PathBuf};
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
pub fn soak(
    config: &SoakConfig,
    out: &Path,
    connect: &LinkFactory<'_>,
    cancel: &CancelToken,
) -> Result<SoakResult, RunError> {
    fs::create_dir_all(out).at(out).map_err(FolderError::from)?;
    let lock = FileLock::exclusive(out).map_err(FolderError::from)?;
    let _lock = lock.ok_or_else(|| FolderError::InUse(out.to_owned()))?;
    if out.join(SOAK_FILE).exists() {
        return Err(FolderError::AlreadyUsed(out.to_owned()).into());
    }
    let (started, mut record) = (Instant::now(), SoakRecord::new(&config.board, &config.plan.rig));
    write(&record, out)?;
    let mut board = BoardOutcome::untouched();
    if config.plan.scenarios.is_empty() {
        return Ok(SoakResult { record, board: BoardOutcome::untouched(), error: None });
    }
    let mut disposable: Option<PathBuf> = None;
    for (round, scenario) in (0..).flat_map(|round| config.plan.scenarios.iter().map(move |scenario| (round, scenario)))
    {
        let plan = plan_of(&config.plan, scenario, round);
        let name = format!("{RUNS}/{:08}", record.runs);
        let folder = RunFolder::create(Some(&out.join(&name)))?;
        let hooks = RunHooks { cancel: cancel.clone(), ..RunHooks::default() };
        let played = run(&plan, &folder, connect, hooks);
        board = BoardOutcome::of_run(played.as_ref(), folder.path());
        let run = match played {
            Ok(run) => run,
            Err(error) => {
                record.end = Some(if cancel.is_cancelled() { SoakEnd::Cancelled } else { SoakEnd::Lost });
                write(&record, out)?;
                let error = (!cancel.is_cancelled()).then_some(error);
                return Ok(SoakResult { record, board, error });
            }
        };
        record.add(&run, &name);
        if let Some(old) = disposable.take() {
            fs::remove_dir_all(&old).at(&old).map_err(FolderError::from)?;
        }
        if run.verdict == Verdict::Pass || record.kept.len() >= MAX_KEPT_FAILURES {
            disposable = Some(folder.path().to_owned());
        } else {
            record.kept.push(name);
        }
        record.end = end_after(config, &run, &board, started, cancel);
        write(&record, out)?;
        if record.end.is_some() {
            break;
        }
    }
    Ok(SoakResult { record, board, error: None })
}

fn end_after(
    config: &SoakConfig,
    run: &RunRecord,
    board: &BoardOutcome,
    started: Instant,
    cancel: &CancelToken,
) -> Option<SoakEnd> {
    if board.quarantine.is_some() {
        Some(SoakEnd::Lost)
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

fn write(record: &SoakRecord, out: &Path) -> Result<(), RunError> {
    Ok(record.write(out).at(out).map_err(FolderError::from)?)
}
