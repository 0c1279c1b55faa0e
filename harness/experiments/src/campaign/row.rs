//! Defines the result of a trial and of a shard, and counts results.
//!
//! A decision before the last trial waits for all trials 0 to n − 1, for planned values of n. The
//! trials that end first are a biased sample, because a trial that settles late may take longer.
//! Each look at the results spends a part of the error probability (alpha spending).

use crate::campaign::definition::Campaign;
use crate::campaign::draw::DrawnTrial;
use crate::campaign::error::CampaignError;
use platebench_model::record::{Cause, RunOutcome, Verdict};
use platebench_model::scenario::Expectation;
use platebench_verdict::statistics::clopper_pearson;
use platebench_verdict::statistics::{Look, plan_looks};
use platebench_verdict::uncertainty::ErrorOrigin;
use platebench_verdict::uncertainty::TypeA;
use platebench_verdict::{Judgement, TrialMeasures, judge};

const VERDICTS: [Verdict; 3] = [Verdict::Pass, Verdict::Fail, Verdict::Inconclusive];
pub(crate) const CAUSES: [Cause; 4] = [Cause::Rig, Cause::Bench, Cause::Infeasible, Cause::Evidence];
/// The columns verdict, cause, redraws and score.
const FIXED_COLUMNS: usize = 4;
/// Value, margin and errors of an expectation.
const EXPECTATION_COLUMNS: usize = 2 + ErrorOrigin::OF_TRIAL.len();
/// Score of a trial without a finite margin, before its distance from the setpoint is subtracted.
/// Only the order of scores matters.
const NO_VALUE_SCORE: f64 = -1e3;
const MAX_DISTANCE: f64 = 1e3;
const SMALLEST_SCORE: f64 = 1e-12;
/// Other computers may round a margin differently.
const MARGIN_ROUNDING: f64 = 1e-9;
const EXPECT_PREFIX: &str = "expect.";

#[derive(Debug, Clone, PartialEq)]
pub struct TrialRow {
    pub trial: u64,
    /// Drawn values, as in [`DrawnTrial::values`].
    pub draws: Vec<f64>,
    /// One value per expectation; NaN if the trial has no value.
    pub values: Vec<f64>,
    /// One margin per expectation; negative infinity if the trial has no value.
    pub margins: Vec<f64>,
    /// Standard uncertainty of each value by the bench, one per expectation and origin (numerical,
    /// quantisation, sensor); NaN if one does not apply.
    pub errors: Vec<f64>,
    pub verdict: Verdict,
    /// False if the controller does not announce what the trial needs. It was then not played.
    pub is_applicable: bool,
    pub cause: Option<Cause>,
    pub redraws: u32,
    /// The smallest margin as a finite number. Negative if the trial fails, otherwise positive.
    pub score: f64,
}

impl TrialRow {
    /// `distance` is the relative distance from the setpoint at the end of the trial. The row has no
    /// errors.
    pub(crate) fn new(trial: &DrawnTrial, measures: TrialMeasures, distance: f64) -> Self {
        let Judgement { verdict, expectations } = judge(&trial.scenario, &[measures]);
        let undecided = expectations.iter().filter(|expectation| expectation.verdict == Verdict::Inconclusive);
        let margins = expectations.iter().map(|expectation| expectation.margin);
        let score = margins.map(|margin| {
            let distance = if distance.is_finite() { distance.min(MAX_DISTANCE) } else { MAX_DISTANCE };
            margin.filter(|margin| margin.is_finite()).unwrap_or(NO_VALUE_SCORE - distance)
        });
        let score = score.fold(MAX_DISTANCE, f64::min);
        let is_failure = verdict == Verdict::Fail;
        let values: Vec<f64> = expectations.iter().map(|expectation| expectation.value.unwrap_or(f64::NAN)).collect();
        Self {
            trial: trial.number,
            draws: trial.values.clone(),
            errors: Vec::new(),
            values,
            margins: expectations.iter().map(|expectation| expectation.margin.unwrap_or(f64::NEG_INFINITY)).collect(),
            verdict,
            is_applicable: true,
            cause: undecided.filter(|_| verdict == Verdict::Inconclusive).find_map(|expectation| expectation.cause),
            redraws: trial.redraws,
            score: if is_failure { score.min(-SMALLEST_SCORE) } else { score.max(SMALLEST_SCORE) },
        }
    }

    pub(crate) fn not_applicable(trial: &DrawnTrial) -> Self {
        let expectations = trial.scenario.expectations.len();
        Self {
            trial: trial.number,
            draws: trial.values.clone(),
            values: vec![f64::NAN; expectations],
            margins: vec![f64::NEG_INFINITY; expectations],
            errors: vec![f64::NAN; ErrorOrigin::OF_TRIAL.len() * expectations],
            verdict: Verdict::Inconclusive,
            is_applicable: false,
            cause: None,
            redraws: trial.redraws,
            // A search leaves such values.
            score: MAX_DISTANCE,
        }
    }

    /// The verdict for people and tables.
    pub(crate) fn verdict_text(&self) -> &'static str {
        if self.is_applicable { self.verdict.name() } else { "not applicable" }
    }

    /// The score, followed by one per expectation if there are several. A merge repeats a chain from
    /// them, so they depend only on what a part stores.
    pub(crate) fn scores(&self) -> Vec<f64> {
        let own = self.margins.iter().filter(|_| self.margins.len() > 1);
        let own = own.map(|margin| if margin.is_finite() { *margin } else { self.score.min(NO_VALUE_SCORE) });
        std::iter::once(self.score).chain(own).collect()
    }

    /// Smallest margin of all expectations.
    pub fn margin(&self) -> f64 {
        self.margins.iter().copied().fold(f64::INFINITY, f64::min)
    }

    pub(crate) fn trial_in(&self, campaign: &Campaign) -> Result<DrawnTrial, CampaignError> {
        campaign.trial_with(self.trial, self.draws.clone(), self.redraws)
    }

    /// False if a margin is not the one of its value, or if the row passes with a negative margin.
    pub(crate) fn agrees_with_limits(&self, campaign: &Campaign) -> Result<bool, CampaignError> {
        // Limits can be varied, so they may belong to the trial.
        let varied = campaign.variables.iter().any(|variable| variable.key.starts_with(EXPECT_PREFIX));
        let own = varied.then(|| self.trial_in(campaign)).transpose()?;
        let scenario = own.as_ref().map_or(&campaign.template.scenario, |trial| &trial.scenario);
        let agrees = |((expectation, value), found): ((&Expectation, &f64), &f64)| {
            let margin = expectation.margin(*value);
            let expected = margin.filter(|margin| margin.is_finite()).unwrap_or(f64::NEG_INFINITY);
            let is_equal = *found == expected || (found - expected).abs() <= MARGIN_ROUNDING * expected.abs().max(1.0);
            is_equal && !(self.verdict == Verdict::Pass && margin.is_some() && expected < -MARGIN_ROUNDING)
        };
        Ok(scenario.expectations.iter().zip(&self.values).zip(&self.margins).all(agrees))
    }

    pub(crate) const fn column_count(variables: usize, expectations: usize) -> usize {
        variables + EXPECTATION_COLUMNS * expectations + FIXED_COLUMNS
    }

    pub(crate) fn encode(&self) -> impl Iterator<Item = f64> {
        let verdict = VERDICTS.iter().position(|verdict| *verdict == self.verdict).unwrap_or_default();
        let verdict = if self.is_applicable { verdict } else { VERDICTS.len() };
        let cause = CAUSES.iter().position(|cause| Some(*cause) == self.cause).map_or(0, |position| position + 1);
        let fixed = [verdict as f64, cause as f64, f64::from(self.redraws), self.score];
        self.draws.iter().chain(&self.values).chain(&self.margins).chain(&self.errors).copied().chain(fixed)
    }

    pub(crate) fn decode(trial: u64, columns: &[f64], variables: usize) -> Option<Self> {
        let expectations = columns.len().checked_sub(variables + FIXED_COLUMNS)? / EXPECTATION_COLUMNS;
        let (draws, rest) = columns.split_at_checked(variables)?;
        let (values, rest) = rest.split_at_checked(expectations)?;
        let (margins, rest) = rest.split_at_checked(expectations)?;
        let (errors, rest) = rest.split_at_checked(ErrorOrigin::OF_TRIAL.len() * expectations)?;
        let [verdict, cause, redraws, score] = *rest else { return None };
        Some(Self {
            trial,
            draws: draws.to_vec(),
            values: values.to_vec(),
            margins: margins.to_vec(),
            errors: errors.to_vec(),
            verdict: match verdict as usize {
                code if code == VERDICTS.len() => Verdict::Inconclusive,
                code => *VERDICTS.get(code)?,
            },
            is_applicable: verdict as usize != VERDICTS.len(),
            cause: (cause as usize).checked_sub(1).and_then(|position| CAUSES.get(position)).copied(),
            redraws: redraws as u32,
            score,
        })
    }
}

/// A margin for people. A trial without a value has none.
pub(crate) fn margin_text(margin: f64) -> String {
    if margin.is_finite() { format!("{margin:.4}") } else { "–".to_owned() }
}

/// Number of trials in the table of the report and in the folder of counterexamples.
pub const MAX_WORST: usize = 20;

#[derive(Debug, Clone, PartialEq)]
pub struct Tally {
    pub trials: u64,
    pub failures: u64,
    pub inconclusive: u64,
    /// Trials that were not played. They are not in `trials`.
    pub not_applicable: u64,
    pub smallest_margin: f64,
    pub worst_trial: u64,
    /// Per expectation.
    pub values: Vec<ValueTally>,
}

/// Counts the values of an expectation.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ValueTally {
    sum: f64,
    count: u64,
    /// Mean and sum of the squared distances from it (Welford, Technometrics 4, 1962).
    mean: f64,
    squares: f64,
}

impl ValueTally {
    fn add(&mut self, value: f64) {
        (self.sum, self.count) = (self.sum + value, self.count + 1);
        let distance = value - self.mean;
        self.mean += distance / self.count as f64;
        self.squares += distance * (value - self.mean);
    }

    /// Scatter of a single value; `None` for fewer than two.
    pub(crate) fn scatter(&self) -> Option<TypeA> {
        let degrees_of_freedom = self.count.checked_sub(1).filter(|freedom| *freedom > 0)? as f64;
        Some(TypeA { standard: (self.squares / degrees_of_freedom).sqrt(), degrees_of_freedom })
    }
}

impl Tally {
    pub(crate) fn new(expectations: usize) -> Self {
        let values = vec![ValueTally::default(); expectations];
        Self {
            trials: 0,
            failures: 0,
            inconclusive: 0,
            not_applicable: 0,
            smallest_margin: f64::INFINITY,
            worst_trial: 0,
            values,
        }
    }

    pub(crate) fn add(&mut self, row: &TrialRow) {
        if !row.is_applicable {
            self.not_applicable += 1;
            return;
        }
        self.trials += 1;
        self.failures += u64::from(row.verdict == Verdict::Fail);
        self.inconclusive += u64::from(row.verdict == Verdict::Inconclusive);
        if row.margin() < self.smallest_margin || self.trials == 1 {
            (self.smallest_margin, self.worst_trial) = (row.margin(), row.trial);
        }
        for (tally, value) in self.values.iter_mut().zip(&row.values).filter(|(_, value)| !value.is_nan()) {
            tally.add(*value);
        }
    }

    /// True if all trials need what the controller does not announce.
    pub const fn is_not_applicable(&self) -> bool {
        self.trials == 0 && self.not_applicable > 0
    }

    pub fn mean(&self, expectation: usize) -> Option<f64> {
        self.values.get(expectation).filter(|tally| tally.count > 0).map(|tally| tally.sum / tally.count as f64)
    }

    /// Whether no larger share of the cell's trials than `at_most` (default 0) fails or is
    /// inconclusive. `None` without trials.
    pub fn passes(&self, at_most: Option<f64>) -> Option<bool> {
        let missed = (self.failures + self.inconclusive) as f64;
        (self.trials > 0).then(|| missed <= at_most.unwrap_or(0.0) * self.trials as f64)
    }

    /// Share of failing trials, each end one-sided. The upper end also counts inconclusive trials.
    pub fn interval(&self, confidence: f64) -> Option<[f64; 2]> {
        let count = |count: u64| u32::try_from(count).unwrap_or(u32::MAX);
        let bounds = |failures: u64| clopper_pearson(count(failures), count(self.trials), confidence);
        let ([low, _], [_, high]) = (bounds(self.failures)?, bounds(self.failures + self.inconclusive)?);
        Some([low, high])
    }

    pub fn verdict(&self, at_most: Option<f64>, confidence: f64) -> Verdict {
        let Some(interval) = self.interval(confidence) else { return Verdict::Inconclusive };
        let (fails, passes) = match at_most {
            Some(share) => (interval[0] > share, interval[1] <= share),
            None => (self.failures > 0, true),
        };
        match (fails, passes && self.inconclusive == 0) {
            (true, _) => Verdict::Fail,
            (false, true) => Verdict::Pass,
            (false, false) => Verdict::Inconclusive,
        }
    }
}

/// Adds `row` if it is among the worst. Of rows with equal margins, the earlier one is worse.
pub(crate) fn keep_worst(worst: &mut Vec<TrialRow>, row: &TrialRow) {
    let place = worst.partition_point(|kept| kept.margin() <= row.margin());
    if place < MAX_WORST {
        worst.insert(place, row.clone());
        worst.truncate(MAX_WORST);
    }
}

const FIRST_LOOK: u32 = 32;

/// Looks at the first 32, 64, 128 … trials.
#[derive(Debug)]
pub struct EarlyDecision {
    at_most: Option<f64>,
    confidence: f64,
    looks: std::vec::IntoIter<Look>,
    next: Option<Look>,
    tally: Tally,
    decision: Option<(u32, Verdict)>,
}

impl EarlyDecision {
    pub(crate) fn new(trials: u64, at_most: Option<f64>, confidence: f64) -> Self {
        let trials = u32::try_from(trials).unwrap_or(u32::MAX);
        let mut looks = plan_looks(FIRST_LOOK.min(trials), trials).into_iter();
        let next = looks.next();
        Self { at_most, confidence, looks, next, tally: Tally::new(0), decision: None }
    }

    /// Ignores all trials after a missing trial.
    pub(crate) fn add(&mut self, row: &TrialRow) {
        let (Some(_), Some(look)) = (self.at_most, self.next) else { return };
        if row.trial != self.tally.trials || self.decision.is_some() {
            return;
        }
        self.tally.add(row);
        if self.tally.trials == u64::from(look.trials) {
            let verdict = self.tally.verdict(self.at_most, look.confidence(self.confidence));
            self.decision = (verdict != Verdict::Inconclusive).then_some((look.trials, verdict));
            self.next = self.looks.next();
        }
    }

    pub const fn decision(&self) -> Option<(u32, Verdict)> {
        self.decision
    }
}

/// Key of the metadata. A part without this key ended well.
pub(crate) const END_KEY: &str = "controller";

#[expect(clippy::struct_excessive_bools, reason = "independent events of one shard")]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ShardEnd {
    /// A controller did not confirm 0 V at the end, or did not stay there.
    pub unconfirmed: bool,
    /// A controller commanded a drive after it had confirmed 0 V, outside all trials.
    pub driven: bool,
    /// A controller was lost in a trial, and the rig caused it.
    pub lost: bool,
    /// A trial failed. Not stored, because the rows of the part show it.
    pub failed: bool,
}

impl ShardEnd {
    pub fn add(&mut self, other: Self) {
        self.failed |= other.failed;
        self.unconfirmed |= other.unconfirmed;
        self.driven |= other.driven;
        self.lost |= other.lost;
    }

    /// True if the rig counts as lost, by the rule of `platebench run`: a failure of the controller
    /// also explains a missing confirmation of 0 V.
    pub fn is_lost(self, has_failure: bool) -> bool {
        let verdict = if has_failure || self.driven { Verdict::Fail } else { Verdict::Inconclusive };
        RunOutcome::of(verdict, self.lost, !self.unconfirmed) == RunOutcome::Unreachable
    }

    /// `None` if all controllers ended well.
    pub(crate) fn encode(self) -> Option<String> {
        let names = [(self.unconfirmed, "unconfirmed"), (self.driven, "driven"), (self.lost, "lost")];
        let names: Vec<_> = names.into_iter().filter(|(is_set, _)| *is_set).map(|(_, name)| name).collect();
        (!names.is_empty()).then(|| names.join(" "))
    }

    pub(crate) fn decode(text: &str) -> Self {
        let has = |wanted| text.split(' ').any(|name| name == wanted);
        Self { unconfirmed: has("unconfirmed"), driven: has("driven"), lost: has("lost"), failed: false }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    impl TrialRow {
        pub(crate) fn example(trial: u64, verdict: Verdict, margin: f64) -> Self {
            let (draws, values, margins, errors) = (vec![trial as f64], Vec::new(), vec![margin], Vec::new());
            Self {
                trial,
                draws,
                values,
                margins,
                errors,
                verdict,
                is_applicable: true,
                cause: None,
                redraws: 0,
                score: margin,
            }
        }
    }

    #[test]
    fn a_row_survives_its_part() {
        let row = TrialRow {
            trial: 7,
            draws: vec![1.0, 0.25],
            values: vec![1.5],
            margins: vec![f64::NEG_INFINITY],
            errors: vec![0.5, 0.25, 0.125],
            verdict: Verdict::Inconclusive,
            is_applicable: true,
            cause: Some(Cause::Infeasible),
            redraws: 2,
            score: -1_000.5,
        };
        let columns: Vec<f64> = row.encode().collect();
        assert_eq!(columns.len(), TrialRow::column_count(2, 1));
        assert_eq!(TrialRow::decode(7, &columns, 2), Some(row));
        assert_eq!(TrialRow::decode(7, &columns[..columns.len() - 1], 2), None);
    }

    fn tally(trials: u64, failures: u64, inconclusive: u64) -> Tally {
        Tally { trials, failures, inconclusive, ..Tally::new(0) }
    }

    // Without failures, the bound is 1 − 0.05^(1/n): 0.010 015 for n = 298, 0.009 969 for 299.
    #[rstest]
    #[case(298, 0, 0, Some(0.01), Verdict::Inconclusive)]
    #[case(299, 0, 0, Some(0.01), Verdict::Pass)]
    #[case(299, 0, 1, Some(0.01), Verdict::Inconclusive)]
    #[case(10_000, 0, 1, Some(0.01), Verdict::Inconclusive)]
    #[case(100, 50, 0, Some(0.4), Verdict::Fail)]
    #[case(100, 50, 0, Some(0.45), Verdict::Inconclusive)]
    #[case(100, 1, 0, None, Verdict::Fail)]
    #[case(100, 0, 0, None, Verdict::Pass)]
    #[case(100, 0, 1, None, Verdict::Inconclusive)]
    #[case(0, 0, 0, None, Verdict::Inconclusive)]
    fn a_verdict_follows_the_interval(
        #[case] trials: u64,
        #[case] failures: u64,
        #[case] inconclusive: u64,
        #[case] at_most: Option<f64>,
        #[case] expected: Verdict,
    ) {
        assert_eq!(tally(trials, failures, inconclusive).verdict(at_most, 0.95), expected);
    }

    #[test]
    fn the_interval_is_that_of_clopper_and_pearson() {
        let [low, high] = tally(10, 5, 0).interval(0.975).unwrap();
        assert!((low - 0.187_086).abs() < 1e-6 && (high - 0.812_914).abs() < 1e-6, "{low} {high}");
        assert_eq!(tally(10, 5, 2).interval(0.975).unwrap()[0], low);
        assert!(tally(10, 5, 2).interval(0.975).unwrap()[1] > high);
    }

    #[test]
    fn the_worst_rows_are_sorted_by_margin() {
        let mut worst = Vec::new();
        for trial in 0..100 {
            keep_worst(&mut worst, &TrialRow::example(trial, Verdict::Fail, -((trial % 10) as f64)));
        }
        assert_eq!(worst.len(), MAX_WORST);
        assert_eq!((worst[0].trial, worst[9].trial, worst[10].trial), (9, 99, 8));
    }

    fn row(trial: u64, verdict: Verdict) -> TrialRow {
        TrialRow::example(trial, verdict, 1.0)
    }

    fn decide(rows: impl IntoIterator<Item = TrialRow>) -> Option<(u32, Verdict)> {
        let mut decision = EarlyDecision::new(1_000, Some(0.1), 0.95);
        rows.into_iter().for_each(|row| decision.add(&row));
        decision.decision()
    }

    #[test]
    fn decides_at_a_planned_number_of_trials() {
        assert_eq!(decide((0..1_000).map(|trial| row(trial, Verdict::Fail))), Some((32, Verdict::Fail)));
        // If 10 % of all trials fail, 64 trials pass with the probability 0.9⁶⁴ = 0.0012.
        assert_eq!(decide((0..1_000).map(|trial| row(trial, Verdict::Pass))), Some((64, Verdict::Pass)));
        assert_eq!(decide((0..40).map(|trial| row(trial, Verdict::Pass))), None);
    }

    // Every fifth trial fails and ends late. The trials that end first all pass.
    #[test]
    fn trials_that_ended_first_decide_nothing() {
        let fails = |trial: u64| trial.is_multiple_of(5);
        let ended: Vec<u64> = (0..1_000).filter(|trial| !fails(*trial)).collect();
        let passing = |(number, _): (u64, &u64)| row(number, Verdict::Pass);
        assert_eq!(decide((0..).zip(&ended).map(passing)), Some((64, Verdict::Pass)), "the biased decision");
        assert_eq!(decide(ended.iter().map(|trial| row(*trial, Verdict::Pass))), None);
        let verdict = |trial| if fails(trial) { Verdict::Fail } else { Verdict::Pass };
        assert_eq!(
            decide((0..1_000).map(|trial| row(trial, verdict(trial)))).map(|found| found.1),
            Some(Verdict::Fail)
        );
    }

    #[test]
    fn decides_wrongly_no_more_often_than_stated() {
        use rand_chacha::ChaCha8Rng;
        use rand_chacha::rand_core::{Rng, SeedableRng};
        // The true share equals the allowed share, so every decision `pass` is wrong.
        let wrong = (0..400).filter(|seed| {
            let mut random = ChaCha8Rng::seed_from_u64(*seed);
            let mut draw = |trial| {
                let fails = f64::from(random.next_u32()) < 0.1 * f64::from(u32::MAX);
                row(trial, if fails { Verdict::Fail } else { Verdict::Pass })
            };
            decide((0..1_000).map(&mut draw)).is_some_and(|(_, verdict)| verdict == Verdict::Pass)
        });
        let wrong = wrong.count();
        assert!(wrong <= 30, "{wrong} of 400, expected 20 or fewer, with a standard deviation of 4.4");
    }
}
