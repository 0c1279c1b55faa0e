//! Plays the trials of a shard on several workers, in memory.

use crate::campaign::Campaign;
use crate::error::CampaignError;
use crate::part::{PartReader, PartWriter};
use crate::plan::Plan;
use crate::row::Row;
use platebench_record::Verdict;
use platebench_rig::{BoxedLink, CancelToken, ConnectError, ConnectOptions, FaultInjector, RigError, RigSpec, Session};
use platebench_runner::law;
use platebench_runner::trial::{self, TrialSpec};
use platebench_verdict::measure;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{self, Receiver, SyncSender};
use std::thread;

const MAX_LOSSES: u32 = 5;
/// Results that wait for an earlier trial or for the disk.
const RESULT_QUEUE: usize = 256;

/// How trials are played.
#[derive(Debug, Clone)]
pub struct PlayConfig {
    pub rig: RigSpec,
    /// Number of workers, each with its own controller.
    pub jobs: usize,
    pub cancel: CancelToken,
}

/// A trial was played.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TrialEvent {
    pub is_failure: bool,
}

type Connect<'a> = dyn Fn() -> Result<BoxedLink, ConnectError> + Send + Sync + 'a;

/// Plays a shard, unless its part is whole. A damaged part is replaced. False if the part was whole.
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
        match PartReader::open(folder, plan, campaign, shard) {
            Ok(_) => return Ok(false),
            Err(CampaignError::Damaged { .. }) => {}
            Err(error) => return Err(error),
        }
    }
    let parts = path.parent().unwrap_or(folder);
    std::fs::create_dir_all(parts).map_err(CampaignError::io(parts))?;
    let mut part = PartWriter::new(path, plan, campaign, shard)?;
    let options = ConnectOptions { cancel: config.cancel.clone(), ..ConnectOptions::default() };
    let connect = || config.rig.connect_with(&options);
    play(campaign, plan.trials_of(shard), config, &connect, &mut |row| {
        on_trial(TrialEvent { is_failure: row.verdict == Verdict::Fail });
        part.push(row)
    })?;
    part.commit()?;
    Ok(true)
}

/// Calls `on_row` in the order of the trials.
fn play(
    campaign: &Campaign,
    trials: Range<u64>,
    config: &PlayConfig,
    connect: &Connect<'_>,
    on_row: &mut dyn FnMut(Row) -> Result<(), CampaignError>,
) -> Result<(), CampaignError> {
    let next = AtomicU64::new(trials.start);
    let (sender, results) = mpsc::sync_channel(RESULT_QUEUE);
    let outcome = thread::scope(|scope| {
        for _ in 0..config.jobs.max(1) {
            let worker = Worker { campaign, config, connect, next: &next, end: trials.end };
            let sender = sender.clone();
            scope.spawn(move || worker.run(&sender));
        }
        drop(sender);
        let outcome = collect(trials.start, &results, on_row);
        // Workers end at their next trial.
        next.store(trials.end, Ordering::Relaxed);
        drop(results);
        outcome
    });
    let played = outcome?;
    // A worker without a result was cancelled or panicked.
    if config.cancel.is_cancelled() || played < trials.end { Err(CampaignError::Cancelled) } else { Ok(()) }
}

/// Returns the first trial without a result.
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
    config: &'a PlayConfig,
    connect: &'a Connect<'a>,
    next: &'a AtomicU64,
    end: u64,
}

impl Worker<'_> {
    fn run(&self, results: &SyncSender<Result<Row, CampaignError>>) {
        let mut session = None;
        let mut losses = 0;
        loop {
            let number = self.next.fetch_add(1, Ordering::Relaxed);
            if number >= self.end || self.config.cancel.is_cancelled() {
                break;
            }
            let result = match self.play(&mut session, number, &mut losses) {
                Ok(Some(row)) => Ok(row),
                Ok(None) => break,
                Err(error) => Err(error),
            };
            let is_over = result.is_err();
            if results.send(result).is_err() || is_over {
                break;
            }
        }
        if let Some(session) = session {
            session.close();
        }
    }

    /// `None` if it was cancelled.
    fn play(
        &self,
        session: &mut Option<Session<FaultInjector<BoxedLink>>>,
        number: u64,
        losses: &mut u32,
    ) -> Result<Option<Row>, CampaignError> {
        let trial = self.campaign.trial(number)?;
        let law = law(&trial.scenario).map_err(|fault| CampaignError::Files(vec![fault]))?;
        let open = match session {
            Some(open) => open,
            None => session.insert(Session::open(FaultInjector::new((self.connect)()?))?),
        };
        let spec = TrialSpec { own_clock: self.config.rig.has_own_clock(), ..TrialSpec::new(&trial.scenario, law, 0) };
        let Some(played) = trial::play(open, &spec, &self.config.cancel, None) else { return Ok(None) };
        match played.link_error {
            Some(rejected @ RigError::ConfigurationRejected(_)) => return Err(rejected.into()),
            Some(_) => {
                if let Some(lost) = session.take() {
                    lost.close();
                }
                *losses += 1;
                if *losses >= MAX_LOSSES {
                    return Err(CampaignError::Lost(*losses));
                }
            }
            None => *losses = 0,
        }
        Ok(Some(Row::new(&trial, measure(&trial.scenario, 0, &played.trace_rows, &played.telemetry))))
    }
}
