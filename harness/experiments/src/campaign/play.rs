//! Plays the trials of a shard on several workers. Traces stay in memory.

use crate::campaign::definition::Campaign;
use crate::campaign::draw::Trial;
use crate::campaign::error::CampaignError;
use crate::campaign::part::{PartReader, PartWriter};
use crate::campaign::plan::Plan;
use crate::campaign::row::{Row, ShardEnd};
use platebench_engine::{Executor, ExecutorSettings, MAX_LOSSES, SafeEnds, law};
use platebench_model::record::Verdict;
use platebench_model::trace::{AtPath, Row as TraceRow};
use platebench_rig::{CancelToken, ConnectOptions, RigSpec};
use platebench_verdict::measure;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{self, Receiver, SyncSender};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;

/// Number of results that workers can send before they wait for the writer.
const RESULT_QUEUE: usize = 256;

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
    plan: &Plan,
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
    let parts = path.parent().unwrap_or(folder);
    std::fs::create_dir_all(parts).at(parts)?;
    let mut part = PartWriter::new(path, plan, campaign, shard)?;
    let end = play(campaign, &Source::Numbers(plan.trials_of(shard)), config, &mut |row| {
        on_trial(TrialEvent { is_failure: row.verdict == Verdict::Fail });
        part.push(row)
    })?;
    part.commit(end)?;
    Ok(true)
}

/// Plays the trials of `rows` again. Result i belongs to row i and has the trial number i.
pub(crate) fn replay(
    campaign: &Campaign,
    rows: &[&Row],
    config: &PlayConfig,
    on_trial: &mut dyn FnMut(TrialEvent),
) -> Result<Vec<Row>, CampaignError> {
    let mut replayed = Vec::new();
    let end = play(campaign, &Source::Rows(rows), config, &mut |row| {
        on_trial(TrialEvent { is_failure: row.verdict == Verdict::Fail });
        replayed.push(row);
        Ok(())
    })?;
    if end.is_lost(end.failed) {
        return Err(CampaignError::NotSafe);
    }
    Ok(replayed)
}

enum Source<'a> {
    /// Draws the values of these trial numbers.
    Numbers(Range<u64>),
    /// Takes the values of these rows. The number of a trial is the index of its row.
    Rows(&'a [&'a Row]),
}

impl Source<'_> {
    fn places(&self) -> Range<u64> {
        match self {
            Self::Numbers(trials) => trials.clone(),
            Self::Rows(rows) => 0..rows.len() as u64,
        }
    }
}

fn play(
    campaign: &Campaign,
    source: &Source<'_>,
    config: &PlayConfig,
    on_row: &mut dyn FnMut(Row) -> Result<(), CampaignError>,
) -> Result<ShardEnd, CampaignError> {
    let options = &ConnectOptions { cancel: config.cancel.clone(), ..ConnectOptions::default() };
    let trials = source.places();
    let next = AtomicU64::new(trials.start);
    let (ends, lost, mut failed) = (SafeEnds::default(), AtomicBool::new(false), false);
    let connect = || config.rig.connect_with(options);
    let settings = ExecutorSettings {
        own_clock: config.rig.has_own_clock(),
        max_losses: Some(MAX_LOSSES),
        ..ExecutorSettings::lockstep(&config.cancel)
    };
    let (sender, results) = mpsc::sync_channel(RESULT_QUEUE);
    let outcome = thread::scope(|scope| {
        for _ in 0..config.jobs.max(1) {
            let next = &next;
            let executor = Executor::new(&connect, settings.clone(), &ends);
            let worker = Worker { campaign, source, config, next, end: trials.end, executor, lost: &lost };
            let sender = sender.clone();
            scope.spawn(move || {
                let mut worker = worker;
                worker.run(&sender);
            });
        }
        drop(sender);
        let outcome = collect(trials.start, &results, &mut |row| {
            failed |= row.verdict == Verdict::Fail;
            on_row(row)
        });
        // Marks all trials as taken, so each worker ends after its current trial.
        next.store(trials.end, Ordering::Relaxed);
        drop(results);
        outcome
    });
    let (unconfirmed, driven) = (!ends.are_confirmed(), ends.have_drive());
    let end = ShardEnd { unconfirmed, driven, lost: lost.load(Ordering::Relaxed), failed };
    config.end.lock().unwrap_or_else(PoisonError::into_inner).add(end);
    let played = outcome?;
    // If a trial has no result, the campaign was cancelled or a worker panicked.
    if config.cancel.is_cancelled() || played < trials.end { Err(CampaignError::Cancelled) } else { Ok(end) }
}

/// Passes the rows on in the order of their trials. Returns the first trial without a result.
fn collect(
    first: u64,
    results: &Receiver<Result<Row, CampaignError>>,
    on_row: &mut dyn FnMut(Row) -> Result<(), CampaignError>,
) -> Result<u64, CampaignError> {
    let mut expected = first;
    let mut waiting = BTreeMap::new();
    for result in results {
        let row = result?;
        waiting.insert(row.trial, row);
        while let Some(row) = waiting.remove(&expected) {
            on_row(row)?;
            expected += 1;
        }
    }
    Ok(expected)
}

struct Worker<'a> {
    campaign: &'a Campaign,
    source: &'a Source<'a>,
    config: &'a PlayConfig,
    next: &'a AtomicU64,
    end: u64,
    executor: Executor<'a>,
    /// Becomes true if a controller was lost and the rig caused it.
    lost: &'a AtomicBool,
}

impl Worker<'_> {
    fn run(&mut self, results: &SyncSender<Result<Row, CampaignError>>) {
        let count = if matches!(self.source, Source::Rows(_)) { 1 } else { self.campaign.chain_trials() };
        loop {
            let first = self.next.fetch_add(count, Ordering::Relaxed);
            if first >= self.end || self.config.cancel.is_cancelled() {
                break;
            }
            let trials = first..first.saturating_add(count).min(self.end);
            let is_complete =
                if count == 1 { self.play_one(first, results) } else { self.play_chain(&trials, results) };
            if !is_complete {
                break;
            }
        }
    }

    /// Returns false if the worker must end after a cancellation or an error.
    fn play_one(&mut self, number: u64, results: &SyncSender<Result<Row, CampaignError>>) -> bool {
        let trial = match self.source {
            Source::Numbers(_) => self.campaign.trial(number),
            Source::Rows(rows) => match rows.get(number as usize) {
                Some(row) => row.trial_in(self.campaign),
                None => return false,
            },
        };
        let row = trial.and_then(|trial| self.play(&trial));
        let row = row.map(|row| row.map(|row| Row { trial: number, ..row }));
        let Some(row) = row.transpose() else { return false };
        let is_row = row.is_ok();
        results.send(row).is_ok() && is_row
    }

    fn play_chain(&mut self, trials: &Range<u64>, results: &SyncSender<Result<Row, CampaignError>>) -> bool {
        let campaign = self.campaign;
        let mut number = trials.start;
        campaign.run_chain(trials, &mut |point| {
            if number == trials.end {
                return None;
            }
            let row = campaign.chain_trial(number, point).and_then(|trial| self.play(&trial)).transpose()?;
            let score = row.as_ref().ok().map(|row| row.score);
            results.send(row).ok()?;
            number += 1;
            score
        });
        number == trials.end
    }

    /// `None` if the trial was cancelled.
    fn play(&mut self, trial: &Trial) -> Result<Option<Row>, CampaignError> {
        let law = law(&trial.scenario).map_err(|fault| CampaignError::Files(vec![fault]))?;
        let Some(played) = self.executor.play(&trial.scenario, law, 0, None)? else { return Ok(None) };
        let measures = measure(&trial.scenario, 0, &played.trace_rows, &played.telemetry);
        self.lost.fetch_or(measures.has_lost_controller(), Ordering::Relaxed);
        Ok(Some(Row::new(trial, measures, final_distance(&played.trace_rows))))
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
