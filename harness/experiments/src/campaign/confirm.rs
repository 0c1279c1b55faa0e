//! Replays some trials of the hosted rig (the screen) on the emulated firmware and compares the
//! verdicts.
//!
//! There are three groups: failing trials, trials with the smallest margins, and a random sample.
//! The selection depends on the seed of the campaign and the trial numbers, not on the order of
//! play.

use crate::campaign::definition::Campaign;
use crate::campaign::error::CampaignError;
use crate::campaign::part::PartReader;
use crate::campaign::plan::{CampaignPlan, firmware_digest};
use crate::campaign::play::{PlayConfig, TrialEvent, replay};
use crate::campaign::row::{Tally, TrialRow, keep_worst, margin_text};
use platebench_engine::RunError;
use platebench_model::record::Verdict;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

/// Largest number of replayed trials in the group of failing trials and in the random sample.
const MAX_REPLAYED: usize = 10_000;
/// One of this many trials belongs to the random sample.
const SAMPLED_ONE_IN: u64 = 100;
/// Largest number of trials in [`Agreement::differences`].
const MAX_DIFFERENCES: usize = 20;
/// Random stream of the sample. No trial uses it: trial i uses the stream `u64::MAX − i`.
const STREAM: u64 = 0xC0F1;

/// Keeps the [`MAX_REPLAYED`] rows with the smallest random keys.
#[derive(Debug, Default)]
struct Subset {
    rows: BTreeMap<(u64, u64), TrialRow>,
    candidates: u64,
}

impl Subset {
    fn add(&mut self, key: u64, row: &TrialRow) {
        self.candidates += 1;
        let key = (key, row.trial);
        if self.rows.len() < MAX_REPLAYED {
            self.rows.insert(key, row.clone());
        } else if self.rows.last_key_value().is_some_and(|(last, _)| key < *last) {
            self.rows.insert(key, row.clone());
            self.rows.pop_last();
        }
    }
}

#[derive(Debug, Default)]
struct Selection {
    failing: Subset,
    worst: Vec<TrialRow>,
    sampled: Subset,
}

impl Selection {
    fn add(&mut self, seed: u64, row: &TrialRow) {
        if !row.is_applicable {
            return;
        }
        let key = key(seed, row.trial);
        if row.verdict == Verdict::Fail {
            self.failing.add(key, row);
        }
        if key < u64::MAX / SAMPLED_ONE_IN {
            self.sampled.add(key, row);
        }
        keep_worst(&mut self.worst, row);
    }

    /// Rows of all groups by trial number. A row in several groups is returned once.
    fn rows(&self) -> Vec<&TrialRow> {
        let rows = self.failing.rows.values().chain(&self.worst).chain(self.sampled.rows.values());
        let rows: BTreeMap<u64, &TrialRow> = rows.map(|row| (row.trial, row)).collect();
        rows.into_values().collect()
    }
}

/// `None` if the campaign file has no `plan.confirm`, or if the results of a shard are missing.
pub fn confirm(
    folder: &Path,
    plan: &CampaignPlan,
    campaign: &Campaign,
    config: &PlayConfig,
    on_trial: &mut dyn FnMut(TrialEvent),
) -> Result<Option<Agreement>, CampaignError> {
    let Some(rig) = &campaign.confirm else { return Ok(None) };
    if (1..=plan.shards).any(|shard| !plan.part_path(folder, shard).exists()) {
        return Ok(None);
    }
    let mut selection = Selection::default();
    for shard in 1..=plan.shards {
        PartReader::open(folder, plan, campaign, shard)?.rows(&mut |row| {
            selection.add(campaign.seed, &row);
            Ok(())
        })?;
    }
    let config = PlayConfig { rig: rig.clone(), ..config.clone() };
    let replays = replay(campaign, &selection.rows(), &config, on_trial)?;
    let agreement = Agreement::new(&selection, &replays, campaign.confidence).ok_or(RunError::Cancelled)?;
    Ok(Some(Agreement { rig: rig.to_string(), firmware: firmware_digest(rig)?, ..agreement }))
}

/// Random 64-bit number of a trial: uniform, and independent of the values of the trial.
fn key(seed: u64, trial: u64) -> u64 {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(STREAM);
    random.set_word_pos(u128::from(trial) * 2);
    random.next_u64()
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct GroupAgreement {
    /// Number of trials that belong to the group.
    pub candidates: u64,
    pub replayed: u64,
    /// Trials that pass on one rig and fail on the other.
    pub disagreements: u64,
    /// Trials that are inconclusive on only one rig.
    pub undecided: u64,
    /// Share of disagreements, each end one-sided.
    pub interval: Option<[f64; 2]>,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct RowDifference {
    pub trial: u64,
    pub screened: Verdict,
    pub emulated: Verdict,
    /// Smallest margins on the hosted rig and on the emulated firmware; `null` in the file without
    /// a value.
    #[schemars(with = "[Option<f64>; 2]")]
    pub margins: [f64; 2],
}

/// Comparison of the hosted rig with the emulated firmware.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct Agreement {
    pub rig: String,
    /// SHA-256 of the emulated firmware.
    pub firmware: String,
    /// Number of replayed trials. A trial in several groups counts once.
    pub replayed: usize,
    /// Number of trials that pass on the hosted rig and fail on the emulated firmware.
    pub missed_failures: u64,
    pub largest_margin_difference: f64,
    /// The first 20 trials, by number, with different verdicts.
    pub differences: Vec<RowDifference>,
    pub random: GroupAgreement,
    pub failing: GroupAgreement,
    pub worst: GroupAgreement,
}

impl Agreement {
    /// `None` if `replays` does not contain one row per selected row, in the same order.
    fn new(selection: &Selection, replays: &[TrialRow], confidence: f64) -> Option<Self> {
        let screened = selection.rows();
        let is_same = screened.len() == replays.len()
            && screened.iter().zip(replays).all(|(one, other)| one.draws == other.draws);
        if !is_same {
            return None;
        }
        let replay_of: BTreeMap<u64, &TrialRow> =
            screened.iter().zip(replays).map(|(row, replay)| (row.trial, replay)).collect();
        let group = |candidates, rows: &mut dyn Iterator<Item = &TrialRow>| {
            let mut tally = Tally::new(0);
            for (row, replay) in rows.filter_map(|row| Some((row, *replay_of.get(&row.trial)?))) {
                tally.trials += 1;
                let is_decided = row.verdict != Verdict::Inconclusive && replay.verdict != Verdict::Inconclusive;
                let differs = row.verdict != replay.verdict;
                tally.failures += u64::from(differs && is_decided);
                tally.inconclusive += u64::from(differs && !is_decided);
            }
            let interval = tally.interval(confidence);
            let Tally { trials: replayed, failures: disagreements, inconclusive: undecided, .. } = tally;
            GroupAgreement { candidates, replayed, disagreements, undecided, interval }
        };
        let pairs = || screened.iter().zip(replays);
        let differences =
            pairs().filter(|(row, replay)| row.verdict != replay.verdict).map(|(row, replay)| RowDifference {
                trial: row.trial,
                screened: row.verdict,
                emulated: replay.verdict,
                margins: [row.margin(), replay.margin()],
            });
        let margins = pairs().map(|(row, replay)| (row.margin() - replay.margin()).abs());
        let missed =
            |(row, replay): &(&&TrialRow, &TrialRow)| row.verdict == Verdict::Pass && replay.verdict == Verdict::Fail;
        Some(Self {
            rig: String::new(),
            firmware: String::new(),
            random: group(selection.sampled.candidates, &mut selection.sampled.rows.values()),
            failing: group(selection.failing.candidates, &mut selection.failing.rows.values()),
            worst: group(selection.worst.len() as u64, &mut selection.worst.iter()),
            replayed: replays.len(),
            differences: differences.take(MAX_DIFFERENCES).collect(),
            missed_failures: pairs().filter(missed).count() as u64,
            largest_margin_difference: margins.filter(|margin| margin.is_finite()).fold(0.0, f64::max),
        })
    }

    pub(crate) fn lines(&self, confidence: f64) -> Vec<String> {
        let Self { replayed, rig, largest_margin_difference: largest, .. } = self;
        let mut lines =
            vec![format!("{replayed} trials replayed on {rig}; largest difference of a margin {largest:.2e}")];
        for (name, group) in [("random", &self.random), ("failing", &self.failing), ("worst", &self.worst)] {
            let GroupAgreement { candidates, replayed, disagreements, undecided, interval } = group;
            let mut line = format!(
                "  {name} trials: {disagreements} of {replayed} pass on one rig and fail on the other, {undecided} are \
                 inconclusive on one rig only"
            );
            // The worst trials are not a random sample, so they have no confidence interval.
            if let Some([low, high]) = interval.filter(|_| name != "worst") {
                let [low, high, confidence] = [low, high, confidence].map(|share| share * 100.0);
                let _ = write!(line, "; {low:.4} % to {high:.4} %, each end at {confidence} % confidence");
            }
            if candidates > replayed {
                let _ = write!(line, "; {replayed} of {candidates} were drawn at random");
            }
            lines.push(line);
        }
        lines.extend(self.differences.iter().map(
            |RowDifference { trial, screened, emulated, margins: [one, other] }| {
                let [one, other] = [*one, *other].map(margin_text);
                format!("  trial {trial}: hosted {screened} (margin {one}), emulated {emulated} (margin {other})")
            },
        ));
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::campaign::row::MAX_WORST;

    fn row(trial: u64, margin: f64) -> TrialRow {
        let verdict = if margin < 0.0 { Verdict::Fail } else { Verdict::Pass };
        TrialRow::example(trial, verdict, margin)
    }

    #[test]
    fn one_trial_of_a_hundred_is_sampled_whatever_the_others_are() {
        let is_sampled = |trial: &u64| key(7, *trial) < u64::MAX / SAMPLED_ONE_IN;
        let count = (0..100_000).filter(is_sampled).count();
        // The expected count is 1 000, with a standard deviation of 31.
        assert!((900..=1_100).contains(&count), "{count}");
        assert_ne!(key(7, 3), key(7, 4));
        assert_ne!(key(7, 3), key(8, 3));
    }

    #[test]
    fn a_subset_keeps_the_smallest_keys_in_any_order() {
        let rows: Vec<_> = (0..30_000).map(|trial| row(trial, 1.0)).collect();
        let kept = |rows: &mut dyn Iterator<Item = &TrialRow>| {
            let mut subset = Subset::default();
            for row in rows {
                subset.add(key(1, row.trial), row);
            }
            assert_eq!(subset.candidates, 30_000);
            subset.rows.into_keys().collect::<Vec<_>>()
        };
        let forward = kept(&mut rows.iter());
        assert_eq!(forward.len(), MAX_REPLAYED);
        assert_eq!(forward, kept(&mut rows.iter().rev()));
    }

    #[test]
    fn differences_are_counted_by_group() {
        let mut selection = Selection::default();
        for trial in 0..50 {
            let row = row(trial, trial as f64 - 9.5);
            if row.verdict == Verdict::Fail {
                selection.failing.add(trial, &row);
            }
            keep_worst(&mut selection.worst, &row);
        }
        selection.sampled.add(1, &row(40, 30.5));
        let rows: Vec<TrialRow> = selection.rows().into_iter().cloned().collect();
        assert_eq!(rows.len(), MAX_WORST + 1, "the failing trials are among the worst");
        let mut replays = rows.clone();
        replays[0] = TrialRow { trial: 0, draws: vec![0.0], ..row(0, 0.5) };
        replays[MAX_WORST] = TrialRow { trial: 0, draws: vec![40.0], ..row(0, -0.25) };
        let agreement = Agreement::new(&selection, &replays, 0.95).unwrap();
        let counts = [&agreement.random, &agreement.failing, &agreement.worst]
            .map(|group| (group.disagreements, group.replayed));
        assert_eq!(counts, [(1, 1), (1, 10), (1, 20)]);
        assert_eq!((agreement.missed_failures, agreement.differences[1].trial), (1, 40));
        assert!((agreement.largest_margin_difference - 30.75).abs() < 1e-12);
        replays.pop();
        assert_eq!(Agreement::new(&selection, &replays, 0.95), None);
    }
}
