//! Tabulates the verdicts of a run by requirement (`traceability.csv`) and, for joined runs, by board:
//! missing shards, verdicts by scenario, and the differences between boards.

use crate::{format, record_queries};
use platebench_document::{Block, Cell, Column, Document, NOTHING, Table};
use platebench_model::record::{ExpectationRecord, MergeRecord, RunRecord, ScenarioRecord, TrialRecord, Verdict};
use platebench_model::trace::{AtPath, FileError, write_atomically};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

pub const FILE: &str = "traceability.csv";

/// An expectation that belongs to a requirement.
#[derive(Debug, Clone)]
pub(crate) struct RequirementLink<'a> {
    pub(crate) requirement: &'a str,
    pub(crate) scenario_index: usize,
    pub(crate) scenario: &'a ScenarioRecord,
    pub(crate) expectation: &'a ExpectationRecord,
    /// Trial that decided, or else the first one.
    trial: Option<&'a TrialRecord>,
}

pub(crate) fn requirement_links(record: &RunRecord) -> Vec<RequirementLink<'_>> {
    let links = record.scenarios.iter().enumerate().flat_map(|(scenario_index, scenario)| {
        scenario.expectations.iter().enumerate().filter_map(move |(index, expectation)| {
            let requirement = expectation.requirement.as_deref()?;
            let trial = record_queries::trial_to_inspect(scenario, index).or_else(|| scenario.trials.first());
            Some(RequirementLink { requirement, scenario_index, scenario, expectation, trial })
        })
    });
    let mut links: Vec<_> = links.collect();
    links.sort_by_key(|link| link.requirement);
    links
}

pub fn write(record: &RunRecord, folder: &Path) -> Result<(), FileError> {
    let path = folder.join(FILE);
    write_atomically(&path, requirement_document(record).to_csv().as_bytes()).at(&path)
}

pub fn requirement_document(record: &RunRecord) -> Document {
    let mut table = Table::new([
        "requirement",
        "expectation",
        "limit",
        "scenario",
        "verdict",
        "value",
        "unit",
        "interval_low",
        "interval_high",
        "trace",
    ]);
    table.extend(requirement_links(record).into_iter().map(|link| {
        let RequirementLink { requirement, scenario, expectation, trial, .. } = link;
        let [low, high] = expectation.interval.map_or([None; 2], |interval| interval.map(Some));
        let [value, low, high] =
            [expectation.value, low, high].map(|number| number.map_or_else(String::new, |number| number.to_string()));
        let limit = format::limit(expectation);
        let unit = format::unit(expectation.metric);
        let texts = [requirement, &expectation.name, &limit, &scenario.file, expectation.verdict.name()];
        let trace = trial.map_or("", |trial| &*trial.trace);
        texts.into_iter().chain([&*value, unit, &low, &high, trace]).map(Cell::from).collect::<Vec<_>>()
    }));
    Document::new("Requirements", vec![Block::Table(table)])
}

/// `None` if the run was not joined from others.
pub fn board_document(record: &RunRecord) -> Option<Document> {
    let merge = record.merge.as_ref()?;
    let mut blocks = vec![Block::heading("Boards")];
    blocks.extend(merge.missing_shards.iter().map(|missing| {
        let (shard, shards, board) = (missing.shard, missing.shards, &missing.board);
        Block::paragraph(format!("inconclusive: evidence: shard {shard}/{shards} of {board} is missing"))
    }));
    blocks.extend(verdict_matrix(record, merge).map(Block::Table));
    if !merge.differences.is_empty() {
        blocks.push(Block::heading("Differences between boards"));
        blocks.push(Block::Table(difference_table(merge)));
    }
    Some(Document::new("Boards", blocks))
}

/// `None` if the record lacks a scenario of a joined run.
fn verdict_matrix(record: &RunRecord, merge: &MergeRecord) -> Option<Table> {
    let boards: BTreeSet<&str> = merge.runs.iter().map(|run| run.board.as_str()).collect();
    let mut verdicts: BTreeMap<(&str, &str), Vec<Verdict>> = BTreeMap::new();
    for run in &merge.runs {
        for merged in &run.scenarios {
            let scenario = record.scenarios.iter().find(|scenario| scenario.file == merged.file)?;
            verdicts.entry((&merged.original, &run.board)).or_default().push(scenario.verdict);
        }
    }
    let mut table = Table::new(std::iter::once("scenario").chain(boards.iter().copied()));
    let scenarios: BTreeSet<&str> = verdicts.keys().map(|(scenario, _)| *scenario).collect();
    for scenario in scenarios {
        let cell = |board: &&str| match verdicts.get(&(scenario, board)) {
            Some(played) => Cell::verdict(Verdict::combine(played.iter().copied())),
            None => Cell::from(NOTHING),
        };
        table.push(std::iter::once(Cell::from(scenario)).chain(boards.iter().map(cell)));
    }
    Some(table)
}

fn difference_table(merge: &MergeRecord) -> Table {
    let texts = ["scenario", "metric", "board", "against"].map(Column::from);
    let numbers = ["difference", "95 % interval"].map(|name| Column::number(name, ""));
    let mut table = Table::new(texts.into_iter().chain(numbers));
    for found in &merge.differences {
        let interval =
            found.interval.map_or_else(|| NOTHING.to_owned(), |[low, high]| format!("{low:.4} to {high:.4}"));
        table.push(vec![
            found.scenario.clone(),
            found.metric.clone(),
            found.board.clone(),
            found.reference.clone(),
            format!("{:+.4}", found.difference),
            interval,
        ]);
    }
    table
}
