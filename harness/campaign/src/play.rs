//! Plays the trials of a shard on several workers. Traces stay in memory.

use crate::campaign::Campaign;
use crate::draw::Trial;
use crate::error::CampaignError;
use crate::part::{PartReader, PartWriter};
use crate::plan::Plan;
use crate::row::Row;
use platebench_record::Verdict;
use platebench_rig::{BoxedLink, CancelToken, ConnectOptions, FaultInjector, RigError, RigSpec, Session};
use platebench_runner::law;
use platebench_runner::trial::{self, TrialSpec};
use platebench_trace::{AtPath, Row as TraceRow};
use platebench_verdict::measure;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{self, Receiver, SyncSender};
use std::thread;

const MAX_LOSSES: u32 = 5;
/// Number of results that workers can send before they wait for the writer.
const RESULT_QUEUE: usize = 256;

#[derive(Debug, Clone)]
pub struct PlayConfig {
    pub rig: RigSpec,
    pub jobs: usize,
    pub cancel: CancelToken,
    /// Becomes true if a controller did not confirm 0 V.
    pub unconfirmed: Arc<AtomicBool>,
}

impl PlayConfig {
    pub fn new(rig: RigSpec, jobs: usize) -> Self {
        Self { rig, jobs, cancel: CancelToken::default(), unconfirmed: Arc::default() }
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
    play(campaign, &Source::Numbers(plan.trials_of(shard)), config, &mut |row| {
        on_trial(TrialEvent { is_failure: row.verdict == Verdict::Fail });
        part.push(row)
    })?;
    part.commit()?;
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
    play(campaign, &Source::Rows(rows), config, &mut |row| {
        on_trial(TrialEvent { is_failure: row.verdict == Verdict::Fail });
        replayed.push(row);
        Ok(())
    })?;
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
) -> Result<(), CampaignError> {
    let options = &ConnectOptions { cancel: config.cancel.clone(), ..ConnectOptions::default() };
    let trials = source.places();
    let next = AtomicU64::new(trials.start);
    let (sender, results) = mpsc::sync_channel(RESULT_QUEUE);
    let outcome = thread::scope(|scope| {
        for _ in 0..config.jobs.max(1) {
            let next = &next;
            let worker = Worker { campaign, source, config, options, next, end: trials.end, session: None, losses: 0 };
            let sender = sender.clone();
            scope.spawn(move || {
                let mut worker = worker;
                worker.run(&sender);
            });
        }
        drop(sender);
        let outcome = collect(trials.start, &results, on_row);
        // Marks all trials as taken, so each worker ends after its current trial.
        next.store(trials.end, Ordering::Relaxed);
        drop(results);
        outcome
    });
    let played = outcome?;
    // If a trial has no result, the campaign was cancelled or a worker panicked.
    if config.cancel.is_cancelled() || played < trials.end { Err(CampaignError::Cancelled) } else { Ok(()) }
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
    options: &'a ConnectOptions,
    next: &'a AtomicU64,
    end: u64,
    session: Option<Session<FaultInjector<BoxedLink>>>,
    losses: u32,
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
        self.close_session();
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

    fn close_session(&mut self) {
        let Some(session) = self.session.take() else { return };
        self.config.unconfirmed.fetch_or(!session.close(), Ordering::Relaxed);
    }

    /// `None` if the trial was cancelled.
    fn play(&mut self, trial: &Trial) -> Result<Option<Row>, CampaignError> {
        let law = law(&trial.scenario).map_err(|fault| CampaignError::Files(vec![fault]))?;
        let open = match &mut self.session {
            Some(open) => open,
            None => {
                self.session.insert(Session::open(FaultInjector::new(self.config.rig.connect_with(self.options)?))?)
            }
        };
        let spec = TrialSpec { own_clock: self.config.rig.has_own_clock(), ..TrialSpec::new(&trial.scenario, law, 0) };
        let Some(played) = trial::play(open, &spec, &self.config.cancel, None) else { return Ok(None) };
        match played.link_error {
            Some(rejected @ RigError::ConfigurationRejected(_)) => return Err(rejected.into()),
            Some(_) => {
                self.close_session();
                self.losses += 1;
                if self.losses >= MAX_LOSSES {
                    return Err(CampaignError::Lost(self.losses));
                }
            }
            None => self.losses = 0,
        }
        let measures = measure(&trial.scenario, 0, &played.trace_rows, &played.telemetry);
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
