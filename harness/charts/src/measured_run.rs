//! Plays trials of charts and runs whose processor time is measured, and defines the errors of charts.

use platebench_engine::{Clock, RunError, RunHooks, RunPlan, TrialResult, lockstep, run};
use platebench_model::record::{FolderError, Overrides, RunFolder, RunRecord};
use platebench_model::scenario::{Diagnostic, Scenario};
use platebench_rig::{ConnectOptions, RigError, RigSpec};
use platebench_wire::LawId;
use rustix::param::clock_ticks_per_second;
use rustix::time::{ClockId, clock_gettime};
use std::io;
use std::time::Duration;

#[derive(Debug, thiserror::Error)]
pub enum ChartError {
    #[error("invalid scenario")]
    Scenario(Box<Diagnostic>),
    #[error("{0}: the setpoint is never above 0, so relative errors are undefined; expected a setpoint above 0")]
    NoSetpoint(String),
    #[error("{0}: no expectation of settling_time_ms, which the chart needs; add one")]
    NoSettlingTime(String),
    #[error("{what}: {source}")]
    Lost {
        /// Scenario and law.
        what: String,
        source: RigError,
    },
    #[error(transparent)]
    Run(#[from] RunError),
    #[error("temporary folder of the charts: {0}")]
    Temporary(#[from] io::Error),
    #[error(transparent)]
    Folder(#[from] FolderError),
}

impl From<Diagnostic> for ChartError {
    fn from(diagnostic: Diagnostic) -> Self {
        Self::Scenario(Box::new(diagnostic))
    }
}

pub(crate) const LOCKSTEP: Clock = Clock::Lockstep { wire_time: false };

pub(crate) struct MeasuredRun {
    pub(crate) record: RunRecord,
    /// Processor time of the whole run per control period, including trace and child processes.
    pub(crate) period_us: f64,
}

impl MeasuredRun {
    pub(crate) fn play(scenarios: Vec<Scenario>, rig: &RigSpec, clock: Clock) -> Result<Self, ChartError> {
        let temporary = tempfile::tempdir()?;
        let folder = RunFolder::create(Some(&temporary.path().join("run")))?;
        let plan = RunPlan::new(rig, clock, 1, scenarios, Overrides::default());
        let connect = || clock.connect(rig, &ConnectOptions::default());
        let started = process_cpu_time();
        let record = run(&plan, &folder, &connect, RunHooks::default())?;
        let elapsed_us = process_cpu_time().saturating_sub(started).as_secs_f64() * 1e6;
        let periods = |scenario: &Scenario| scenario.duration.seconds() / scenario.controller.period.seconds();
        let trials = |scenario: &Scenario| {
            record.scenarios.iter().find(|played| played.file == scenario.file).map_or(0, |played| played.trials.len())
        };
        let count: f64 = plan.scenarios.iter().map(|scenario| periods(scenario) * trials(scenario) as f64).sum();
        Ok(Self { record, period_us: elapsed_us / count })
    }
}

pub(crate) fn play_hosted(what: &str, scenario: &Scenario, law: LawId, index: u32) -> Result<TrialResult, ChartError> {
    let lost = |source| ChartError::Lost { what: what.to_owned(), source };
    let mut played = lockstep::play_hosted(scenario, law, index).map_err(lost)?;
    played.link_error.take().map_or(Ok(played), |error| Err(lost(error)))
}

pub(crate) fn thread_cpu_time() -> Duration {
    cpu_time(ClockId::ThreadCPUTime)
}

/// Includes child processes that have ended. Their time has the resolution of a clock tick.
pub(crate) fn process_cpu_time() -> Duration {
    cpu_time(ClockId::ProcessCPUTime) + children_cpu_time().unwrap_or_default()
}

/// Sums `cutime` and `cstime`, fields 16 and 17 of proc(5). The program name, which is in
/// parentheses, may contain spaces.
fn children_cpu_time() -> Option<Duration> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    let (_, fields) = stat.rsplit_once(')')?;
    let ticks: u64 = fields.split_whitespace().skip(13).take(2).map_while(|field| field.parse::<u64>().ok()).sum();
    Some(Duration::from_secs_f64(ticks as f64 / clock_ticks_per_second() as f64))
}

/// Processor time of one call on this thread, µs: the mean of a batch that takes at least `batch`.
/// A first batch warms up unless it is long enough.
pub(crate) fn call_cost_us(batch: Duration, mut call: impl FnMut()) -> f64 {
    let mut repeats = 1_u32;
    loop {
        let started = thread_cpu_time();
        (0..repeats).for_each(|_| call());
        let elapsed = thread_cpu_time().saturating_sub(started);
        if elapsed >= batch {
            return elapsed.as_secs_f64() * 1e6 / f64::from(repeats);
        }
        repeats = repeats.saturating_mul(4);
    }
}

fn cpu_time(clock: ClockId) -> Duration {
    let now = clock_gettime(clock);
    Duration::new(now.tv_sec.unsigned_abs(), now.tv_nsec.unsigned_abs() as u32)
}

/// NaN if `values` is empty.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let middle = values.len() / 2;
    let upper = values.get(middle).copied().unwrap_or(f64::NAN);
    let lower = if values.len().is_multiple_of(2) { values.get(middle.wrapping_sub(1)).copied() } else { None };
    lower.map_or(upper, |lower| 0.5 * (lower + upper))
}
