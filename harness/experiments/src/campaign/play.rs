//! Plays the trials of a shard on several workers. Traces stay in memory.

use crate::campaign::bench_error::BenchErrors;
use crate::campaign::definition::Campaign;
use crate::campaign::draw::DrawnTrial;
use crate::campaign::error::CampaignError;
use crate::campaign::paired_trials::{PairedErrors, PairedTrials};
use crate::campaign::part::{PartReader, PartWriter};
use crate::campaign::plan::CampaignPlan;
use crate::campaign::row::{ShardEnd, TrialRow};
use platebench_engine::workers::{Emit, InOrder, run_workers};
use platebench_engine::{
    Executor, ExecutorSettings, FirmwareDigest, LinkFactory, MAX_LOSSES, RunError, SafeEnds, law, why_not_applicable,
};
use platebench_model::record::Verdict;
use platebench_model::trace::Row as TraceRow;
use platebench_rig::{CancelToken, ConnectOptions, RigSpec};
use platebench_verdict::measure;
use std::ops::{ControlFlow, Range};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use tracing::error;

/// Control periods that a worker plays before it passes rows on, and the largest number of trials. That
/// is about 10 ms on the hosted rig and 0.1 s on the emulated one.
const TASK_PERIODS: u64 = 2_000;
const MAX_TASK_TRIALS: u64 = 32;

#[derive(Debug, Clone)]
pub struct PlayConfig {
    pub rig: RigSpec,
    pub jobs: usize,
    pub cancel: CancelToken,
    /// Collects what happened to the controllers, also if the campaign ends with an error.
    pub end: Arc<Mutex<ShardEnd>>,
}

impl PlayConfig {
    pub fn new(rig: RigSpec, jobs: usize) -> Self {
        Self { rig, jobs, cancel: CancelToken::default(), end: Arc::default() }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TrialEvent {
    pub is_failure: bool,
}

/// Returns false without playing if the part of the shard is complete. Replaces a damaged part.
pub fn play_shard(
    folder: &Path,
    plan: &CampaignPlan,
    campaign: &Campaign,
    shard: u32,
    config: &PlayConfig,
    on_trial: &mut dyn FnMut(TrialEvent),
) -> Result<bool, CampaignError> {
    if !(1..=plan.shards).contains(&shard) {
        return Err(CampaignError::NoShard { shard, shards: plan.shards });
    }
    let path = plan.part_path(folder, shard);
    if path.exists() {
        match PartReader::open(folder, plan, campaign, shard).and_then(|part| part.check_rows()) {
            Ok(()) => return Ok(false),
            Err(CampaignError::Damaged { .. }) => {}
            Err(error) => return Err(error),
        }
    }
    let mut part = PartWriter::new(folder, plan, campaign, shard)?;
    let (mut played, mut failed) = (0, Vec::new());
    let end = play_on_rig(campaign, &TrialSource::Numbers(plan.trials_of(shard)), config, &mut |row| {
        let is_failure = row.verdict == Verdict::Fail;
        on_trial(TrialEvent { is_failure });
        played += 1;
        failed.extend(is_failure.then_some(row.trial));
        part.push(row)
    });
    let end = end.inspect_err(|_| {
        // The part is not written, but each trial can be played again by its number.
        if !failed.is_empty() {
            error!(shard, played, ?failed, "the shard ended early; trials that failed before");
        }
    })?;
    part.commit(end)?;
    Ok(true)
}

/// Plays the trials of `rows` again. Result i belongs to row i and has the trial number i.
pub(crate) fn replay(
    campaign: &Campaign,
    rows: &[&TrialRow],
    config: &PlayConfig,
    on_trial: &mut dyn FnMut(TrialEvent),
) -> Result<Vec<TrialRow>, CampaignError> {
    let mut replayed = Vec::new();
    let end = play_on_rig(campaign, &TrialSource::Rows(rows), config, &mut |row| {
        on_trial(TrialEvent { is_failure: row.verdict == Verdict::Fail });
        replayed.push(row);
        Ok(())
    })?;
    if end.is_lost(end.failed) {
        return Err(CampaignError::NotSafe);
    }
    Ok(replayed)
}

fn play_on_rig(
    campaign: &Campaign,
    source: &TrialSource<'_>,
    config: &PlayConfig,
    on_row: &mut dyn FnMut(TrialRow) -> Result<(), CampaignError>,
) -> Result<ShardEnd, CampaignError> {
    let options = ConnectOptions { cancel: config.cancel.clone(), ..ConnectOptions::default() };
    play_trials(campaign, source, &|| config.rig.connect_with(&options), config, on_row)
}

#[derive(Debug)]
pub enum TrialSource<'a> {
    /// Draws the values of these trial numbers.
    Numbers(Range<u64>),
    /// Takes the values of these rows. The number of a trial is the index of its row.
    Rows(&'a [&'a TrialRow]),
}

impl TrialSource<'_> {
    fn places(&self) -> Range<u64> {
        match self {
            Self::Numbers(trials) => trials.clone(),
            Self::Rows(rows) => 0..rows.len() as u64,
        }
    }
}

/// Plays the trials of `source` on several workers. Passes the rows on in the order of the trials.
pub fn play_trials(
    campaign: &Campaign,
    source: &TrialSource<'_>,
    connect: &LinkFactory<'_>,
    config: &PlayConfig,
    on_row: &mut dyn FnMut(TrialRow) -> Result<(), CampaignError>,
) -> Result<ShardEnd, CampaignError> {
    let firmware = FirmwareDigest::of_rig(&config.rig.to_string());
    let settings = ExecutorSettings {
        own_clock: config.rig.has_own_clock(),
        firmware: Some(&firmware),
        max_losses: Some(MAX_LOSSES),
        ..ExecutorSettings::lockstep(&config.cancel)
    };
    let (ends, mut failed) = (SafeEnds::default(), false);
    let player = TrialPlayer {
        campaign,
        source,
        errors: BenchErrors::new(campaign),
        paired: PairedTrials::new(campaign),
        lost: AtomicBool::new(false),
        has_stated_reason: AtomicBool::new(false),
    };
    let trials = source.places();
    let count = player.trials_per_task(&config.rig);
    let next = AtomicU64::new(trials.start);
    let task = || {
        let first = next.fetch_add(count, Ordering::Relaxed);
        let is_over = first >= trials.end || config.cancel.is_cancelled();
        (!is_over).then(|| first..first.saturating_add(count).min(trials.end))
    };
    let executors = (0..config.jobs.max(1)).map(|_| Executor::new(connect, settings.clone(), &ends));
    let mut rows = InOrder::starting_at(trials.start);
    let outcome = run_workers(
        executors,
        task,
        |executor, trials, emit| player.play(executor, trials, emit),
        &mut |played: Vec<TrialRow>| {
            for row in played {
                rows.insert(row.trial, row);
            }
            while let Some(row) = rows.take_next() {
                failed |= row.verdict == Verdict::Fail;
                on_row(row)?;
            }
            Ok(ControlFlow::Continue(()))
        },
    );
    let (unconfirmed, driven) = (!ends.are_confirmed(), ends.have_drive());
    let end = ShardEnd { unconfirmed, driven, lost: player.lost.into_inner(), failed };
    config.end.lock().unwrap_or_else(PoisonError::into_inner).add(end);
    outcome?;
    // If a trial has no result, the campaign was cancelled.
    if config.cancel.is_cancelled() || rows.next_number() < trials.end {
        Err(RunError::Cancelled.into())
    } else {
        Ok(end)
    }
}

struct TrialPlayer<'a> {
    campaign: &'a Campaign,
    source: &'a TrialSource<'a>,
    errors: BenchErrors,
    paired: PairedTrials<'a>,
    /// Becomes true if a controller was lost and the rig caused it.
    lost: AtomicBool,
    /// True after the message about the first trial that does not count, or whose controller ended.
    has_stated_reason: AtomicBool,
}

impl TrialPlayer<'_> {
    /// Number of trials that one worker plays before it passes their rows on.
    fn trials_per_task(&self, rig: &RigSpec) -> u64 {
        let scenario = &self.campaign.template.scenario;
        let periods = scenario.duration.as_nanos() / scenario.controller.period.as_nanos().max(1);
        match self.source {
            TrialSource::Numbers(_) if self.is_chain() => self.campaign.chain_trials(),
            TrialSource::Numbers(_) if rig.is_simulated() => (TASK_PERIODS / periods.max(1)).clamp(1, MAX_TASK_TRIALS),
            TrialSource::Numbers(_) | TrialSource::Rows(_) => 1,
        }
    }

    /// True if the trials of a task depend on each other.
    fn is_chain(&self) -> bool {
        matches!(self.source, TrialSource::Numbers(_)) && self.campaign.chain_trials() > 1
    }

    /// The rows of the trials before an error are passed on too.
    fn play(
        &self,
        executor: &mut Executor<'_>,
        mut trials: Range<u64>,
        emit: &mut Emit<'_, Vec<TrialRow>>,
    ) -> Result<(), CampaignError> {
        if self.is_chain() {
            return self.play_chain(executor, &trials, emit);
        }
        let mut rows = Vec::new();
        let outcome = trials.try_for_each(|number| {
            let trial = match self.source {
                TrialSource::Numbers(_) => self.campaign.trial(number)?,
                TrialSource::Rows(rows) => match rows.get(number as usize) {
                    Some(row) => row.trial_in(self.campaign)?,
                    None => return Ok(()),
                },
            };
            let row = self.play_trial(executor, &trial)?;
            rows.extend(row.map(|row| TrialRow { trial: number, ..row }));
            Ok(())
        });
        emit(rows);
        outcome
    }

    fn play_chain(
        &self,
        executor: &mut Executor<'_>,
        trials: &Range<u64>,
        emit: &mut Emit<'_, Vec<TrialRow>>,
    ) -> Result<(), CampaignError> {
        let campaign = self.campaign;
        let (mut number, mut outcome) = (trials.start, Ok(()));
        campaign.run_chain(trials, &mut |point| {
            if number == trials.end {
                return None;
            }
            let played = campaign.chain_trial(number, point).and_then(|trial| self.play_trial(executor, &trial));
            let row = played.unwrap_or_else(|error| {
                outcome = Err(error);
                None
            })?;
            let scores = row.scores();
            number += 1;
            emit(vec![row]).then_some(scores)
        });
        outcome
    }

    /// `None` if the trial was cancelled.
    fn play_trial(&self, executor: &mut Executor<'_>, trial: &DrawnTrial) -> Result<Option<TrialRow>, CampaignError> {
        let law = law(&trial.scenario).map_err(|problem| CampaignError::Files(vec![problem]))?;
        let missing = why_not_applicable(&trial.scenario, law, true, executor.session()?);
        if missing.map_err(|problem| CampaignError::Files(vec![*problem]))?.is_some() {
            return Ok(Some(TrialRow::not_applicable(trial)));
        }
        let Some(played) = executor.play(&trial.scenario, law, 0, None)? else { return Ok(None) };
        let measures = measure(&trial.scenario, 0, &played.trace_rows, &played.telemetry);
        self.lost.fetch_or(measures.has_lost_controller(), Ordering::Relaxed);
        let reason = measures.exclusion.as_ref().map(ToString::to_string).or_else(|| measures.ended.clone());
        if let Some(reason) = reason
            && !self.has_stated_reason.swap(true, Ordering::Relaxed)
        {
            error!(trial = trial.number, "{reason}");
        }
        let mut row = TrialRow::new(trial, measures, final_distance(&played.trace_rows));
        // The errors of a replayed row are not read.
        let paired = match self.source {
            TrialSource::Numbers(_) => self.paired.errors(executor, trial, &row.values)?,
            TrialSource::Rows(_) => PairedErrors::default(),
        };
        row.errors = self.errors.of(&trial.scenario, &row.values, &played, &paired);
        Ok(Some(row))
    }
}

/// Mean distance of the amplitude from the setpoint in the last third of the trial, relative to the
/// setpoint; in µm if the setpoint is 0.
fn final_distance(rows: &[TraceRow]) -> f64 {
    let last = rows.get(rows.len() * 2 / 3..).unwrap_or_default();
    let sum = |of: fn(&TraceRow) -> f64| last.iter().map(of).sum::<f64>();
    let setpoint = sum(|row| row.setpoint_um.abs());
    sum(|row| (row.amplitude_um - row.setpoint_um).abs()) / if setpoint > 0.0 { setpoint } else { last.len() as f64 }
}
