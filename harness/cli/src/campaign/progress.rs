//! Prints the progress of a campaign.

use crate::stdio;
use platebench_experiments::campaign::TrialEvent;
use std::time::{Duration, Instant};

const PROGRESS_INTERVAL: Duration = Duration::from_secs(10);

#[derive(Debug, Clone, Copy)]
pub(super) enum PlayEvent {
    Trial(TrialEvent),
    /// Number of trials in a shard that was complete before, so it is not played again.
    Skipped(u64),
}

pub(super) struct CampaignProgress {
    started: Instant,
    last: Instant,
    quiet: bool,
    total: u64,
    played: u64,
    skipped: u64,
    failures: u64,
}

impl CampaignProgress {
    /// `total` is the number of trials, or 0 if the number is not known.
    pub(super) fn new(total: u64, quiet: bool) -> Self {
        let now = Instant::now();
        Self { started: now, last: now, quiet, total, played: 0, skipped: 0, failures: 0 }
    }

    pub(super) fn add(&mut self, event: PlayEvent) {
        match event {
            PlayEvent::Skipped(trials) => self.skipped += trials,
            PlayEvent::Trial(TrialEvent { is_failure }) => {
                self.played += 1;
                self.failures += u64::from(is_failure);
            }
        }
        if !self.quiet && self.last.elapsed() >= PROGRESS_INTERVAL {
            self.last = Instant::now();
            let failures = self.failures;
            if self.total == 0 {
                return stdio::note(&format!("{} trials played again, {failures} failed", self.played));
            }
            let rate = self.played as f64 / self.started.elapsed().as_secs_f64();
            let left = self.total.saturating_sub(self.played + self.skipped) as f64 / rate.max(1e-9);
            stdio::note(&format!(
                "{} of {} trials, {failures} failed, {rate:.0} trials/s, {left:.0} s left",
                self.played + self.skipped,
                self.total
            ));
        }
    }
}
