//! Compares two controllers that played the same campaign, trial by trial.
//!
//! Values and seed of trial i depend only on the campaign file, so trial i of both folders has the
//! same scene and the same noise. The difference of such a pair has less scatter than the values
//! themselves. A mean difference has the interval of Student's t distribution, as the mean of a
//! [scenario's](platebench_verdict::statistics::mean_bounds) trials. The share of failing trials is
//! compared by the shares of the pairs in which only one fails. Each share has the exact interval of
//! Clopper and Pearson with half of the error (Bonferroni), and the difference has their difference.

use crate::campaign::definition::Campaign;
use crate::campaign::error::CampaignError;
use crate::campaign::part::PartReader;
use crate::campaign::plan::CampaignPlan;
use crate::campaign::results::with_unit;
use crate::campaign::row::TrialRow;
use platebench_document::format::with_decimals;
use platebench_document::{Block, Column, Document, Table};
use platebench_model::quoted;
use platebench_model::record::Verdict;
use platebench_model::scenario::Expectation;
use platebench_model::trace::{AtPath, OutputFolder};
use platebench_verdict::statistics::{clopper_pearson, mean_bounds};
use schemars::JsonSchema;
use serde::Serialize;
use serde_json::Value;
use std::io;
use std::path::Path;

pub const COMPARISON_FILE: &str = "comparison.json";
pub const COMPARISON_PAGE: &str = "comparison.html";

/// A campaign folder and the label of its controller.
#[derive(Debug, Clone, Copy)]
pub struct LabelledFolder<'a> {
    pub label: &'a str,
    pub folder: &'a Path,
}

/// Content of `comparison.json`.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct CampaignComparison {
    pub format: u32,
    pub title: String,
    /// One-sided confidence of each end of an interval.
    pub confidence: f64,
    /// One per controller, except for the last, which is the reference of all.
    pub pairs: Vec<PairComparison>,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct PairComparison {
    pub controller: ComparedController,
    pub reference: ComparedController,
    pub overall: PairedTally,
    /// One per combination of listed values.
    pub cells: Vec<PairedTally>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, JsonSchema)]
pub struct ComparedController {
    pub label: String,
    pub rig: String,
    pub firmware_sha256: String,
}

impl ComparedController {
    fn new(LabelledFolder { label, .. }: &LabelledFolder<'_>, plan: &CampaignPlan) -> Self {
        Self { label: (*label).to_owned(), rig: plan.rig.clone(), firmware_sha256: plan.firmware().to_owned() }
    }
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, JsonSchema)]
pub struct PairedTally {
    /// Listed values of a cell.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub values: Option<Value>,
    /// The listed values, for people; empty for all trials.
    #[serde(skip)]
    pub cell: String,
    /// Trials that both controllers passed or failed. Only these are compared.
    pub trials: u64,
    pub only_controller_fails: u64,
    pub only_reference_fails: u64,
    pub both_fail: u64,
    /// Trials that are inconclusive with one of the two.
    pub inconclusive: u64,
    /// Trials that one of the two does not announce.
    pub not_applicable: u64,
    /// Failing share of the controller minus that of the reference; `null` without trials.
    pub failing_share_difference: Option<f64>,
    /// `null` without trials.
    pub failing_share_interval: Option<[f64; 2]>,
    pub differences: Vec<PairedDifference>,
}

/// Value of the controller minus value of the reference, in the unit of the metric.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct PairedDifference {
    pub expectation: String,
    /// Empty for a metric without a unit.
    pub unit: &'static str,
    /// Trials in which both controllers have a value.
    pub pairs: u64,
    pub controller_mean: Option<f64>,
    pub reference_mean: Option<f64>,
    pub mean_difference: Option<f64>,
    /// `null` with fewer than two pairs.
    pub interval: Option<[f64; 2]>,
}

/// Trials of one cell, or of all.
#[derive(Debug, Clone)]
struct Pairs {
    /// Values of both controllers, one list per expectation.
    values: Vec<Vec<[f64; 2]>>,
    tally: PairedTally,
}

impl Pairs {
    fn new(campaign: &Campaign) -> Self {
        let expectations = campaign.template.scenario.expectations.len();
        Self { values: vec![Vec::new(); expectations], tally: PairedTally::default() }
    }

    fn add(&mut self, controller: &TrialRow, reference: &TrialRow) {
        let tally = &mut self.tally;
        if !(controller.is_applicable && reference.is_applicable) {
            tally.not_applicable += 1;
            return;
        }
        match (controller.verdict, reference.verdict) {
            (Verdict::Inconclusive, _) | (_, Verdict::Inconclusive) => {
                tally.inconclusive += 1;
                return;
            }
            (Verdict::Fail, Verdict::Pass) => tally.only_controller_fails += 1,
            (Verdict::Pass, Verdict::Fail) => tally.only_reference_fails += 1,
            (Verdict::Fail, Verdict::Fail) => tally.both_fail += 1,
            (Verdict::Pass, Verdict::Pass) => {}
        }
        tally.trials += 1;
        for (pairs, values) in self.values.iter_mut().zip(controller.values.iter().zip(&reference.values)) {
            let pair = [*values.0, *values.1];
            pairs.extend(pair.iter().all(|value| value.is_finite()).then_some(pair));
        }
    }

    fn finish(self, campaign: &Campaign) -> PairedTally {
        let PairedTally { trials, only_controller_fails, only_reference_fails, .. } = self.tally;
        // Half of the error for each of the two shares, so that both bounds hold together.
        let confidence = f64::midpoint(campaign.confidence, 1.0);
        let bounds = |seen: u64| clopper_pearson(u32::try_from(seen).ok()?, u32::try_from(trials).ok()?, confidence);
        let interval = bounds(only_controller_fails).zip(bounds(only_reference_fails));
        let share = |count: f64| count / trials as f64;
        let expectations = campaign.template.scenario.expectations.iter();
        PairedTally {
            failing_share_difference: (trials > 0)
                .then(|| share(only_controller_fails as f64 - only_reference_fails as f64)),
            failing_share_interval: interval
                .map(|([low, high], [other_low, other_high])| [low - other_high, high - other_low]),
            differences: expectations
                .zip(&self.values)
                .map(|(expectation, pairs)| difference(expectation, pairs, campaign.confidence))
                .collect(),
            ..self.tally
        }
    }
}

fn difference(expectation: &Expectation, pairs: &[[f64; 2]], confidence: f64) -> PairedDifference {
    let mean = |of: &dyn Fn(&[f64; 2]) -> f64| {
        (!pairs.is_empty()).then(|| pairs.iter().map(of).sum::<f64>() / pairs.len() as f64)
    };
    let differences: Vec<f64> = pairs.iter().map(|[controller, reference]| controller - reference).collect();
    PairedDifference {
        expectation: expectation.name.clone(),
        unit: expectation.metric.spec().unit.symbol(),
        pairs: pairs.len() as u64,
        controller_mean: mean(&|pair| pair[0]),
        reference_mean: mean(&|pair| pair[1]),
        mean_difference: mean(&|pair| pair[0] - pair[1]),
        interval: mean_bounds(&differences, confidence).map(|(bounds, _)| bounds),
    }
}

/// Compares each campaign with the last one. Fails unless all have the same campaign file and inputs
/// and every shard, and for methods whose trials depend on earlier results.
pub fn compare(folders: &[LabelledFolder<'_>]) -> Result<CampaignComparison, CampaignError> {
    let (reference, others) = match folders {
        [others @ .., reference] if !others.is_empty() => (reference, others),
        _ => return Err(CampaignError::NothingToCompare(folders.len())),
    };
    let (reference_plan, campaign) = CampaignPlan::open(reference.folder)?;
    if campaign.chain_trials() > 1 {
        return Err(CampaignError::DependentTrials(reference.folder.to_owned()));
    }
    let reference_rows = read_rows(reference, &reference_plan, &campaign)?;
    let pairs = others.iter().map(|controller| {
        let (plan, _) = CampaignPlan::open(controller.folder)?;
        if !plan.has_inputs_of(&reference_plan) {
            let [path, reference] = [controller, reference].map(|labelled| labelled.folder.to_owned());
            return Err(CampaignError::OtherInputs { path, reference });
        }
        let mut overall = Pairs::new(&campaign);
        let mut cells = vec![Pairs::new(&campaign); usize::try_from(campaign.cells).unwrap_or_default()];
        for (row, other) in read_rows(controller, &plan, &campaign)?.iter().zip(&reference_rows) {
            overall.add(row, other);
            if let Some(cell) = cells.get_mut(campaign.cell(&row.draws)) {
                cell.add(row, other);
            }
        }
        let cells = cells.into_iter().enumerate().map(|(number, cell)| PairedTally {
            values: Some(campaign.cell_values(number)),
            cell: campaign.cell_text(number, |_| true),
            ..cell.finish(&campaign)
        });
        Ok(PairComparison {
            controller: ComparedController::new(controller, &plan),
            reference: ComparedController::new(reference, &reference_plan),
            overall: overall.finish(&campaign),
            cells: cells.collect(),
        })
    });
    let pairs = pairs.collect::<Result<_, _>>()?;
    Ok(CampaignComparison { format: 1, title: campaign.title.clone(), confidence: campaign.confidence, pairs })
}

fn read_rows(
    LabelledFolder { folder, .. }: &LabelledFolder<'_>,
    plan: &CampaignPlan,
    campaign: &Campaign,
) -> Result<Vec<TrialRow>, CampaignError> {
    let mut rows = Vec::new();
    for shard in 1..=plan.shards {
        if !plan.part_path(folder, shard).exists() {
            return Err(CampaignError::MissingShard { folder: (*folder).to_owned(), shard });
        }
        PartReader::open(folder, plan, campaign, shard)?.rows(&mut |row| {
            rows.push(row);
            Ok(())
        })?;
    }
    Ok(rows)
}

impl CampaignComparison {
    /// Writes `comparison.json` and `comparison.html` to `folder`. Returns the content of the page.
    pub fn write(&self, folder: &Path) -> Result<Document, CampaignError> {
        let path = folder.join(COMPARISON_FILE);
        let text = serde_json::to_string_pretty(self).map_err(io::Error::from).at(&path)?;
        OutputFolder::open(folder)?.write(COMPARISON_FILE, format!("{text}\n"))?;
        let document = self.document();
        document.write(&folder.join(COMPARISON_PAGE))?;
        Ok(document)
    }

    pub fn document(&self) -> Document {
        let percent = self.confidence * 100.0;
        let mut blocks = Vec::new();
        for pair in &self.pairs {
            let [label, reference] = [&pair.controller, &pair.reference].map(|compared| &compared.label);
            blocks.push(Block::heading(format!("{label} minus {reference}")));
            blocks.push(Block::lines(pair.lines(percent)));
            blocks.push(Block::Table(pair.table(std::slice::from_ref(&pair.overall))));
            if pair.cells.len() > 1 {
                let cells = Block::Table(pair.table(&pair.cells));
                blocks.push(Block::Details(vec![Block::heading("Combinations of listed values"), cells]));
            }
        }
        Document::new(&self.title, blocks)
    }
}

impl PairComparison {
    fn lines(&self, percent: f64) -> Vec<String> {
        let PairedTally { trials, only_controller_fails, only_reference_fails, both_fail, .. } = self.overall;
        let [label, reference] = [&self.controller.label, &self.reference.label];
        let mut lines: Vec<String> = [&self.controller, &self.reference]
            .into_iter()
            .map(|ComparedController { label, rig, firmware_sha256 }| {
                format!("{label}: rig {}, firmware SHA-256 {firmware_sha256:.12}", quoted(rig))
            })
            .collect();
        if self.controller.firmware_sha256 == self.reference.firmware_sha256 {
            lines.push("both have the same firmware".to_owned());
        }
        lines.push(format!(
            "{trials} trials with both: {both_fail} fail with both, {only_controller_fails} only with {label}, \
             {only_reference_fails} only with {reference}"
        ));
        if let Some(([low, high], share)) =
            self.overall.failing_share_interval.zip(self.overall.failing_share_difference)
        {
            let [low, high, share] = [low, high, share].map(|share| share * 100.0);
            lines.push(format!(
                "failing share: difference {share:.3} %, from {low:.3} % to {high:.3} %, each end at {percent} % \
                 confidence"
            ));
        }
        let PairedTally { inconclusive, not_applicable, .. } = self.overall;
        for (count, what) in
            [(inconclusive, "are inconclusive with one of the two"), (not_applicable, "do not apply to one of the two")]
        {
            lines.extend((count > 0).then(|| format!("{count} trials {what} and are not compared")));
        }
        lines
    }

    fn table(&self, tallies: &[PairedTally]) -> Table {
        let has_cells = tallies.iter().any(|tally| tally.values.is_some());
        let [label, reference] = [&self.controller.label, &self.reference.label];
        let numbers = ["pairs", label, reference, "difference", "from", "to"];
        let header = has_cells.then(|| Column::from("values")).into_iter().chain([Column::from("expectation")]);
        let mut table = Table::new(header.chain(numbers.map(|name| Column::number(name, ""))));
        for tally in tallies {
            let cell = has_cells.then(|| tally.cell.clone());
            table.extend(tally.differences.iter().map(|difference| {
                let PairedDifference { expectation: name, unit, pairs, interval, .. } = difference;
                let [low, high] = interval.map_or([None; 2], |ends| ends.map(Some));
                let numbers =
                    [difference.controller_mean, difference.reference_mean, difference.mean_difference, low, high];
                cell.clone()
                    .into_iter()
                    .chain([with_unit(name, unit), pairs.to_string()])
                    .chain(numbers.map(|value| with_decimals(value, 4)))
            }));
        }
        table
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const VARY: &str = "\"profile.finger_force_n\" = { uniform = [0.0, 5.0] }";

    fn row(trial: u64, value: f64, verdict: Verdict) -> TrialRow {
        TrialRow { values: vec![value], ..TrialRow::example(trial, verdict, 0.1) }
    }

    fn tally(pairs: impl IntoIterator<Item = [TrialRow; 2]>) -> PairedTally {
        let folder = tempfile::tempdir().unwrap();
        let campaign = Campaign::example(folder.path(), VARY, "[plan]\nmethod = \"random\"\ntrials = 1\n");
        let mut all = Pairs::new(&campaign);
        pairs.into_iter().for_each(|[controller, reference]| all.add(&controller, &reference));
        all.finish(&campaign)
    }

    #[test]
    fn a_difference_has_no_scatter_that_both_trials_share() {
        let pair = |trial: u64| {
            let shared = 1.5 + (trial * 37 % 20) as f64 / 20.0;
            let own = if trial.is_multiple_of(2) { 0.11 } else { 0.09 };
            [shared + own, shared].map(|value| row(trial, value, Verdict::Pass))
        };
        let unreached = [row(40, f64::NAN, Verdict::Fail), row(40, 1.5, Verdict::Pass)];
        let tally = tally((0..40).map(pair).chain([unreached]));
        let [difference] = &tally.differences[..] else { panic!("{tally:?}") };
        assert_eq!((tally.trials, tally.only_controller_fails, difference.pairs, difference.unit), (41, 1, 40, "ms"));
        assert!((difference.mean_difference.unwrap() - 0.1).abs() < 1e-12, "{difference:?}");
        let [low, high] = difference.interval.unwrap();
        // The values themselves scatter by 0.29 ms, so unpaired means differ by ±0.1 ms at random.
        assert!(0.09 < low && low < 0.1 && 0.1 < high && high < 0.11, "{low} {high}");
    }

    #[test]
    fn the_failing_share_is_compared_by_different_verdicts() {
        use Verdict::{Fail, Inconclusive, Pass};
        let verdicts =
            [[Fail, Pass], [Fail, Pass], [Fail, Pass], [Pass, Fail], [Fail, Fail], [Pass, Pass], [Fail, Inconclusive]];
        let pairs = verdicts.map(|[one, other]| [row(0, 1.0, one), row(0, 1.0, other)]);
        let absent = [TrialRow { is_applicable: false, ..row(1, 1.0, Pass) }, row(1, 1.0, Pass)];
        let tally = tally(pairs.into_iter().chain([absent]));
        let counts = [tally.trials, tally.only_controller_fails, tally.only_reference_fails, tally.both_fail];
        assert_eq!((counts, tally.inconclusive, tally.not_applicable), ([6, 3, 1, 1], 1, 1));
        assert!((tally.failing_share_difference.unwrap() - 2.0 / 6.0).abs() < 1e-12, "{tally:?}");
        // Clopper-Pearson at 97.5 % per side: 0.11812 and 0.88188 for 3 of 6, 0.00421 and 0.64123 for 1 of 6.
        let [low, high] = tally.failing_share_interval.unwrap();
        assert!((low + 0.523_1).abs() < 1e-3 && (high - 0.877_7).abs() < 1e-3, "{low} {high}");
        let [low, high] = self::tally([[row(0, 1.0, Fail), row(0, 1.0, Fail)]]).failing_share_interval.unwrap();
        assert!((low + 0.975).abs() < 1e-9 && (high - 0.975).abs() < 1e-9, "{low} {high}");
        assert_eq!(self::tally([]).failing_share_interval, None);
    }
}
